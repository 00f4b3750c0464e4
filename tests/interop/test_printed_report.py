"""``export --format report``: a PDF where a browser is there, else the page and one line."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest
from browser import needs_chromium
from small_run import make_run_page

from colmap_affrect.errors import OptionError
from colmap_affrect.interop import printed_report
from colmap_affrect.interop.export import export


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return make_run_page(tmp_path).parent


def test_without_a_browser_the_page_is_written_and_one_line_says_so(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(printed_report, "find_browser", lambda: "")
    with caplog.at_level(logging.WARNING, "colmap_affrect"):
        written = export(run, tmp_path / "for-others", "report")
    page = written["report"]
    assert page == tmp_path / "for-others" / "report" / "report.html"
    assert page.read_bytes() == (run / "report.html").read_bytes()
    assert len(caplog.messages) == 1
    assert "no browser was found" in caplog.messages[0]
    assert "report.html" in caplog.messages[0]


def test_files_beside_the_page_go_with_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run / "report.pairs-1.js").write_text("page.takePairs({})", encoding="utf-8")
    monkeypatch.setattr(printed_report, "find_browser", lambda: "")
    folder = export(run, tmp_path / "for-others", "report")["report"].parent
    written = sorted(path.name for path in folder.iterdir())
    assert written == ["report.html", "report.pairs-1.js"]


def test_a_browser_that_prints_nothing_is_named(
    run: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(printed_report, "find_browser", lambda: "/nowhere/browser")
    written = export(run, tmp_path / "for-others", "report")
    assert written["report"].name == "report.html"
    assert "/nowhere/browser made no PDF" in caplog.text


def test_a_run_without_a_page_is_refused_and_nothing_is_written(
    run: Path, tmp_path: Path
) -> None:
    (run / "report.html").unlink()
    with pytest.raises(OptionError, match="no such page; give the output folder"):
        export(run, tmp_path / "for-others", "report")
    assert not (tmp_path / "for-others" / "report").exists()


@needs_chromium
@pytest.mark.long
def test_a_small_run_is_a_pdf_of_at_most_four_pages_of_a4(
    run: Path, tmp_path: Path
) -> None:
    written = export(run, tmp_path / "for-others", "report")
    content = written["report"].read_bytes()
    assert written["report"].name == "report.pdf"
    assert content.startswith(b"%PDF")
    assert 1 <= len(re.findall(rb"/Type\s*/Page\b(?!s)", content)) <= 4
    box = re.search(rb"/MediaBox\s*\[0 0 ([\d.]+) ([\d.]+)\]", content)
    assert box
    assert [float(side) for side in box.groups()] == pytest.approx([595, 842], abs=2)
