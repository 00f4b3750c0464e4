"""A page that is served: tie points are clicked, mapped at a click, and what changed is shown."""

from __future__ import annotations

import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import (
    Browser,
    BrowserError,
    assert_fits_and_is_readable,
    chromium,
    needs_chromium,
)
from command import on_photographs, run_in_process_of_its_own, start
from small_scene import FOCAL_PX, IMAGE_SIZE, NAMES, world_to_camera, write_photographs

from colmap_affrect.images.photographs import MaskOptions, Photographs

pytestmark = [needs_chromium, pytest.mark.long]

LOST = "side/č.png"
REJECTED = [
    word
    for name in NAMES
    if name != LOST
    for word in ("--reject-pair", f"{LOST},{name}")
]
CORNERS = np.array([
    (-0.6, 0.3, 5.0), (0.6, 0.3, 5.0), (0.6, 1.2, 5.0), (-0.6, 1.2, 5.0),
    (-1.5, -1.2, 7.0), (1.5, -1.2, 7.0), (1.2, 0.0, 7.0), (-1.2, 0.1, 7.0),
])  # fmt: skip
SAID = "return document.querySelector('#map-again p').textContent"
PAINTED = """localStorage.setItem(`colmap-affrect masks ${page.data.masks_key}`, JSON.stringify(
    {0: [{tool: "box", width: 1, places: [[0, 0], [40, 240]]}]}))"""
RESIDUALS = """return [...document.querySelectorAll("#tie-points tbody tr")]
    .map((row) => row.cells[4].textContent)"""
HEADLINE = "return document.querySelector('h1')?.textContent ?? ''"
MARKED = """localStorage.setItem(`colmap-affrect tie points ${page.data.tie_points.key}`,
    JSON.stringify({marks: arguments[0], current: "1"}))"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        found.resize(1400)
        yield found


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A run that has lost a photograph."""
    write_photographs(tmp_path / "photographs")
    options = on_photographs(tmp_path / "photographs", tmp_path / "out")
    run_in_process_of_its_own("run", *options, *REJECTED, "-q")
    return tmp_path / "out"


def corners_in_photograph(index: int) -> np.ndarray:
    """(8, 2) positions of ``CORNERS`` in a photograph, px from its corner."""
    position = (0.55 * (index - 1.5), -0.1 * index, 0.1 * index)
    seen = (CORNERS - position) @ world_to_camera(-5.0 * (index - 1.5)).T
    return np.asarray(FOCAL_PX * seen[:, :2] / seen[:, 2:] + np.array(IMAGE_SIZE) / 2)


def until(true: Callable[[], object]) -> None:
    """Wait until something is true of a page, which may just be loaded again."""
    said = ""
    for _ in range(600):
        try:
            if true():
                return
        except BrowserError as error:
            said = str(error)
        time.sleep(0.1)
    pytest.fail(f"it did not come {said}")


def address_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(r"http://127\.0\.0\.1:\d+/\S+/", line)
        if found:
            return found[0]
    pytest.fail("no address was printed")


def test_marks_and_masks_are_mapped_at_a_click(browser: Browser, out: Path) -> None:
    process = start("serve", out, "--port", "0", *REJECTED)
    try:
        browser.visit(address_of(process))
        names = browser.run(
            "return page.data.tie_points.photographs.map(([name]) => name)"
        )
        marks = []
        for name in (LOST, *[name for name in NAMES if name != LOST][:2]):
            places = corners_in_photograph(NAMES.index(name)).tolist()
            for number, (x, y) in enumerate(places, 1):
                mark = {
                    "point": str(number),
                    "photo": names.index(name),
                    "x": x,
                    "y": y,
                }
                marks.append(mark)
        browser.run(MARKED, marks)
        browser.run(PAINTED)
        browser.reload()
        until(lambda: browser.run(SAID) == "")
        browser.click("#map-again button")
        until(lambda: browser.run(SAID).startswith("Mapped."))
        text = browser.run("return document.querySelector('#map-again').innerText")
        assert re.search(rf"{LOST}\s+not placed\s+(sure|unsure|doubtful)", text)
        assert "Residuals of marks: 24" in text
        residuals = browser.run(RESIDUALS)
        assert len(residuals) == 24
        assert max(map(float, residuals)) < 2.0
        for width in (390, 1400):
            assert_fits_and_is_readable(browser, "dark", width)
        browser.click("#map-again button + button")
        until(lambda: "4 photographs are placed" in browser.run(HEADLINE))
        assert browser.run("return page.tiePoints.rows().length") == 24
        assert browser.log() == []

        masks = Photographs(out, MaskOptions(path=str(out / "by-hand" / "masks")))
        own = [name for name in names if masks.own_mask(name)]
        assert own == [names[0]]
    finally:
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=20)
    assert process.returncode == 0
    assert "ended" in rest
    # On a busy machine it says that Python loads packages
    others = [line for line in errors.splitlines() if not line.startswith("loading: ")]
    assert others == []
