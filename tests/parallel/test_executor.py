"""Work in threads: order, what is in flight, errors."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import cv2
import pytest

from colmap_affrect.colmap.database_verification import PAIRS_AHEAD
from colmap_affrect.parallel.executor import Threads, map_ordered


def test_map_ordered_keeps_the_order_and_bounds_what_is_in_flight() -> None:
    started: list[int] = []
    lock = threading.Lock()

    def work(task: int) -> int:
        with lock:
            started.append(task)
        return task * task

    def tasks() -> Iterator[int]:
        for task in range(50):
            assert task - len(results) <= 6
            yield task

    results: list[int] = []
    for result in map_ordered(work, tasks(), 3):
        results.append(result)
    assert results == [task * task for task in range(50)]
    assert sorted(started) == list(range(50))


def test_a_thread_goes_on_while_another_has_a_long_task() -> None:
    is_done = threading.Semaphore(0)

    def work(task: int) -> bool:
        if task:
            is_done.release()
            return True
        return all(is_done.acquire(timeout=5.0) for _ in range(PAIRS_AHEAD))

    assert all(Threads(2, PAIRS_AHEAD).map(work, range(40)))


def test_threads_share_those_of_opencv() -> None:
    given = cv2.getNumThreads()
    try:
        for all_threads, share in ((4, 2), (1, 1)):
            cv2.setNumThreads(all_threads)
            assert list(map_ordered(lambda _: cv2.getNumThreads(), [0], 2)) == [share]
            assert cv2.getNumThreads() == all_threads
    finally:
        cv2.setNumThreads(given)


def test_map_ordered_raises_an_error_in_its_place() -> None:
    results = map_ordered(lambda task: 10 // (3 - task), range(100), 2)
    assert [next(results) for _ in range(3)] == [3, 5, 10]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_map_ordered_does_not_wait_when_it_is_interrupted() -> None:
    may_end = threading.Event()
    ended = threading.Event()

    def work(_: int) -> None:
        may_end.wait(2.0)
        ended.set()

    def tasks() -> Iterator[int]:
        yield 1
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(map_ordered(work, tasks(), 1))
    assert not ended.is_set()
    may_end.set()
