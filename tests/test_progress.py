"""Progress, forecast and stopwatch, from clocks that tests turn."""

from __future__ import annotations

import io

from colmap_affrect.progress import COSTS, NUM_PLAIN_LINES, SILENT, Forecast, Progress


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
