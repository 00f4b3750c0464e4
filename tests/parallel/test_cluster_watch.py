"""A cluster that is lost is said to be so: after seconds, and in the end by an error."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from colmap_affrect.errors import AffrectError
from colmap_affrect.parallel.cluster_watch import (
    GIVE_UP_AFTER_S,
    SILENT_S,
    WARN_AFTER_S,
    ClusterWatch,
)

Worker = dict[str, float]


class Scheduler:
    """What a client is told: workers by name, or that nobody answers."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.workers: dict[str, Worker] = {}
        self.error: Exception | None = None
        self.set_workers(2, 3)

    def set_workers(self, *threads: int) -> None:
        self.workers = {
            f"tcp://{n}": {"nthreads": count, "last_seen": 9000.0}
            for n, count in enumerate(threads)
        }

    def sync(self, ask: Callable[[], Any], callback_timeout: float) -> dict[str, Any]:
        del ask, callback_timeout
        if self.error:
            raise self.error
        return {
            "workers": {name: dict(worker) for name, worker in self.workers.items()}
        }

    def clock(self) -> float:
        return self.now_s


@pytest.fixture
def scheduler() -> Scheduler:
    return Scheduler()


@pytest.fixture
def watch(scheduler: Scheduler) -> ClusterWatch:
    made: Any = scheduler
    return ClusterWatch(made, "tcp://10.0.0.1:8786", scheduler.clock)


def pass_time(
    watch: ClusterWatch, scheduler: Scheduler, seconds: float, *, heard: bool = True
) -> None:
    """Look every second; workers are heard of in between, unless they are not."""
    for _ in range(int(seconds)):
        scheduler.now_s += 1.0
        for worker in scheduler.workers.values():
            worker["last_seen"] += heard
        watch.look()


def stop_answering(scheduler: Scheduler) -> None:
    scheduler.error = TimeoutError()


def close_client(scheduler: Scheduler) -> None:
    scheduler.error = AttributeError("'NoneType' object has no attribute 'identity'")


def lose_workers(scheduler: Scheduler) -> None:
    scheduler.workers = {}


@pytest.mark.parametrize(("harm", "said"), [
    (stop_answering, "the scheduler does not answer any more; start 'dask scheduler' and workers"),
    (close_client, "the scheduler does not answer any more"),
    (lose_workers, "the cluster has no workers any more; start some with 'dask worker tcp://10"),
])  # fmt: skip
def test_lost_cluster_is_said_after_seconds_and_ends_within_a_minute(
    watch: ClusterWatch,
    scheduler: Scheduler,
    caplog: pytest.LogCaptureFixture,
    harm: Callable[[Scheduler], None],
    said: str,
) -> None:
    pass_time(watch, scheduler, 200)
    assert watch.num_threads() == 5
    harm(scheduler)
    pass_time(watch, scheduler, WARN_AFTER_S)
    assert not caplog.text
    pass_time(watch, scheduler, 2)
    assert said in caplog.text
    assert (watch.num_threads(), watch.is_lost) == (5, True)
    with pytest.raises(AffrectError, match="run the same command again") as error:
        pass_time(watch, scheduler, 60 - WARN_AFTER_S)
    assert str(error.value).startswith(f"tcp://10.0.0.1:8786: {said}")
    assert len(caplog.records) == 1


def test_workers_that_are_silent_are_lost(
    watch: ClusterWatch, scheduler: Scheduler, caplog: pytest.LogCaptureFixture
) -> None:
    pass_time(watch, scheduler, 3)
    pass_time(watch, scheduler, SILENT_S + WARN_AFTER_S + 2, heard=False)
    assert "none of the 2 workers is heard of any more" in caplog.text
    with pytest.raises(AffrectError, match="none of the 2 workers"):
        pass_time(watch, scheduler, GIVE_UP_AFTER_S, heard=False)


def test_worker_that_comes_back_goes_on(
    watch: ClusterWatch, scheduler: Scheduler, caplog: pytest.LogCaptureFixture
) -> None:
    lose_workers(scheduler)
    pass_time(watch, scheduler, GIVE_UP_AFTER_S - 1)
    scheduler.set_workers(4)
    pass_time(watch, scheduler, 2 * GIVE_UP_AFTER_S)
    assert "the cluster is there again" in caplog.text
    assert (watch.num_threads(), watch.is_lost, len(caplog.records)) == (4, False, 2)


def test_one_worker_that_is_heard_of_is_enough(
    watch: ClusterWatch, scheduler: Scheduler, caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(100):
        scheduler.now_s += 1.0
        scheduler.workers["tcp://1"]["last_seen"] += 1.0
        watch.look()
    assert not caplog.text
    assert watch.num_threads() == 3
