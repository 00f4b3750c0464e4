"""Take the pictures of docs/tour.md and other pages: real commands on a sample scene, real pages.

The scene is rendered to look like old plates (sample_scenes/README.md), and may be copied. Two runs
come first; what they have done already stays, so that pictures can be taken again:

    python docs/tour.py out/tour

Needs Chromium and chromedriver, as the tests of the pages do.
"""

from __future__ import annotations

import base64
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))
sys.path.insert(0, str(ROOT))

from browser import Browser, chromium

import colmap_affrect

PHOTOGRAPHS = Path("sample_scenes/courtyard_historical/images")
PICTURES = ROOT / "docs" / "pictures"
WIDTH = 1100  # px of the window
PICTURE_WIDTH = 900  # px
MARGIN = 12  # px around an element
PHONE_WIDTH = 390
JPEG_QUALITY = 75
MARKED = "plate_1.jpg"  # which the run without warps has in another model

PLACE = """const element = document.querySelector(arguments[0]);
    element.scrollIntoView({block: "start"});
    const box = element.getBoundingClientRect();
    return [box.left + scrollX, box.top + scrollY, box.width, box.height]"""
CANVAS = """const canvas = document.querySelectorAll(arguments[0])[arguments[1]];
    canvas.scrollIntoView({block: "center"});
    const box = canvas.getBoundingClientRect();
    return [box.left, box.top, box.width, box.height]"""
CHOOSE = """const list = document.querySelectorAll("#tie-points figure select")[arguments[0]];
    list.value = String(arguments[1]);
    list.dispatchEvent(new Event("change"))"""
SLIDE = """const slider = document.getElementById("before-after");
    slider.value = arguments[0];
    slider.dispatchEvent(new Event("input"))"""
CHOOSE_PAIR = """document.querySelectorAll("#pair-choice select").forEach((list, side) => {
      list.value = String(arguments[side]);
      list.dispatchEvent(new Event("change"));
    })"""


def main() -> None:
    """Run the commands and take all pictures."""
    folder = Path(sys.argv[1])
    PICTURES.mkdir(exist_ok=True)
    command("run", "--image-path", PHOTOGRAPHS, "--output-path", folder / "plain",
            "--recipe", "unrectified-rootsift")  # fmt: skip
    command("run", "--image-path", PHOTOGRAPHS, "--output-path", folder / "out")
    draw_photographs()
    draw_by_commands(folder)
    with (
        tempfile.TemporaryDirectory() as profile,
        chromium(Path(profile)) as browser,
    ):
        show_run(browser, folder / "out" / "report.html")
        show_tools(browser, folder / "plain" / "report.html")
        show_before_and_after(browser, folder)
        show_in_notebook(browser, folder)


def command(*words: object) -> None:
    """Run the program; exit code 3 says that photographs are not registered."""
    given = [str(word) for word in words]
    run = [sys.executable, "-m", "colmap_affrect", *given]
    code = subprocess.run(run, cwd=ROOT, check=False).returncode
    if code not in (0, 3):
        raise SystemExit(f"{' '.join(given)}: ended with {code}")


def save(name: str, picture: np.ndarray, width: int = PICTURE_WIDTH) -> None:
    """Write a picture of at most some width, px."""
    share = min(1.0, width / picture.shape[1])
    if share < 1.0:
        picture = cv2.resize(
            picture, None, fx=share, fy=share, interpolation=cv2.INTER_AREA
        )
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    cv2.imwrite(str(PICTURES / f"{name}.jpg"), picture, quality)


def draw_photographs(height: int = 190) -> None:
    """Draw the photographs of the scene in two rows."""
    rows = []
    paths = sorted((ROOT / PHOTOGRAPHS).glob("*.jpg"))
    for row in (paths[:4], paths[4:]):
        parts = []
        for path in row:
            photograph = cv2.imread(str(path))
            share = height / photograph.shape[0]
            small = cv2.resize(
                photograph, None, fx=share, fy=share, interpolation=cv2.INTER_AREA
            )
            parts.append(
                cv2.copyMakeBorder(
                    small, 4, 4, 4, 4, cv2.BORDER_CONSTANT, value=(255, 255, 255)
                )
            )
        rows.append(np.hstack(parts))
    width = max(row.shape[1] for row in rows)
    filled = []
    for row in rows:
        missing = width - row.shape[1]
        filled.append(
            cv2.copyMakeBorder(
                row, 0, 0, 0, missing, cv2.BORDER_CONSTANT, value=(255, 255, 255)
            )
        )
    save("photographs", np.vstack(filled))


