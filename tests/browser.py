"""Drives Chromium through chromedriver, with nothing but the standard library."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
"""Key of an element in WebDriver's JSON."""

CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def missing() -> str:
    """What is not installed; empty if all is there."""
    if not shutil.which("chromedriver"):
        return "chromedriver is not installed"
    if not any(map(shutil.which, CHROMIUM_NAMES)):
        return "Chromium is not installed"
    return ""


class Browser:
    """A page in headless Chromium."""

    def __init__(self, address: str) -> None:
        self._address = address

    def _call(self, path: str, **arguments: Any) -> Any:
        request = urllib.request.Request(
            f"{self._address}/{path}",
            json.dumps(arguments).encode(),
            {"Content-Type": "application/json"},
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]

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

    def screenshot(self, path: Path) -> None:
        """Write the whole page as PNG."""
        answer = self.command("Page.captureScreenshot", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(answer["data"]))

    def log(self) -> list[str]:
        """What the console has said since the last call."""
        return [entry["message"] for entry in self._call("se/log", type="browser")]


@contextmanager
def browser(profile: Path) -> Iterator[Browser]:
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
        binary = next(filter(None, map(shutil.which, CHROMIUM_NAMES)))
        wanted = {
            "goog:chromeOptions": {"args": arguments, "binary": binary},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        request = urllib.request.Request(
            address,
            json.dumps({"capabilities": {"alwaysMatch": wanted}}).encode(),
            {"Content-Type": "application/json"},
        )
        with urllib.request.urlopen(request, timeout=60) as answer:
            session = json.load(answer)["value"]["sessionId"]
        yield Browser(f"{address}/{session}")
        urllib.request.urlopen(
            urllib.request.Request(f"{address}/{session}", method="DELETE"), timeout=60
        ).close()
    finally:
        driver.terminate()
        driver.wait(10)
        if driver.stdout is not None:
            driver.stdout.close()
