"""A comparison of methods as one page, ``report.html``."""

import itertools
import string
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.comparison.results import MAX_CORRECT_ERROR_DEG, Comparison, MethodResult
from colmap_affrect.comparison.tables import headline, notes, table
from colmap_affrect.options import flat
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.report import page
from colmap_affrect.report.scene import read_view

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"

METHOD_COLORS = (
    "#0b62a8", "#a34700", "#00714f", "#9b2d79", "#5d4bb0", "#7a5c00", "#a3213b", "#46606e",
)  # fmt: skip
"""Of the marks of methods; white text on them is readable."""
FILTERS = {
    "all": "All",
    "differ": "Methods differ",
    "seeds": "Seeds disagree",
    "wrong": "Registered wrongly",
    "uncertain": "Doubtful",
    "none": "Registered by none",
}
KINDS = {"shared": "registered", "uncertain": "doubtful", "wrong": "at a wrong place"}
"""How cameras are drawn; each has a colour of this name."""


@dataclass(frozen=True)
class Column:
    """A method that finished, as it is marked everywhere on the page."""

    letter: str
    color: str
    method: MethodResult


@dataclass(frozen=True)
class Mark:
    """What one method does with one photograph."""

    column: Column
    state: str  # ``always``, ``sometimes`` or ``never`` registered, over the seeds
    kind: str  # one of ``KINDS``
    text: str


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    marks: tuple[Mark, ...]
    groups: tuple[str, ...]


def write_page(comparison: Comparison, output_path: Path, progress: Progress = SILENT) -> Path:
    """Write ``report.html``, one file that loads nothing, and return its path.

    What is missing, as an unreadable photograph, is said in its place. Raises WorkspaceError.
    """
    columns = columns_of(comparison)
    names, folder = comparison.image_names, Path(comparison.image_path)
    cards = cards_of(columns, comparison)
    shown = [column.method.shown_seed for column in columns]
    views = [read_view(output_path / seed.model_path if seed else None) for seed in shown]
    kinds = [{card.name: card.marks[number].kind for card in cards} for number in range(len(views))]
    content = {
        "comparison": comparison,
        "headline": headline(comparison),
        "notes": notes(comparison),
        "columns": columns,
        "table": table(comparison),
        "filters": FILTERS,
        "cards": cards,
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "flat": flat,
        "views": views,
        "kinds": KINDS,
    }
    drawn, path = zip(views, kinds, strict=True), output_path / "report.html"
    return page.write_page(path, TEMPLATE, content, names, folder, drawn, progress)


def columns_of(comparison: Comparison) -> list[Column]:
    """Give each method that finished a letter and a colour, the best first."""
    letters = itertools.chain(string.ascii_uppercase, map(str, itertools.count(27)))
    return list(map(Column, letters, itertools.cycle(METHOD_COLORS), comparison.finished))


def cards_of(columns: list[Column], comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    cards = []
    for name in comparison.image_names:
        marks = tuple(_mark(column, name) for column in columns)
        kinds = {mark.kind for mark in marks}
        registered = comparison.registered_by[name]
        tests = {
            "all": True,
            "differ": 0 < len(registered) < len(columns),
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": "wrong" in kinds,
            "uncertain": "uncertain" in kinds,
            "none": not registered,
        }
        cards.append(Card(name, marks, tuple(group for group in tests if tests[group])))
    return cards


def _mark(column: Column, name: str) -> Mark:
    method, seeds = column.method, column.method.seeds
    registering = [seed for seed in seeds if name in seed.registered_names]
    state, kind, text = "always", "shared", f"{method.name}: registered"
    if not registering:
        return Mark(column, "never", kind, f"{method.name}: not registered")
    if len(registering) < len(seeds):
        state = "sometimes"
        text += f" with {len(registering)} of {len(seeds)} seeds"
    scores = [seed.scores for seed in registering if seed.scores]
    num_correct = sum(name in each.correct_names for each in scores)
    doubt = method.usually_doubted.get(name)
    if any(name in each.wrong_names for each in scores):
        kind = "wrong"
        text += f", correctly with {num_correct}" if num_correct else ", wrongly"
    elif num_correct:
        text += ", correctly"
    elif doubt:
        kind = "uncertain"
    if doubt and kind != "shared":
        text += f", doubtful: {doubt}"
    return Mark(column, state, kind, text)
