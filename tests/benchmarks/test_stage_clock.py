"""Tests of the clock of stages."""

from __future__ import annotations

import posixpath

import pytest
from stage_clock import StageClock, Timed, Work


class Time:
    """A clock that is moved by hand."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds

    def wait(self, seconds: float) -> None:
        self.seconds += seconds


def test_time_of_a_stage_is_without_the_stages_inside() -> None:
    now = Time()
    clock = StageClock(now)
    for _ in range(2):
        with clock.stage("outer"):
            now.wait(1.0)
            with clock.stage("inner"):
                now.wait(10.0)
                with clock.stage("outer"):
                    now.wait(100.0)
            now.wait(1000.0)
    assert dict(clock.seconds) == {"outer": 2 * 1101.0, "inner": 20.0}


def test_time_counts_when_a_stage_fails() -> None:
    now = Time()
    clock = StageClock(now)

    def fail() -> None:
        with clock.stage("outer"), clock.stage("inner"):
            now.wait(3.0)
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fail()
    assert dict(clock.seconds) == {"outer": 0.0, "inner": 3.0}


def test_functions_are_watched_while_the_block_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    now = Time()
    clock = StageClock(now)
    monkeypatch.setattr(posixpath, "basename", lambda path: now.wait(len(path)) or path[-1])

    def work(result: str, path: str) -> Work:
        now.wait(50.0)  # counting costs no stage anything
        return Work(len(path), len(result))

    watched = [Timed("name", "posixpath.basename", work)]
    with clock.watching(watched), clock.stage("all"):
        now.wait(1.0)
        assert posixpath.basename("abc") == "c"
        assert posixpath.basename("abcd") == "d"
    posixpath.basename("not watched")
    assert dict(clock.seconds) == {"all": 1.0, "name": 7.0}
    assert clock.work["name"] == Work(7, 2)


def test_a_function_that_is_gone_is_an_error() -> None:
    clock = StageClock()
    with pytest.raises(AttributeError), clock.watching([Timed("a", "posixpath.no_such")]):
        pass
