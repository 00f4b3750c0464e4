"""Clicks through the page as a person would, in headless Chromium driven by chromedriver."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from small_comparison import make_comparison

from colmap_affrect.comparison.page import write_page

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""Key of an element in WebDriver's JSON."""

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), ""
)
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and shutil.which("chromedriver")), reason="Chromium or chromedriver is missing"
)


def _call(address: str, method: str = "POST", **arguments: Any) -> Any:
    """Send a command of WebDriver and return its value."""
    request = urllib.request.Request(
        address,
        json.dumps(arguments).encode(),
        {"Content-Type": "application/json"},
        method=method,
    )
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.load(answer)["value"]


class Browser:
    """A page in headless Chromium."""

    def __init__(self, address: str) -> None:
        self._address = address

    def _call(self, path: str, **arguments: Any) -> Any:
        return _call(f"{self._address}/{path}", **arguments)

    def open(self, page: Path) -> None:
        self._call("url", url=page.resolve().as_uri())

    def run(self, script: str, *arguments: Any) -> Any:
        """Run a function body in the page and return what it returns."""
        return self._call("execute/sync", script=script, args=list(arguments))

    def click(self, selector: str) -> None:
        """Click as a person would: fails if the element is not visible."""
        found = self._call("element", using="css selector", value=selector)
        self._call(f"element/{found[ELEMENT]}/click")

    def command(self, name: str, **parameters: Any) -> Any:
        """Send a command of the DevTools protocol."""
        return self._call("goog/cdp/execute", cmd=name, params=parameters)

    def resize(self, width: int, height: int = 800) -> None:
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=width < 500,
        )  # fmt: skip

    def prefer(self, scheme: str) -> None:
        """Choose light or dark."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.command("Emulation.setEmulatedMedia", features=features)

    def log(self) -> list[str]:
        """What the console has said since the last call."""
        return [entry["message"] for entry in self._call("se/log", type="browser")]


@contextmanager
def chromium(profile: Path) -> Iterator[Browser]:
    """Start Chromium with a new profile folder, and end it."""
    driver = subprocess.Popen(
        ["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    try:
        assert driver.stdout is not None
        started = next(line for line in driver.stdout if "started successfully" in line)
        port = started.rstrip(".\n").rpartition(" ")[2]
        address = f"http://127.0.0.1:{port}/session"
        arguments = [
            "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={profile}",
        ]  # fmt: skip
        wanted = {
            "goog:chromeOptions": {"args": arguments, "binary": CHROMIUM},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        session = _call(address, capabilities={"alwaysMatch": wanted})["sessionId"]
        yield Browser(f"{address}/{session}")
        _call(f"{address}/{session}", method="DELETE")
    finally:
        driver.terminate()
        driver.wait(10)
        if driver.stdout is not None:
            driver.stdout.close()


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
