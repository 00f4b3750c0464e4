"""Clicks through the page as a person would, in headless Chromium."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import browser as chromium
import pytest
from browser import Browser
from small_comparison import make_comparison

from colmap_affrect.report.page import write_page

REASON = chromium.missing()

pytestmark = pytest.mark.skipif(bool(REASON), reason=REASON)


@pytest.fixture(scope="module")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison")
    return write_page(make_comparison(folder), folder)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium.browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def browser(running: Browser, page_path: Path) -> Iterator[Browser]:
    """The page on a desktop, in light colours; the console must stay empty."""
    running.resize(1200)
    running.prefer("light")
    running.open(page_path)
    yield running
    assert running.log() == []


VISIBLE_CARDS = """return [...document.querySelectorAll("#sheet > li")]
    .filter((card) => card.offsetParent !== null).length"""

FIRST_MODEL = """const canvas = document.querySelector("canvas");
    return canvas.width === 300 ? "" : canvas.toDataURL()  // 300: not yet sized"""

LOW_CONTRASTS = """
    const parse = (text) => text.match(/[\\d.]+/g).map(Number);
    const light = (color) => {
      const [r, g, b] = color.map((value) => value / 255)
        .map((value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4));
      return 0.2126 * r + 0.7152 * g + 0.0722 * b;
    };
    const ground = (element) => {
      for (let at = element; at; at = at.parentElement) {
        const color = parse(getComputedStyle(at).backgroundColor);
        if (color.length === 3 || color[3] > 0.5) return color.slice(0, 3);
      }
      return [255, 255, 255];
    };
    const found = [];
    for (const element of document.body.querySelectorAll("*")) {
      if (element.closest("svg, script, .spoken") || element.offsetParent === null) continue;
      const texts = [...element.childNodes].filter((node) => node.nodeType === 3);
      if (!texts.some((node) => node.data.trim())) continue;
      const one = light(parse(getComputedStyle(element).color).slice(0, 3));
      const two = light(ground(element));
      const contrast = (Math.max(one, two) + 0.05) / (Math.min(one, two) + 0.05);
      if (contrast < 4.5) found.push([element.outerHTML.slice(0, 80), contrast]);
    }
    return found"""


def until_drawn(browser: Browser) -> str:
    """Wait until the first model is on its canvas and return the picture."""
    for _ in range(50):
        time.sleep(0.02)
        if drawn := browser.run(FIRST_MODEL):
            return str(drawn)
    pytest.fail("nothing was drawn")


def until_changed(browser: Browser, before: str) -> str:
    """Wait until the first model looks different and return the picture."""
    for _ in range(50):
        now = until_drawn(browser)
        if now != before:
            return now
    pytest.fail("the picture stays as it was")


def test_filters_show_the_photographs_they_count(browser: Browser) -> None:
    assert browser.run(VISIBLE_CARDS) == 6
    for group, count in (("seeds", 1), ("wrong", 1), ("none", 2), ("all", 6)):
        browser.click(f"#filters [data-group={group}]")
        assert browser.run(VISIBLE_CARDS) == count
        pressed = "return document.querySelector('#filters [aria-pressed=true]').textContent"
        assert f"({count})" in browser.run(pressed)
    assert browser.run("return document.getElementById('shown').textContent") == (
        "6 of 6 photographs shown"
    )


def test_models_turn_and_zoom(browser: Browser) -> None:
    seen = [until_drawn(browser)]
    for view in ("right", "in", "side"):
        browser.click(f"#view [data-view={view}]")
        seen.append(until_changed(browser, seen[-1]))
    browser.run("document.querySelector('canvas').focus()")
    key = "document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))"
    browser.run(key)
    seen.append(until_changed(browser, seen[-1]))
    browser.click("#view [data-view=top]")
    assert until_changed(browser, seen[-1]) == seen[0]


def test_pointing_at_a_cell_reads_it(browser: Browser) -> None:
    script = """const [selector, right, down] = arguments;
        const matrix = document.querySelector(selector);
        const at = matrix.querySelector(".ground").getBoundingClientRect();
        const place = {clientX: at.left + right * at.width, clientY: at.top + down * at.height};
        matrix.dispatchEvent(new PointerEvent("pointermove", place));
        return matrix.parentElement.querySelector(".readout").textContent"""
    text = browser.run(script, "[data-matrix='1']", 1.5 / 6, 0.5 / 6)
    assert text.startswith("1 <img src=x onerror=alert(1)>.png \N{EN DASH} 2 a & b.png: ")
    assert int(text.split(": ")[1].removesuffix(" inliers")) > 0
    text = browser.run(script, "[data-matrix='0']", 1.5 / 6, 0.5 / 6)
    assert text.endswith(": no inliers")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1200])
def test_page_fits_and_is_readable(browser: Browser, scheme: str, width: int) -> None:
    browser.prefer(scheme)
    browser.resize(width)
    overflow = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert browser.run(overflow) == 0
    assert browser.run(LOW_CONTRASTS) == []
    ground = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (ground == "rgb(255, 255, 255)") == (scheme == "light")


def test_still_pictures_stand_in_for_the_models_in_print(browser: Browser) -> None:
    browser.command("Emulation.setEmulatedMedia", media="print")
    shown = "return getComputedStyle(document.querySelector(arguments[0])).display"
    try:
        assert browser.run(shown, "canvas") == "none"
        assert browser.run(shown, ".still") == "block"
    finally:
        browser.command("Emulation.setEmulatedMedia", media="")


def test_page_of_200_photographs_opens_in_3_seconds(
    running: Browser, large_page_path: Path
) -> None:
    start = time.monotonic()
    running.open(large_page_path)
    until_drawn(running)
    assert time.monotonic() - start < 3.0
    assert running.log() == []
