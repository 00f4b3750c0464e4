"""A page in headless Chromium, driven by chromedriver, to click through as a person would."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""Key of an element in WebDriver's JSON."""

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))),
    "",
)
needs_chromium = pytest.mark.skipif(
    not (CHROMIUM and shutil.which("chromedriver")),
    reason="Chromium or chromedriver is missing",
)


class BrowserError(Exception):
    """What chromedriver says of a command that failed."""


def _call(address: str, method: str = "POST", **arguments: Any) -> Any:
    """Send a command of WebDriver and return its value."""
    data = json.dumps(arguments).encode()
    headers = {"Content-Type": "application/json"}
    request = urllib.request.Request(address, data, headers, method=method)
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]
    except urllib.error.HTTPError as error:
        raise BrowserError(json.load(error)["value"]["message"]) from None


class Browser:
    """A page in headless Chromium."""

    def __init__(self, address: str) -> None:
        self._address = address

    def open(self, page: Path) -> None:
        self.visit(page.resolve().as_uri())

    def visit(self, address: str) -> None:
        _call(f"{self._address}/url", url=address)

    def reload(self) -> None:
        """Load the page again, and wait until it is there."""
        _call(f"{self._address}/refresh")

    def run(self, script: str, *arguments: Any) -> Any:
        """Run a function body in the page and return what it returns."""
        return _call(
            f"{self._address}/execute/sync", script=script, args=list(arguments)
        )

    def click(self, selector: str) -> None:
        """Click as a person would: fails if the element is not visible."""
        _call(f"{self._found(selector)}/click")

    def command(self, name: str, **parameters: Any) -> Any:
        """Send a command of the DevTools protocol."""
        return _call(f"{self._address}/goog/cdp/execute", cmd=name, params=parameters)

    def press(self, x: float, y: float) -> None:
        """Click at a place of the window, px."""
        for kind in ("mousePressed", "mouseReleased"):
            self.command(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                clickCount=1,
            )

    def key(self, name: str, *, is_ctrl: bool = False) -> None:
        """Press a key, called as in JavaScript."""
        for kind in ("rawKeyDown", "keyUp"):
            self.command(
                "Input.dispatchKeyEvent", type=kind, key=name, modifiers=2 * is_ctrl
            )

    def give_files(self, selector: str, *paths: Path) -> None:
        """Give files to an input, as if they had been chosen."""
        files = "\n".join(str(path.resolve()) for path in paths)
        _call(f"{self._found(selector)}/value", text=files)

    def _found(self, selector: str) -> str:
        found = _call(f"{self._address}/element", using="css selector", value=selector)
        return f"{self._address}/element/{found[ELEMENT]}"

    def resize(self, width: int, height: int = 800) -> None:
        sizes = {"width": width, "height": height, "deviceScaleFactor": 1}
        self.command("Emulation.setDeviceMetricsOverride", **sizes, mobile=width < 500)

    def prefer(self, scheme: str) -> None:
        """Choose light or dark."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.command("Emulation.setEmulatedMedia", features=features)

    def log(self) -> list[str]:
        """What the console has said since the last call."""
        return [
            entry["message"]
            for entry in _call(f"{self._address}/se/log", type="browser")
        ]


@contextmanager
def chromium(profile: Path) -> Iterator[Browser]:
    """Start Chromium with a new profile folder, and end it."""
    driver = subprocess.Popen(
        ["chromedriver", "--port=0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
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


def assert_fits_and_is_readable(browser: Browser, scheme: str, width: int) -> None:
    """Nothing sticks out of the window, and all texts have contrast, in light or dark."""
    browser.prefer(scheme)
    browser.resize(width)
    overflow = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
    assert browser.run(overflow) == 0
    assert browser.run(LOW_CONTRASTS) == []


def until_drawn(browser: Browser) -> str:
    """Wait until the first model is on its canvas and return the picture."""
    return until_changed(browser, "")


def until_changed(browser: Browser, before: str) -> str:
    """Wait until the first model looks different and return the picture."""
    for _ in range(100):
        if (now := browser.run(FIRST_MODEL)) not in ("", before):
            return str(now)
        time.sleep(0.02)
    pytest.fail("nothing new was drawn")
