"""A comparison of methods as one page, ``report.html``."""

from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.comparison.results import MAX_CORRECT_ERROR_DEG, Comparison, MethodResult
from colmap_affrect.comparison.tables import headline, notes, table
from colmap_affrect.options import flat
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.report import page
from colmap_affrect.report.scene import read_view

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"


@dataclass(frozen=True)
class Mark:
    """What one method does with one photograph."""

    state: str  # ``always``, ``sometimes`` or ``never`` registered, over the seeds
    kind: str  # ``shared`` (nothing is the matter), ``uncertain`` or ``wrong``: names of colours
    text: str


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    marks: tuple[Mark, ...]  # of the methods that finished, the best first
    groups: tuple[str, ...]  # what the buttons above the sheet choose by


def write_page(comparison: Comparison, output_path: Path, progress: Progress = SILENT) -> Path:
    """Write ``report.html``, one file that loads nothing, and return its path.

    What is missing, as an unreadable photograph, is said in its place. Raises WorkspaceError.
    """
    names, cards = comparison.image_names, cards_of(comparison)
    shown = [method.shown_seed for method in comparison.finished]
    views = [read_view(output_path / seed.model_path if seed else None) for seed in shown]
    kinds = [{card.name: card.marks[number].kind for card in cards} for number in range(len(views))]
    content = {
        "comparison": comparison,
        "headline": headline(comparison),
        "notes": notes(comparison),
        "methods": comparison.finished,
        "table": table(comparison),
        "cards": cards,
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "flat": flat,
        "views": views,
    }
    drawn, path = zip(views, kinds, strict=True), output_path / "report.html"
    folder = Path(comparison.image_path)
    return page.write_page(path, TEMPLATE, content, names, folder, drawn, progress)


def cards_of(comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    methods, cards = comparison.finished, []
    for name in comparison.image_names:
        marks = tuple(_mark(method, name) for method in methods)
        kinds = {mark.kind for mark in marks}
        registered = comparison.registered_by[name]
        tests = {
            "all": True,
            "differ": 0 < len(registered) < len(methods),
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": "wrong" in kinds,
            "uncertain": "uncertain" in kinds,
            "none": not registered,
        }
        cards.append(Card(name, marks, tuple(group for group in tests if tests[group])))
    return cards


def _mark(method: MethodResult, name: str) -> Mark:
    registering = [seed for seed in method.seeds if name in seed.registered_names]
    state, kind, text = "always", "shared", f"{method.name}: registered"
    if not registering:
        return Mark("never", kind, f"{method.name}: not registered")
    if len(registering) < len(method.seeds):
        state = "sometimes"
        text += f" with {len(registering)} of {len(method.seeds)} seeds"
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
    return Mark(state, kind, text)
