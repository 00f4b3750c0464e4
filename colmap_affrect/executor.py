"""Run one function over many tasks, in order and with bounded memory."""

from __future__ import annotations

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

BYTES_PER_RSS = 1 if sys.platform == "darwin" else 1024
"""Unit of ``getrusage``."""

Task = TypeVar("Task")
Result = TypeVar("Result")


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_bytes() -> int:
    """Return the most memory that this process has had.

    Not by ``getrusage`` where it can be helped: Linux counts there what the process that started
    this one had.
    """
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_RSS


def map_ordered(
    function: Callable[[Task], Result], tasks: Iterable[Task], num_threads: int
) -> Iterator[Result]:
    """Yield ``function(task)`` in task order; at most two tasks per thread are in flight.

    Meanwhile numpy's linear algebra keeps to the calling thread: with a thread pool of its
    own in every task the matching of images takes twice as long.

    An exception of the function is raised at the place of its task. Work that has not
    begun is dropped when the iteration ends early.
    """
    pending: deque[Future[Result]] = deque()
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(num_threads) as pool:
        try:
            for task in tasks:
                pending.append(pool.submit(function, task))
                if len(pending) >= 2 * num_threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        finally:
            for future in pending:
                future.cancel()
