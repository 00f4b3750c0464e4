"""Clicks through the page of a comparison as a person would."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from browser import (
    Browser,
    assert_fits_and_is_readable,
    chromium,
    needs_chromium,
    until_changed,
    until_drawn,
)
from small_comparison import make_comparison

from colmap_affrect.comparison.page import write_page

pytestmark = [needs_chromium, pytest.mark.long]


@pytest.fixture(scope="module")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("comparison")
    return write_page(make_comparison(folder), folder)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with chromium(tmp_path_factory.mktemp("profile")) as found:
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
    for view in ("right", "in", "top"):
        browser.click(f"#view [data-view={view}]")
        seen.append(until_changed(browser, seen[-1]))
    browser.run("document.querySelector('canvas').focus()")
    key = "document.activeElement.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))"
    browser.run(key)
    seen.append(until_changed(browser, seen[-1]))
    browser.click("#view [data-view=front]")
    assert until_changed(browser, seen[-1]) == seen[0]


def test_pointing_at_a_cell_reads_it(browser: Browser) -> None:
    script = """const [selector, right, down] = arguments;
        const matrix = document.querySelector(selector);
        const at = matrix.querySelector(".ground").getBoundingClientRect();
        const place = {clientX: at.left + right * at.width, clientY: at.top + down * at.height};
        matrix.dispatchEvent(new PointerEvent("pointermove", place));
        return matrix.parentElement.querySelector(".readout").textContent"""
    text = browser.run(script, "[data-matrix='0']", 1.5 / 6, 0.5 / 6)
    assert text.startswith("1 <img src=x onerror=alert(1)>.png \N{EN DASH} 2 a & b.png: ")
    assert int(text.split(": ")[1].removesuffix(" inliers")) > 0
    text = browser.run(script, "[data-matrix='1']", 1.5 / 6, 0.5 / 6)
    assert text.endswith(": no inliers")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1200])
def test_page_fits_and_is_readable(browser: Browser, scheme: str, width: int) -> None:
    assert_fits_and_is_readable(browser, scheme, width)
    ground = browser.run("return getComputedStyle(document.body).backgroundColor")
    assert (ground == "rgb(255, 255, 255)") == (scheme == "light")
