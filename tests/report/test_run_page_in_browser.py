"""Clicks through the page of a run as a person would."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from browser import Browser, assert_fits_and_is_readable, chromium, needs_chromium, until_drawn
from small_run import NAMES, make_run_page

pytestmark = [needs_chromium, pytest.mark.long]

DIALOG = "return document.getElementById('photo').open"
PLACE_OF_CAMERA = """
    const canvas = document.querySelector("canvas");
    const box = canvas.getBoundingClientRect();
    const readout = document.querySelector("#model .readout");
    for (let y = box.top + 4; y < box.bottom; y += 8) {
      for (let x = box.left + 4; x < box.right; x += 8) {
        canvas.dispatchEvent(new PointerEvent("pointermove", {clientX: x, clientY: y}));
        if (readout.textContent.startsWith(arguments[0])) return [x, y];
      }
    }
    return null"""
OUTSIDE = """return performance.getEntriesByType("resource").map((entry) => entry.name)
    .filter((name) => !name.startsWith("data:"))"""


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
        found.open(make_run_page(tmp_path_factory.mktemp("run")))
        yield found


@pytest.fixture
def browser(running: Browser) -> Iterator[Browser]:
    """The page on a desktop; the console must stay empty, and nothing be asked for."""
    running.resize(1200)
    running.prefer("light")
    running.command("Page.reload")
    until_drawn(running)
    yield running
    assert running.log() == []
    assert running.run(OUTSIDE) == []


def press(browser: Browser, x: float, y: float) -> None:
    for kind in ("mousePressed", "mouseReleased"):
        browser.command(
            "Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1
        )


def test_a_click_on_a_camera_shows_its_photograph(browser: Browser) -> None:
    browser.run("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    assert not browser.run(DIALOG)
    press(browser, *browser.run(PLACE_OF_CAMERA, "3 c.png: bridged by"))
    assert browser.run(DIALOG)
    same = """return document.querySelector("#photo img").src ===
        document.querySelectorAll("#sheet img")[2].src"""
    assert browser.run(same)
    assert "12 of 15 depths" in browser.run("return document.getElementById('photo').innerText")
    browser.click("#photo [data-step='1']")
    assert "d.png" in browser.run("return document.getElementById('photo').innerText")
    browser.click("#photo [data-step='0']")
    assert not browser.run(DIALOG)


def test_photographs_open_and_panels_grow_with_one_click(browser: Browser) -> None:
    browser.click("#sheet [data-open='0']")
    assert NAMES[0] in browser.run("return document.getElementById('photo').innerText")
    browser.click("#photo [data-step='0']")
    browser.click("#model .enlarge")
    width = "return document.querySelector('.panel.large').getBoundingClientRect().width"
    assert browser.run(width) >= 1180
    browser.click("#model .enlarge")
    browser.click("#filters [data-group=missing]")
    visible = "return [...document.querySelectorAll('#sheet > li')].filter((c) => !c.hidden).length"
    assert browser.run(visible) == 2


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1400])
def test_page_fits_and_is_readable(browser: Browser, scheme: str, width: int) -> None:
    assert_fits_and_is_readable(browser, scheme, width)


def test_no_table_scrolls_on_a_phone(browser: Browser) -> None:
    browser.resize(390)
    table = "const table = document.querySelector('.scroll');"
    assert browser.run(f"{table} return table.scrollWidth - table.clientWidth") == 0
