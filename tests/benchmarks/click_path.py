"""The way through the page of a run: what a newcomer clicks and reads to find what, and how long.

Each way is clicked in headless Chromium. A person's seconds are told by the keystroke-level model
(Card, Moran and Newell 1980: 2.65 s a click with its thought) and four words a second. Usage:

    python tests/benchmarks/click_path.py --pages out/report.html --width 390

Wants a page that has a reason why a photograph is not sure. Prints a table.
"""

from __future__ import annotations

import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from machine import describe_machine, parser_of, table

sys.path.append(str(Path(__file__).parents[1]))

from browser import Browser, chromium, until_drawn

CLICK_S = 2.65  # pointing 1.1, pressing 0.2, thinking 1.35; source above
WORDS_PER_SECOND = 4.0  # of silent reading
# Of the six points that a lost photograph needs, shares of a photograph
PLACES = ((0.3, 0.3), (0.5, 0.3), (0.7, 0.3), (0.3, 0.6), (0.5, 0.6), (0.7, 0.6))
PAUSE_S = 0.3  # until the page has drawn what a click asks for
HEADER = ("page", "way", "clicks", "words", "script, s", "a person, s", "answer")
MIDDLE = """const element = document.querySelectorAll(arguments[0])[arguments[1]];
    element.scrollIntoView({block: "center"});
    const box = element.getBoundingClientRect();
    return [box.left, box.top, box.width, box.height]"""
TEXT = "return document.querySelector(arguments[0])?.innerText ?? ''"
CHOOSE = """const list = document.querySelectorAll(arguments[0])[arguments[1]];
    list.value = arguments[2];
    list.dispatchEvent(new Event("change"))"""
LISTS = "#tie-points figure select"
CANVASES = "#tie-points canvas"
THIRD = """const shown = [...document.querySelectorAll("#tie-points figure select")]
    .map((list) => Number(list.value));
    const {cameras} = page.data.views[0];
    return cameras.map(({index}) => index).find((index) => !shown.includes(index))"""
NUM_MARKS = "return document.querySelectorAll('#tie-points tbody tr').length"


@dataclass
class Way:
    """A way through a page, while it is gone.

    Attributes:
        browser: with the page.
        clicks: so far.
        words: that were read.
    """

    browser: Browser
    clicks: int = 0
    words: int = 0

    def click(
        self, selector: str, number: int = 0, at: tuple[float, float] = (0.5, 0.5)
    ) -> None:
        """Click into an element.

        Args:
            selector: of elements.
            number: of them, which one.
            at: place in it, shares of its width and height.
        """
        left, top, width, height = self.browser.run(MIDDLE, selector, number)
        self.browser.press(left + at[0] * width, top + at[1] * height)
        self.clicks += 1
        time.sleep(PAUSE_S)

    def choose(self, selector: str, number: int, value: object) -> None:
        """Choose from a list, which takes two clicks."""
        self.browser.run(CHOOSE, selector, number, str(value))
        self.clicks += 2
        time.sleep(PAUSE_S)

    def read(self, selector: str) -> str:
        """Read the text of an element."""
        text = str(self.browser.run(TEXT, selector))
        self.words += len(text.split())
        return text

    @property
    def person_s(self) -> float:
        """Seconds that a person takes."""
        return self.clicks * CLICK_S + self.words / WORDS_PER_SECOND


def find_doubtful(way: Way) -> str:
    """Find which photographs are doubtful, and why."""
    way.read("h1")
    way.read("#doubts")
    way.click("#doubts .ref")
    why = way.read("#photo .caption")
    way.read("#photo .facts")
    return why


def find_what_two_share(way: Way) -> str:
    """Find what a photograph shares with the one that it shares most with."""
    way.click("#doubts .ref")
    way.read("#photo .shares")
    way.click("#photo [data-pair]")
    return way.read("#pair .readout")


