"""Run one function over many tasks, in order and with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_limits

Task = TypeVar("Task")
Result = TypeVar("Result")


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