def draw_by_commands(folder: Path) -> None:
    """Take what lines, inspect and show-pair draw."""
    photograph = PHOTOGRAPHS / "plate_3.jpg"
    drawn = folder / "lines"
    command("lines", photograph, "--output-path", drawn)
    save("lines", cv2.imread(str(next(drawn.glob("plate_3*lines*.png")))), 700)
    sheets = folder / "inspection"
    command("inspect", PHOTOGRAPHS / "plate_2.jpg", "--output-path", sheets,
            "--recipe", "rectified")  # fmt: skip
    save("inspect", cv2.imread(str(sheets / "plate_2-inspection.png")))
    command("show-pair", folder / "out", "plate_2.jpg", "plate_3.jpg")
    pair = folder / "out" / "pairs" / "plate_2--plate_3.png"
    save("matches", cv2.imread(str(pair)))


def show_run(browser: Browser, page: Path) -> None:
    """Take the verdict, the model and a look through a photograph, on a desktop and a phone."""
    browser.resize(WIDTH)
    browser.open(page)
    time.sleep(1.0)
    take(browser, "verdict", "header")
    take(browser, "model", "#model")
    browser.run("page.lookThrough(3)")
    time.sleep(0.5)
    browser.run("document.querySelector('canvas').focus()")
    browser.key(" ")
    time.sleep(0.5)
    take(browser, "through", "#model figure")
    browser.run(CHOOSE_PAIR, 1, 2)
    time.sleep(0.5)
    take(browser, "pair", "#pair")
    browser.resize(PHONE_WIDTH)
    browser.open(page)
    time.sleep(1.0)
    take(browser, "phone", "header")


def show_tools(browser: Browser, page: Path) -> None:
    """Take the page of the run without warps, marks in it, and a mask."""
    browser.resize(WIDTH)
    browser.open(page)
    time.sleep(1.0)
    take(browser, "two-models", "header")
    browser.run("document.querySelector('#tie-points details').open = true")
    # It would stand over what is taken
    browser.run("document.querySelector('#tie-points .bar').style.position = 'static'")
    mark(browser, 0, 2, (0.62, 0.42))
    mark(browser, 1, 3, (0.53, 0.44))
    browser.run(CHOOSE, 1, 4)
    time.sleep(0.5)
    take(browser, "tie-points", "#tie-points .grid")
    take(browser, "places", "#tie-points [data-part='places']")
    browser.run("localStorage.clear()")
    browser.run("document.querySelector('#masks details').open = true")
    paint(browser, [(0.05, 0.86), (0.95, 0.98)])
    take(browser, "mask", "#masks details")
    browser.run("localStorage.clear()")


def show_before_and_after(browser: Browser, folder: Path) -> None:
    """Take the page of show-runs."""
    command("show-runs", folder / "plain", folder / "out")
    browser.resize(WIDTH)
    browser.open(folder / "out" / "compared.html")
    time.sleep(1.0)
    browser.run(SLIDE, 50)
    time.sleep(0.5)
    take(browser, "before-after", "#model")


def show_in_notebook(browser: Browser, folder: Path) -> None:
    """Take the report of a run as a notebook shows it."""
    report = colmap_affrect.run(
        ROOT / PHOTOGRAPHS, folder / "out", progress=False, page=False
    )
    table = report._repr_html_()
    page = folder / "notebook.html"
    style = (
        "<style>body { font: 14px sans-serif; margin: 1em; max-width: 60em }"
        "p:last-child { display: none }</style>"  # the folder on this machine
    )
    page.write_text(f"<!doctype html><meta charset=utf-8>{style}<div>{table}</div>")
    browser.open(page)
    take(browser, "notebook", "div")


def mark(
    browser: Browser, pane: int, photograph: int, place: tuple[float, float]
) -> None:
    """Choose a photograph of the tie point tool and click at a place, shares of the canvas."""
    browser.run(CHOOSE, pane, photograph)
    time.sleep(0.3)
    left, top, width, height = browser.run(CANVAS, "#tie-points canvas", pane)
    browser.press(round(left + place[0] * width), round(top + place[1] * height))


def paint(browser: Browser, corners: list[tuple[float, float]]) -> None:
    """Drag a rectangle in the photograph of the masks, by shares of its sides."""
    time.sleep(0.3)
    left, top, width, height = browser.run(CANVAS, "#masks canvas", 0)
    for kind, corner in (("mousePressed", 0), ("mouseMoved", 1), ("mouseReleased", 1)):
        x, y = corners[corner]
        browser.command(
            "Input.dispatchMouseEvent",
            type=kind,
            x=left + x * width,
            y=top + y * height,
            button="left",
            buttons=1,
        )
    time.sleep(0.3)


def take(browser: Browser, name: str, selector: str) -> None:
    """Take a picture of an element of the page as it looks."""
    x, y, width, height = browser.run(PLACE, selector)
    clip = {
        "x": max(0, x - MARGIN),
        "y": max(0, y - MARGIN),
        "width": width + 3 * MARGIN,  # the scroll bar goes away for the picture
        "height": height + 2 * MARGIN,
        "scale": 1,
    }
    found = browser.command(
        "Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True
    )
    data = np.frombuffer(base64.b64decode(found["data"]), np.uint8)
    save(name, cv2.imdecode(data, cv2.IMREAD_COLOR))


if __name__ == "__main__":
    main()
