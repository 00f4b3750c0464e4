"""Progress, forecast and stopwatch, from clocks that tests turn."""

from __future__ import annotations

import io
import os
import re
import threading
from collections.abc import Callable

import pytest

from colmap_affrect.forecast import (
    AFTER_SHARE,
    CORE_S_PER_MEGAPIXEL,
    COSTS,
    GOES_ON_SHARE,
    LEARNED_COSTS,
    LIKELY_SHARE,
    LOADING_CORE_S,
    MAP_CORE_S,
    MIN_ELAPSED_S,
    Forecast,
)
from colmap_affrect.progress import (
    _AT_WORK,
    NUM_PLAIN_LINES,
    SILENT,
    Progress,
    Voice,
    show,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals here")
def test_a_terminal_that_does_not_say_how_wide_it_is_has_bars(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reading, writing = os.openpty()
    terminal = os.fdopen(writing, "w")
    monkeypatch.setattr("sys.stderr", terminal)
    with Progress(terminal).stage("match", 4, "pairs") as advance:
        advance(4)
    shown = b""
    while b"\n" not in shown:
        shown += os.read(reading, 10_000)
    terminal.close()
    os.close(reading)
    assert b"match: 100%" in shown


def test_progress_is_a_bar_on_a_terminal_lines_elsewhere_and_nothing_when_silent() -> (
    None
):
    terminal = Terminal()
    file = io.StringIO()
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


class Clock:
    """A clock that tests turn."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def run_stage(
    clock: Clock, forecast: Forecast, name: str, total: int, unit_s: float
) -> list[float]:
    """Run a stage, and return how long the whole run takes by each forecast in it."""
    whole_s = []
    forecast.begin(name, total)
    for number in range(1, total + 1):
        clock.now_s += unit_s
        forecast.advance(number)
        left_s = forecast.left_s()
        if left_s is not None:
            whole_s.append(clock.now_s + left_s)
    return whole_s


@pytest.mark.parametrize("pace_s", [0.5, 4.0, 60.0])
@pytest.mark.parametrize("after", ["nothing", "escalation"])
def test_forecasts_of_whole_runs_are_right_within_a_factor_of_two(
    pace_s: float, after: str
) -> None:
    clock = Clock()
    forecast = Forecast(20, 190, clock)
    clock.now_s += 10.0  # networks are loaded
    found = []
    for name, total in (("extract", 20), ("match", 190), ("verify", 190)):
        found += run_stage(clock, forecast, name, total, COSTS[name] * pace_s)
    map_s = COSTS["map"] * 28 * pace_s
    found += run_stage(clock, forecast, "map", 20, map_s / 20)
    first_model_s = clock.now_s
    if after == "escalation":
        forecast.expect(first_model_s)
        found += run_stage(clock, forecast, "escalate", 10, first_model_s / 20)
        forecast.expect(0.0)
    found += run_stage(clock, forecast, "pictures", 20, 0.1)
    late = [whole_s for whole_s in found if whole_s > 0][len(found) // 10 :]
    assert max(late) <= 2.0 * clock.now_s
    assert min(late) >= 0.5 * clock.now_s


def test_what_is_slower_than_usual_is_learned_from_the_stages_before() -> None:
    clock = Clock()
    forecast = Forecast(10, 45, clock)
    found = run_stage(clock, forecast, "extract", 10, 30.0)
    units = 10 + 45 * (COSTS["match"] + COSTS["verify"]) + 12 * COSTS["map"]
    least_s = 30.0 * units - clock.now_s
    most_s = least_s + AFTER_SHARE * 30.0 * units
    assert found[-1] - clock.now_s == pytest.approx((least_s * most_s) ** 0.5, rel=0.01)


def test_learned_matching_has_its_own_cost_and_two_forecasts_are_told() -> None:
    """Nothing follows a first model that is sure: before it is there, both may come."""
    clock = Clock()
    forecast = Forecast(10, 45, clock, num_learned_pairs=45)
    run_stage(clock, forecast, "extract", 10, 2.0)
    ends_s = forecast.least_and_most_s()
    assert ends_s is not None
    learned_s = 2.0 * (10 * LEARNED_COSTS["image"] + 45 * LEARNED_COSTS["pair"])
    assert ends_s[1] - ends_s[0] == pytest.approx(learned_s, rel=0.01)
    assert forecast.text() == "50 s to 4 min left in all"
    forecast.begin("escalate", 55, "aliked")  # nothing of it is done
    assert forecast.least_and_most_s() == pytest.approx((learned_s, learned_s))


def test_what_may_follow_learned_matching_is_told_while_it_is_at_work() -> None:
    """It often finds all; where it finds nothing, steps go on, for at most as long as is told."""
    clock = Clock()
    forecast = Forecast(10, 45, clock, num_learned_pairs=45)
    run_stage(clock, forecast, "extract", 10, 2.0)
    forecast.expect(400.0)
    forecast.begin("escalate", 55, "aliked")
    learned_s = 2.0 * (10 * LEARNED_COSTS["image"] + 45 * LEARNED_COSTS["pair"])
    most_s = learned_s + LIKELY_SHARE * 400.0
    assert forecast.least_and_most_s() == pytest.approx((learned_s, most_s))
    forecast.begin("escalate", 6, "more warps")  # nothing of it is done
    left_s = LIKELY_SHARE * 400.0
    assert forecast.least_and_most_s() == pytest.approx((left_s, left_s))
    forecast.expect(0.0)
    forecast.begin("guide", 6)
    assert forecast.least_and_most_s() is None


def test_a_run_of_unknown_photographs_is_forecast_when_it_has_lasted_a_while() -> None:
    clock = Clock()
    forecast = Forecast(10, 45, clock)
    assert forecast.left_s() is None
    forecast.begin("extract", 10)
    clock.now_s += MIN_ELAPSED_S / 2
    forecast.advance(1)
    assert forecast.left_s() is None
    clock.now_s += MIN_ELAPSED_S
    forecast.advance(2)
    assert forecast.left_s() is not None


def test_a_run_that_goes_on_is_forecast_when_it_is_known_what_is_left() -> None:
    clock = Clock()
    forecast = Forecast(
        10, 0, clock, more_may_follow=False, megapixels=20.0, is_new=False
    )
    assert forecast.left_s() is None
    forecast.begin("extract", 1)
    assert forecast.left_s() is not None


def test_what_is_at_work_says_how_long_the_run_still_takes() -> None:
    clock = Clock()
    voice = Voice(clock)
    progress = Progress(io.StringIO(), voice=voice)
    forecast = Forecast(10, 45, clock, more_may_follow=False, megapixels=20.0)
    progress.with_forecast(
        forecast
    )  # what was made before speaks for the whole command
    clock.now_s += 4.0
    assert (
        voice.wanted(stays=True) == "beginning: at work for 4 s, about 80 s left in all"
    )


def test_where_nothing_may_follow_the_first_model_one_forecast_is_told() -> None:
    clock = Clock()
    forecast = Forecast(10, 45, clock, num_learned_pairs=45, more_may_follow=False)
    run_stage(clock, forecast, "extract", 10, 2.0)
    ends_s = forecast.least_and_most_s()
    assert ends_s is not None
    assert ends_s[0] == ends_s[1]
    assert forecast.text() == "about 50 s left in all"


def test_mapping_is_not_at_its_end_with_the_last_photograph() -> None:
    clock = Clock()
    forecast = Forecast(5, 10, clock)
    for name, total in (("extract", 5), ("match", 10), ("verify", 10)):
        run_stage(clock, forecast, name, total, COSTS[name] * 2.0)
    run_stage(clock, forecast, "map", 5, 0.1)
    before_s = forecast.left_s()
    clock.now_s += 60.0
    after_s = forecast.left_s()
    assert before_s is not None
    assert after_s is not None
    assert before_s > 5.0
    assert after_s > GOES_ON_SHARE * 60.0


def test_a_run_is_forecast_by_its_megapixels_before_a_photograph_is_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ten photographs of two megapixels take ten seconds on three cores, after what is loaded."""
    monkeypatch.setattr("os.cpu_count", lambda: 3)
    clock = Clock()
    forecast = Forecast(
        10, 45, clock, more_may_follow=False, megapixels=20.0, num_cores=3
    )
    adjusting = 2 * COSTS["map"]
    units = 10 * (1 + MAP_CORE_S / (2 * CORE_S_PER_MEGAPIXEL)) + adjusting
    units += 45 * (COSTS["match"] + COSTS["verify"])
    assert pytest.approx(1.5, rel=0.3) == CORE_S_PER_MEGAPIXEL
    assert pytest.approx(1.5, rel=0.3) == LOADING_CORE_S
    assert pytest.approx(0.3, rel=0.5) == MAP_CORE_S
    assert forecast.left_s() == pytest.approx(LOADING_CORE_S + 1.0 * units, rel=0.3)
    clock.now_s += 60.0  # of loading on a busy machine
    assert forecast.left_s() == pytest.approx(1.0 * units, rel=0.3)
    forecast.begin("extract", 10)
    assert forecast.left_s() == pytest.approx(1.0 * units, rel=0.3)
    clock.now_s += 6.0  # three cores work on the first three: two seconds each at least
    unit_s = 6.0 / 3
    assert forecast.left_s() == pytest.approx(unit_s * units - 6.0, rel=0.01)
    clock.now_s += 6.0
    forecast.advance(3)
    forecast.advance(6)
    assert forecast.left_s() is not None


def test_forecasts_are_shown_with_the_stage_once_enough_is_measured() -> None:
    clock = Clock()
    lines = io.StringIO()
    progress = Progress(lines, forecast=Forecast(20, 190, clock))
    with progress.stage("extract", 20, "images") as advance:
        for _ in range(20):
            clock.now_s += 1.0
            advance(1)
    shown = lines.getvalue().splitlines()
    assert shown[0] == "extract: 2/20 images"
    assert re.fullmatch(r"extract: 10/20 images, 80 s to 3 min left in all", shown[4])
    terminal = Terminal()
    progress = Progress(terminal, forecast=Forecast(20, 190, clock))
    with progress.stage("extract", 20, "images") as advance:
        for _ in range(20):
            clock.now_s += 1.0
            advance(1)
    assert "left in all" in terminal.getvalue()


@pytest.mark.parametrize(("seconds", "words"), [
    (0.0, "10 s"), (31.0, "40 s"), (100.0, "2 min"), (5000.0, "83 min"), (9000.0, "2.5 h"),
])  # fmt: skip
def test_durations_are_told_as_exactly_as_a_forecast_is(
    seconds: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    forecast = Forecast(1, 0)
    monkeypatch.setattr(forecast, "least_and_most_s", lambda: (seconds, seconds))
    assert forecast.text() == f"about {words} left in all"


def test_a_voice_speaks_after_four_seconds_of_silence() -> None:
    now_s = 0.0
    said = []
    voice = Voice(clock=lambda: now_s)
    voice.heard("map: 9/9 images")
    for _ in range(20):
        now_s += 1.0
        text = voice.wanted(stays=True)
        if text:
            said.append(text)
    seconds = [int(text.removesuffix(" s").rpartition(" ")[2]) for text in said]
    assert seconds == [4, 8, 12, 16, 20]
    assert said[0] == "map: 9/9 images: at work for 4 s"
    voice.heard("pictures")
    now_s += 3.0
    assert voice.wanted(stays=True) == ""
    now_s += 1.0
    assert voice.wanted(stays=True) == "pictures: at work for 4 s"


def test_a_voice_counts_what_a_person_has_waited_before() -> None:
    clock = Clock()
    clock.now_s = 10.0
    voice = Voice(clock)
    voice.heard("inspect", ago_s=2.5)
    clock.now_s += 1.0
    assert voice.wanted(stays=True) == ""
    clock.now_s += 1.0
    assert voice.wanted(stays=True) == "inspect: at work for 4 s"


def test_a_voice_counts_seconds_where_a_line_is_replaced() -> None:
    now_s = 0.0
    voice = Voice(clock=lambda: now_s)
    said = []
    for _ in range(8):
        now_s += 1.0
        said.append(voice.wanted(stays=False))
    assert said[:3] == [""] * 3
    assert [text.rpartition(" for ")[2] for text in said[3:]] == [
        "4 s",
        "5 s",
        "6 s",
        "7 s",
        "8 s",
    ]


def test_a_voice_that_speaks_already_is_not_doubled_and_print_takes_its_line_away() -> (
    None
):
    terminal = Terminal()
    progress = Progress(terminal)
    with progress.never_silent("export"):
        assert progress.voice.doing == "export"
        with progress.never_silent("run"):
            assert progress.voice.doing == "export"
        assert progress.voice.is_listened_to
        _AT_WORK.show("export: at work for 4 s", terminal)
        show("a line", file=terminal)
    assert not progress.voice.is_listened_to
    replaced = "\rexport: at work for 4 s"
    wiped = f"\r{' ' * 23}\r"
    assert terminal.getvalue() == f"{replaced}{wiped}a line\n"


def test_work_without_stages_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("colmap_affrect.progress.QUIET_S", 0.0)
    for stream in (Terminal(), io.StringIO()):
        voice = Voice()
        spoken = threading.Event()
        wanted = voice.wanted

        def listened(
            *,
            stays: bool,
            wanted: Callable[..., str] = wanted,
            spoken: threading.Event = spoken,
        ) -> str:
            text = wanted(stays=stays)
            spoken.set()
            return text

        monkeypatch.setattr(voice, "wanted", listened)
        with Progress(stream, voice=voice).never_silent(interval_s=0.001):
            assert spoken.wait(5.0)
        assert "beginning: at work for 0 s" in stream.getvalue()
        assert ("\r" in stream.getvalue()) == stream.isatty()
    assert Progress().voice is not Progress().voice