def find_who_sees_a_point(way: Way) -> str:
    """Look through a photograph, and find where a point is seen."""
    way.choose("#look select", 0, way.browser.run(FIRST_PLACED))
    way.click("#model canvas")
    way.browser.key(" ")  # the point that is nearest to the middle
    time.sleep(PAUSE_S)
    return way.read("#model .seen .note")


FIRST_PLACED = "return page.data.views[0].cameras[0].index"


def find_what_to_do(way: Way) -> str:
    """Find what to do next."""
    return way.read(".next-step")


def mark_a_lost_photograph(way: Way) -> str:
    """Mark six points in a photograph that is not placed and in two of the model."""
    way.read(".next-step")
    way.click("#tie-points summary")
    if not way.browser.run("return document.querySelector('#tie-points details').open"):
        way.click("#tie-points summary")
    way.read("#tie-points > .note")
    way.read("#tie-help")
    for number, place in enumerate(PLACES):
        if number:
            way.click("#tie-points [data-part=next]")
        way.click(CANVASES, 0, place)
        way.click(CANVASES, 1, place)
    way.choose(LISTS, 1, way.browser.run(THIRD))
    way.choose("#tie-points [data-part=point]", 0, 1)
    for number, place in enumerate(PLACES):
        if number:
            way.click("#tie-points [data-part=next]")
        way.click(CANVASES, 1, place)
    return f"{way.browser.run(NUM_MARKS)} marks"


def mask_a_caption(way: Way) -> str:
    """Cover a strip at the lower border of a photograph, and save the mask."""
    way.click("#sheet [data-open]")
    way.click("#photo [data-mask]")
    way.read("#masks .note")
    left, top, width, height = way.browser.run(MIDDLE, "#masks canvas", 0)
    corners = ((0.05, 0.88), (0.95, 0.98))
    for kind, at in (("mousePressed", 0), ("mouseMoved", 1), ("mouseReleased", 1)):
        x = left + corners[at][0] * width
        y = top + corners[at][1] * height
        more = {"button": "left", "buttons": 1, "clickCount": 1}
        way.browser.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)
    way.clicks += 2  # both ends of a drag
    way.click("#masks [data-part=save]")
    return way.read("#masks [data-part=said]")


WAYS: dict[str, Callable[[Way], str]] = {
    "which is doubtful, and why": find_doubtful,
    "what two share": find_what_two_share,
    "where a point is seen": find_who_sees_a_point,
    "what to do next": find_what_to_do,
    "mark a lost photograph": mark_a_lost_photograph,
    "mask a caption": mask_a_caption,
}


def rows_of(browser: Browser, page: Path) -> list[list[str]]:
    """Go all ways through a page, each from its beginning; return cells."""
    rows = []
    for name, go in WAYS.items():
        browser.open(page)
        until_drawn(browser)
        way = Way(browser)
        begin_s = time.monotonic()
        answer = go(way).replace("\n", " ")
        passed_s = time.monotonic() - begin_s
        numbers = [str(way.clicks), str(way.words), f"{passed_s:.1f}"]
        numbers.append(f"{way.person_s:.0f}")
        rows.append([page.parent.name, name, *numbers, answer[:60]])
        browser.run("localStorage.clear()")
    return rows


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument("--pages", nargs="+", type=Path, required=True)
    parser.add_argument("--width", type=int, default=1400, help="of the window, px")
    return parser.parse_args()


def main() -> None:
    """Go the ways and print the table."""
    arguments = parsed_arguments()
    rows = []
    with (
        tempfile.TemporaryDirectory() as profile,
        tempfile.TemporaryDirectory() as downloads,
        chromium(Path(profile)) as browser,
    ):
        browser.resize(arguments.width)
        where = {"behavior": "allow", "downloadPath": downloads}
        browser.command("Page.setDownloadBehavior", **where)
        for page in arguments.pages:
            rows += rows_of(browser, page)
        said = browser.log()
    print(f"{describe_machine()}\n\n{table(HEADER, rows)}")
    if said:
        raise SystemExit(f"the console says {said}")


if __name__ == "__main__":
    main()
