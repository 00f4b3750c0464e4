"""Progress, forecast and stopwatch, from clocks that tests turn."""

from __future__ import annotations

import io

import pytest

from colmap_affrect import progress
from colmap_affrect.progress import (
    COSTS,
    MAP_COST_PER_IMAGE,
    NUM_PLAIN_LINES,
    SILENT,
    Forecast,
    Progress,
    Stopwatch,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_a_bar_on_a_terminal_lines_elsewhere_and_nothing_when_silent() -> None:
    terminal, file = Terminal(), io.StringIO()
    for kind in (Progress(terminal), Progress(file), SILENT):
        with kind.stage("match", 400, "pairs") as advance:
            for _ in range(400):
                advance(1)
        with kind.stage("verify", 0, "pairs") as advance:
            advance(1)
    assert "\r" in terminal.getvalue()
    assert "400/400" in terminal.getvalue()
    lines = file.getvalue().splitlines()
    assert len(lines) == NUM_PLAIN_LINES
    assert (lines[0], lines[-1]) == ("match: 40/400 pairs", "match: 400/400 pairs")


MAP_COST = COSTS["map"] + MAP_COST_PER_IMAGE * 100
"""Of each of a hundred images."""


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def run_stage(forecast: Forecast, clock: Clock, name: str, total: int, unit_s: float) -> None:
    forecast.begin(name, total)
    for _ in range(total):
        clock.now_s += unit_s
        forecast.advance(1)
    forecast.end()


def test_what_has_begun_is_measured_and_the_rest_is_guessed_from_it() -> None:
    clock = Clock()
    forecast = Forecast(100, 4950, clock=clock)
    assert forecast.left_s() is None
    forecast.begin("extract", 100)
    for _ in range(4):
        clock.now_s += 2.0
        forecast.advance(1)
        assert forecast.text() == ""  # says too little
    clock.now_s += 2.0
    forecast.advance(1)
    guessed = 4950 * (COSTS["match"] + COSTS["verify"]) + 100 * MAP_COST
    assert forecast.left_s() == pytest.approx(2.0 * (95 + guessed))
    forecast.end()
    run_stage(forecast, clock, "match", 4950, 0.01)
    forecast.begin("verify", 4950)
    clock.now_s += 10.0
    forecast.advance(2475)
    left_s = forecast.left_s()
    assert left_s is not None
    assert left_s > 10.0  # and as much again as it took until now
    forecast.end()
    forecast.begin("map", 100)
    clock.now_s += 10.0
    forecast.advance(1)
    assert forecast.text() == ""


def test_forecast_is_in_lines() -> None:
    clock, lines = Clock(), io.StringIO()
    progress = Progress(lines).with_forecast(Forecast(20, 0, clock=clock))
    with progress.stage("extract", 20, "images") as advance:
        for _ in range(20):
            clock.now_s += 60.0
            advance(1)
    assert lines.getvalue().splitlines()[4] == (
        "extract: 10/20 images, whole run: about 30 min left"
    )


def test_inner_steps_are_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock reads 0, 1, 2, ...: outer from 0 to 5, inner from 1 to 2 and from 3 to 4."""
    ticks = iter(range(100))
    monkeypatch.setattr(progress.time, "perf_counter", lambda: next(ticks))
    watch = Stopwatch("never", "outer")
    with watch.step("outer"):
        for _ in range(2):
            with watch.step("inner"):
                pass
    with pytest.raises(ValueError, match="broken"), watch.step("outer"):
        raise ValueError("broken")
    assert watch.seconds == {"never": 0, "outer": 3 + 1, "inner": 2}
    assert list(watch.seconds) == ["never", "outer", "inner"]
