"""Progress, forecast and stopwatch, from clocks that tests turn."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable

import pytest

from colmap_affrect.progress import (
    COSTS,
    NUM_PLAIN_LINES,
    SILENT,
    Forecast,
    Progress,
    Voice,
)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


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


def test_forecast_measures_what_has_begun_and_guesses_the_rest_from_it() -> None:
    now_s = 0.0
    lines = io.StringIO()
    forecast = Forecast(20, 190, clock=lambda: now_s)
    with Progress(lines, forecast=forecast).stage("extract", 20, "images") as advance:
        for _ in range(20):
            now_s += 60.0
            advance(1)
    minutes = 10 + 190 * (COSTS["match"] + COSTS["verify"]) + 28 * COSTS["map"]
    assert lines.getvalue().splitlines()[4] == (
        f"extract: 10/20 images, first model in about {minutes:.0f} min"
    )
    forecast.begin("match", 190)
    forecast.begin("verify", 190)
    forecast.begin("map", 20)
    now_s += 600.0
    assert forecast.text(0.5) == ""


def test_a_voice_speaks_after_five_seconds_and_seldomer_where_lines_stay() -> None:
    now_s = 0.0
    said = []
    voice = Voice(clock=lambda: now_s)
    voice.heard("map: 9/9 images")
    for _ in range(200):
        now_s += 1.0
        text = voice.wanted(stays=True)
        if text:
            said.append(text)
    seconds = [int(text.removesuffix(" s").rpartition(" ")[2]) for text in said]
    assert seconds == [5, 10, 20, 40, 80, 140, 200]
    assert said[0] == "map: 9/9 images: at work for 5 s"
    voice.heard("pictures")
    now_s += 4.0
    assert voice.wanted(stays=True) == ""
    now_s += 1.0
    assert voice.wanted(stays=True) == "pictures: at work for 5 s"


def test_a_voice_counts_seconds_where_a_line_is_replaced() -> None:
    now_s = 0.0
    voice = Voice(clock=lambda: now_s)
    said = []
    for _ in range(8):
        now_s += 1.0
        said.append(voice.wanted(stays=False))
    assert said[:4] == [""] * 4
    assert [text.rpartition(" for ")[2] for text in said[4:]] == [
        "5 s",
        "6 s",
        "7 s",
        "8 s",
    ]


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
