"""Marks points and paints masks on the page of a run with a model, as a person would."""

from __future__ import annotations

import base64
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import Browser, assert_fits_and_is_readable, chromium, needs_chromium
from PIL import Image
from small_comparison import IMAGE_SIZE
from small_run import NAMES, make_run_page

from colmap_affrect.images.photographs import MaskOptions, Photographs

pytestmark = [needs_chromium, pytest.mark.long]

BOX = """const canvas = document.querySelectorAll(arguments[0])[arguments[1]];
    canvas.scrollIntoView({block: "center"});
    const box = canvas.getBoundingClientRect();
    return [box.left, box.top, box.width, box.height]"""
CHOOSE = """const list = document.querySelectorAll("#tie-points figure select")[arguments[0]];
    list.value = arguments[1];
    list.dispatchEvent(new Event("change"))"""
READOUT = """return document.querySelectorAll("#tie-points figure .readout")[arguments[0]]
    .textContent"""
MARKS = """return [...document.querySelectorAll("#tie-points tbody tr")]
    .map((row) => [...row.cells].slice(0, 5).map((cell) => cell.textContent))"""
DATA = "return page.data"
SAID = "return document.querySelector(arguments[0] + ' [data-part=said]').textContent"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_run_page(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def browser(running: Browser, page: Path, tmp_path: Path) -> Iterator[Browser]:
    """On a desktop, with downloads into a folder; the console must stay empty."""
    running.resize(1200)
    running.command(
        "Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path)
    )
    running.open(page)
    running.run("document.querySelector('#tie-points details').open = true")
    running.run("document.querySelector('#masks details').open = true")
    yield running
    assert running.log() == []
    running.run("localStorage.clear()")


def until(true: Callable[[], object]) -> None:
    for _ in range(200):
        if true():
            return
        time.sleep(0.02)
    pytest.fail("nothing happened")


def track_of_four(data: dict[str, Any]) -> dict[int, np.ndarray]:
    """Return where the four photographs see a point that all see: (2,) px by number."""
    view = data["views"][0]
    bytes_of = base64.b64decode(view["tracks"])
    counts = np.frombuffer(bytes_of, "<u2", view["count"])
    total = int(counts.sum())
    rows = np.frombuffer(bytes_of, "<u2", total, 2 * view["count"])
    shares = np.frombuffer(bytes_of, "<u2", 2 * total, 2 * (view["count"] + total))
    shares = shares.reshape(-1, 2) / 65535.0
    start = 0
    for count in counts.tolist():
        numbers = [view["cameras"][row]["index"] for row in rows[start : start + count]]
        places = shares[start : start + count] * np.array(IMAGE_SIZE)
        is_inside = (places > 20.0).all() and (
            places < np.array(IMAGE_SIZE) - 20.0
        ).all()
        if sorted(numbers) == [0, 1, 2, 3] and is_inside:
            return dict(zip(numbers, places, strict=True))
        start += count
    pytest.fail("no point is seen by four photographs")


def mark(browser: Browser, pane: int, photo: int, place: np.ndarray) -> None:
    """Choose a photograph and click at a place in it, px."""
    browser.run(CHOOSE, pane, str(photo))
    left, top, width, height = browser.run(BOX, "#tie-points canvas", pane)
    scale = min(width / IMAGE_SIZE[0], height / IMAGE_SIZE[1])
    at = np.array([left, top]) + scale * place
    at += [(width - scale * IMAGE_SIZE[0]) / 2, (height - scale * IMAGE_SIZE[1]) / 2]
    browser.press(*np.rint(at).tolist())


def test_two_marks_tell_where_the_point_is_in_the_others(browser: Browser) -> None:
    """One mark tells a line; keys go to the place and mark it there."""
    seen = track_of_four(browser.run(DATA))
    mark(browser, 0, 0, seen[0])
    browser.run(CHOOSE, 1, "2")
    assert "it should be on the line" in browser.run(READOUT, 1)
    mark(browser, 1, 1, seen[1])
    assert "no mark" not in browser.run(READOUT, 1)
    browser.run(CHOOSE, 1, "2")
    assert "it should be in the ring" in browser.run(READOUT, 1)
    browser.run("document.querySelectorAll('#tie-points canvas')[1].focus()")
    browser.key("e")
    browser.key(" ")
    rows = browser.run(MARKS)
    marked = np.array([float(cell) for cell in rows[2][2:4]])
    assert np.linalg.norm(marked - seen[2]) < 3.0
    residuals = [float(row[4]) for row in rows]
    assert max(residuals) < 2.0


PIECES = """return [...document.querySelectorAll("#tie-points .strip .chip")]
    .map((chip) => parseInt(chip.textContent) - 1)"""


def test_all_other_photographs_show_where_the_point_should_be(browser: Browser) -> None:
    """Lines after one mark, places after two; a click goes there."""
    seen = track_of_four(browser.run(DATA))
    mark(browser, 0, 0, seen[0])
    assert set(browser.run(PIECES)) <= {1, 2, 3}
    assert browser.run(PIECES)
    mark(browser, 1, 1, seen[1])
    assert browser.run(PIECES) == [2, 3]
    browser.click("#tie-points .strip .chip")
    browser.key(" ")
    rows = browser.run(MARKS)
    marked = np.array([float(cell) for cell in rows[2][2:4]])
    assert np.linalg.norm(marked - seen[2]) < 3.0
    assert browser.run(PIECES) == [3]


def test_a_mark_at_a_wrong_place_has_a_large_residual_at_once(browser: Browser) -> None:
    seen = track_of_four(browser.run(DATA))
    for photo in (0, 1):
        mark(browser, 0, photo, seen[photo])
    mark(browser, 0, 2, seen[2] + [15.0, -15.0])
    residuals = [float(row[4]) for row in browser.run(MARKS)]
    assert max(residuals) > 4.0


def test_marks_survive_a_reload_and_undo_goes_back_to_the_run(browser: Browser) -> None:
    mark(browser, 0, 0, np.array([50.0, 40.0]))
    before = browser.run(MARKS)
    assert len(before) == 1
    browser.reload()
    assert browser.run(MARKS) == before
    assert "Marks from before: 1" in browser.run(SAID, "#tie-points")
    browser.run("document.querySelector('#tie-points details').open = true")
    browser.click("#tie-points [data-part=undo]")
    assert browser.run(MARKS) == []


def drag(browser: Browser, start: list[float], end: list[float]) -> None:
    """Drag in the photograph of the masks, by shares of its sides."""
    left, top, width, height = browser.run(BOX, "#masks canvas", 0)
    for kind, (x, y) in (
        ("mousePressed", start),
        ("mouseMoved", end),
        ("mouseReleased", end),
    ):
        browser.command(
            "Input.dispatchMouseEvent",
            type=kind,
            x=left + x * width,
            y=top + y * height,
            button="left",
            buttons=1,
        )


def test_painted_masks_are_the_folder_that_mask_path_takes(
    browser: Browser, page: Path, tmp_path: Path
) -> None:
    drag(browser, [0.25, 0.5], [0.75, 1.0])
    assert "Masks: 1 of 6" in browser.run(SAID, "#masks")
    browser.click("#masks [data-part=next]")
    browser.run("document.querySelector('#masks canvas').focus()")
    for key in (" ", "ArrowRight", "ArrowDown", " "):
        browser.key(key)
    assert "Masks: 2 of 6" in browser.run(SAID, "#masks")
    browser.reload()  # what is painted survives
    browser.run("document.querySelector('#masks details').open = true")
    browser.click("#masks [data-part=save]")
    saved = tmp_path / "masks.zip"
    until(lambda: saved.exists() and zipfile.is_zipfile(saved))
    with zipfile.ZipFile(saved) as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path)
    masks = MaskOptions(path=str(tmp_path / "masks"))
    photographs = Photographs(page.parent.parent / "photographs", masks)
    mask = photographs.mask(NAMES[0])
    assert mask is not None
    assert mask.shape == IMAGE_SIZE[::-1]
    height, width = mask.shape
    assert not mask[height * 3 // 4, width // 2]
    assert mask[height // 4, width // 2]
    assert mask[height * 3 // 4, width // 10]
    assert np.mean(~mask) == pytest.approx(0.25, abs=0.02)
    second = photographs.mask(NAMES[1])
    assert second is not None
    assert 0.0 < np.mean(~second) < 0.01


def test_the_eraser_takes_away_what_was_covered(
    browser: Browser, tmp_path: Path
) -> None:
    drag(browser, [0.02, 0.02], [0.98, 0.98])
    browser.run("""const tool = document.querySelector("#masks [data-part=tool]");
        tool.value = "eraser";
        document.querySelector("#masks [data-part=width]").value = 20""")
    drag(browser, [0.02, 0.5], [0.98, 0.5])
    browser.click("#masks [data-part=save]")
    saved = tmp_path / "masks.zip"
    until(lambda: saved.exists() and zipfile.is_zipfile(saved))
    with zipfile.ZipFile(saved) as archive:
        (name,) = archive.namelist()
        (tmp_path / "mask.png").write_bytes(archive.read(name))
    mask = np.array(Image.open(tmp_path / "mask.png").convert("L"))
    assert mask[mask.shape[0] // 2, mask.shape[1] // 2] == 255
    assert mask[mask.shape[0] // 10, mask.shape[1] // 2] == 0


@pytest.mark.parametrize("width", [390, 1400])
def test_open_tools_fit_and_are_readable(browser: Browser, width: int) -> None:
    assert_fits_and_is_readable(browser, "light", width)
