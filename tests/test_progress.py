"""Progress on terminals, in files, and none."""

from __future__ import annotations

import io

from colmap_affrect.progress import NUM_PLAIN_LINES, SILENT, Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_is_a_bar_on_a_terminal_lines_elsewhere_and_nothing_when_silent() -> None:
    terminal, file = Terminal(), io.StringIO()
    for progress in (Progress(terminal), Progress(file), SILENT):
        with progress.stage("match", 400, "pairs") as advance:
            for _ in range(400):
                advance(1)
        with progress.stage("verify", 0, "pairs") as advance:
            advance(1)
    assert "\r" in terminal.getvalue()
    assert "400/400" in terminal.getvalue()
    lines = file.getvalue().splitlines()
    assert len(lines) == NUM_PLAIN_LINES
    assert (lines[0], lines[-1]) == ("match: 40/400 pairs", "match: 400/400 pairs")
