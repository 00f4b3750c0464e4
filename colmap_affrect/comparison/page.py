"""A comparison of methods as one page, ``report.html``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.comparison.results import (
    MAX_CORRECT_ERROR_DEG,
    Comparison,
    MethodResult,
    SeedResult,
)
from colmap_affrect.comparison.tables import conclusion, headline, notes, table
from colmap_affrect.options import flat
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.report.page import Page
from colmap_affrect.report.page import write_page as write_any_page
from colmap_affrect.report.scene import read_view

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"


@dataclass(frozen=True)
class Mark:
    """What one method does with one photograph."""

    state: str  # with how many seeds it is registered: ``always``, ``sometimes`` or ``never``
    kind: str  # name of a colour: ``shared`` (nothing is the matter), ``uncertain`` or ``wrong``
    text: str


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet."""

    name: str
    marks: tuple[Mark, ...]  # of the methods that finished, the best first
    groups: tuple[str, ...]  # what the buttons above the sheet choose by


def write_page(
    comparison: Comparison, output_path: Path, progress: Progress = SILENT
) -> Path:
    """Write ``report.html``, one file that loads nothing.

    Where a photograph cannot be read, or there is no model, the page says so.

    Args:
        comparison: what is shown.
        output_path: folder of the comparison, which has the models.
        progress: where to show it.

    Returns:
        The path of the page.

    Raises:
        WorkspaceError: the page cannot be written.
    """
    cards = contact_sheet(comparison)
    views = []
    for number, method in enumerate(comparison.finished):
        seed = method.shown_seed
        kinds = {card.name: card.marks[number].kind for card in cards}
        views.append(read_view(output_path / seed.model_path if seed else None, kinds))
    page = Page(
        template=TEMPLATE,
        content={
            "comparison": comparison,
            "conclusion": conclusion(comparison),
            "headline": headline(comparison),
            "notes": notes(comparison),
            "methods": comparison.finished,
            "table": table(comparison),
            "cards": cards,
            "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
            "flat": flat,
            "views": views,
        },
        names=comparison.image_names,
        image_path=Path(comparison.image_path),
        views=views,
    )
    return write_any_page(output_path / "report.html", page, progress)


def contact_sheet(comparison: Comparison) -> list[Card]:
    """Return all photographs with what each method does with them."""
    methods = comparison.finished
    cards = []
    for name in comparison.image_names:
        marks = tuple(_mark(method, name) for method in methods)
        states = {mark.state for mark in marks}
        kinds = {mark.kind for mark in marks}
        num_registered = len(comparison.registered_by[name])
        is_in_group = {
            "all": True,
            "differ": 0 < num_registered < len(methods),
            "seeds": "sometimes" in states,
            "wrong": "wrong" in kinds,
            "uncertain": "uncertain" in kinds,
            "none": num_registered == 0,
        }
        groups = tuple(group for group, is_in in is_in_group.items() if is_in)
        cards.append(Card(name, marks, groups))
    return cards


def _mark(method: MethodResult, name: str) -> Mark:
    """Return what a method does with a photograph, over all seeds."""
    registering = [seed for seed in method.seeds if name in seed.registered_names]
    if not registering:
        return Mark("never", "shared", f"{method.name}: not registered")
    state = "always"
    text = f"{method.name}: registered"
    if len(registering) < len(method.seeds):
        state = "sometimes"
        text += f" with {len(registering)} of {len(method.seeds)} seeds"
    doubt = method.usually_doubted.get(name)
    kind, correctness = _correctness(registering, name)
    if doubt and not correctness:
        kind = "uncertain"
    text += correctness
    if doubt and kind != "shared":
        text += f", doubtful: {doubt}"
    return Mark(state, kind, text)


def _correctness(seeds: Sequence[SeedResult], name: str) -> tuple[str, str]:
    """Return the colour and the words for how a photograph compares with ground truth."""
    num_correct = 0
    num_wrong = 0
    for seed in seeds:
        if seed.scores:
            num_correct += name in seed.scores.correct_names
            num_wrong += name in seed.scores.wrong_names
    if num_wrong and num_correct:
        return "wrong", f", correctly with {num_correct}"
    if num_wrong:
        return "wrong", ", wrongly"
    return "shared", ", correctly" if num_correct else ""
