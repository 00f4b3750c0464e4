"""Run one function over many tasks, in order and with bounded memory.

An :class:`Executor` says where: in threads of this process (:class:`Threads`), or on the workers of
a cluster (:mod:`colmap_affrect.parallel.cluster`). Results do not depend on it.
"""

import ctypes
import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Protocol, TypeVar

from threadpoolctl import ThreadpoolController, threadpool_limits

BYTES_PER_RSS = 1 if sys.platform == "darwin" else 1024  # unit of ``getrusage``
ASSUMED_MEMORY_BYTES = 8 << 30  # of systems that do not say what they have

Task = TypeVar("Task")
Result = TypeVar("Result")


class Executor(Protocol):
    """Where the work on images and pairs is done."""

    def map(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], files: Sequence[Path] = ()
    ) -> Iterator[Result]:
        """Yield ``function(task)`` in task order, or raise what it raises; few tasks are in flight.

        The function does not change its state; it and the tasks, which are taken from the iterable
        when their turn comes, can be pickled. ``files`` are what it reads, which is refused
        where workers do not see the same.
        """


class Threads:
    """Work in threads of this process."""

    def __init__(self, num_threads: int) -> None:
        self._num_threads = num_threads

    def map(
        self, function: Callable[[Task], Result], tasks: Iterable[Task], files: Sequence[Path] = ()
    ) -> Iterator[Result]:
        """See :func:`map_ordered`."""
        del files
        return map_ordered(function, tasks, self._num_threads)


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory_bytes() -> int:
    """Return the memory that this process may take without harm to others."""
    available = ASSUMED_MEMORY_BYTES
    with suppress(OSError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        available = next(int(s.split()[1]) * 1024 for s in lines if s.startswith("MemAvailable:"))
    with suppress(OSError, ValueError):  # no container, or one without a limit
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")
        available = min(available, int(limit))
    with suppress(ImportError, OSError):  # other systems
        import resource

        limited, _ = resource.getrlimit(resource.RLIMIT_AS)  # ulimit -v
        if limited != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            available = min(available, max(0, limited - pages * resource.getpagesize()))
    return available


def unless_gpu_is_full(work: Callable[[], Result], instead: Callable[[], Result]) -> Result:
    """Return what the work does, or what is done instead when torch has no memory left on a GPU."""
    try:
        return work()
    except RuntimeError as error:
        if "out of memory" not in str(error):
            raise
    return instead()


def peak_memory_bytes() -> int:
    """Return the most memory that this process or one that it waited for has had; 0 on Windows.

    Not by ``getrusage`` where it can be helped: Linux counts there what the process that started
    this one had.
    """
    try:
        import resource
    except ImportError:
        return 0
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * BYTES_PER_RSS
    status = Path("/proc/self/status")
    if status.exists():
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
        own = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    else:
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * BYTES_PER_RSS
    return max(own, children)


def return_freed_memory() -> None:
    """Give freed memory back to the system, of which the C library of Linux keeps much."""
    if sys.platform == "linux":
        with suppress(AttributeError):  # another C library than GNU's
            ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def one_openmp_thread() -> Iterator[None]:
    """Keep torch to the calling thread, which is one of several that work.

    Not by ``torch.set_num_threads``, which would also slow down networks in other threads later.
    torch must have been imported.
    """
    with _loaded_libraries().limit(limits=1, user_api="openmp"):
        yield


@cache
def _loaded_libraries() -> ThreadpoolController:
    return ThreadpoolController()


def map_ordered(
    function: Callable[[Task], Result], tasks: Iterable[Task], num_threads: int
) -> Iterator[Result]:
    """Yield ``function(task)`` in task order; at most two tasks per thread are in flight.

    Meanwhile numpy's linear algebra keeps to the calling thread: thread pools of its own in
    every task would only wait for each other. An exception of the function is raised at the place
    of its task. Work that has not begun is dropped when the iteration ends early; KeyboardInterrupt
    does not wait for what has begun either, which may take long.
    """
    pending: deque[Future[Result]] = deque()
    pool, is_waited_for = ThreadPoolExecutor(num_threads), True
    try:
        with threadpool_limits(1, user_api="blas"):
            for task in tasks:
                pending.append(pool.submit(function, task))
                if len(pending) >= 2 * num_threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
    except KeyboardInterrupt:
        is_waited_for = False
        raise
    finally:
        pool.shutdown(wait=is_waited_for, cancel_futures=True)
