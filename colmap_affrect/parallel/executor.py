"""Run one function over many tasks, in order and with bounded memory.

An :class:`Executor` says where: in threads of this process (:class:`Threads`), or on the workers of
a cluster (:mod:`colmap_affrect.parallel.cluster`). Results do not depend on it.
"""

import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

import cv2
from threadpoolctl import ThreadpoolController, threadpool_limits

ASSUMED_MEMORY_BYTES = 8 << 30  # of systems that do not say what they have; resource
_loaded_libraries = cache(ThreadpoolController)

Task = TypeVar("Task")
Result = TypeVar("Result")


class Executor(Protocol):
    """Where the work on images and pairs is done."""

    def map(
        self,
        function: Callable[[Task], Result],
        tasks: Iterable[Task],
        files: Sequence[Path] = (),
    ) -> Iterator[Result]:
        """Yield the results of tasks in their order; few tasks are in flight.

        Args:
            function: does a task. It does not change its state, and can be pickled.
            tasks: they are taken when their turn comes, and can be pickled.
            files: what the function reads, which is refused where workers do not see the same.

        Raises:
            Exception: what the function raises, at the place of its task.
        """


@dataclass(frozen=True)
class Threads:
    """Work in threads of this process.

    Attributes:
        num_threads: that work.
        num_ahead: tasks that may be in flight besides two per thread.
    """

    num_threads: int
    num_ahead: int = 0

    def map(
        self,
        function: Callable[[Task], Result],
        tasks: Iterable[Task],
        files: Sequence[Path] = (),
    ) -> Iterator[Result]:
        """Yield the results of tasks in their order, see :func:`map_ordered`.

        Args:
            function: does a task.
            tasks: they are taken when their turn comes.
            files: what the function reads, which this process sees.
        """
        del files
        return map_ordered(function, tasks, self.num_threads, self.num_ahead)


def available_cores() -> int:
    """Return the number of cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory_bytes() -> int:
    """Return the memory that this process may take without harm to others."""
    available = ASSUMED_MEMORY_BYTES
    with suppress(OSError):
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                available = int(line.split()[1]) * 1024
    with suppress(OSError, ValueError):  # no container, or one without a limit
        limit = Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")
        available = min(available, int(limit))
    return available


def peak_memory_bytes() -> int:
    """Return the most memory that this process or one that it waited for has had; 0 on Windows."""
    try:
        import resource
    except ImportError:
        return 0
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    of_others = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    unit_bytes = 1 if sys.platform == "darwin" else 1024
    return unit_bytes * max(own, of_others)


@contextmanager
def one_openmp_thread() -> Iterator[None]:
    """Keep torch to the calling thread, which is one of several that work.

    Not by ``torch.set_num_threads``, which would also slow down networks in other threads later.
    torch must have been imported.
    """
    with _loaded_libraries().limit(limits=1, user_api="openmp"):
        yield


def begin_in_thread(call: Callable[[], Result]) -> Future[Result]:
    """Begin a call in a thread of its own, which does not keep a program from ending.

    Args:
        call: what is done there.

    Returns:
        What it returns or raises, to whoever asks for it.
    """
    outcome = Future[Result]()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as error:  # noqa: BLE001  (raised where it is asked for)
            outcome.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    return outcome


def map_ordered(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    num_threads: int,
    num_ahead: int = 0,
) -> Generator[Result, None, None]:
    """Yield the results of tasks in their order; few tasks are in flight, two per thread at least.

    Meanwhile numpy's linear algebra keeps to the calling thread, and OpenCV to its share of the
    cores: thread pools of their own in every task would only wait for each other. Work that has not
    begun is dropped when the iteration ends early; KeyboardInterrupt does not wait for what has
    begun either.

    Args:
        function: does a task, in one of the threads.
        tasks: they are taken when their turn comes, in the calling thread.
        num_threads: that work.
        num_ahead: tasks that may be in flight besides.

    Raises:
        Exception: what the function raises, at the place of its task.
    """
    pool = ThreadPoolExecutor(num_threads)
    is_waited_for = True
    num_before = cv2.getNumThreads()
    cv2.setNumThreads(max(1, num_before // num_threads))
    try:
        with threadpool_limits(1, user_api="blas"):
            yield from in_order(
                lambda task: pool.submit(function, task),
                tasks,
                limit=lambda: 2 * num_threads + num_ahead,
            )
    except KeyboardInterrupt:
        is_waited_for = False
        raise
    finally:
        pool.shutdown(wait=is_waited_for, cancel_futures=True)
        cv2.setNumThreads(num_before)


def _result(future: Any) -> Any:
    return future.result()


def in_order(
    submit: Callable[[Task], Any],
    tasks: Iterable[Task],
    limit: Callable[[], int],
    result: Callable[[Any], Any] = _result,
) -> Generator[Any, None, None]:
    """Yield results of futures in task order.

    What has not ended is cancelled when the iteration ends early.

    Args:
        submit: makes a future of a task.
        tasks: they are taken when their turn comes.
        limit: fewer than so many are submitted beforehand.
        result: waits for the result of a future.
    """
    pending: deque[Any] = deque()
    try:
        for task in tasks:
            pending.append(submit(task))
            while len(pending) >= limit():
                yield result(pending.popleft())
        while pending:
            yield result(pending.popleft())
    finally:
        for future in pending:
            future.cancel()
