"""A comparison of methods as one page, ``report.html``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_affrect.comparison.pose_scores import MAX_CORRECT_ERROR_DEG
from colmap_affrect.comparison.results import Comparison
from colmap_affrect.comparison.tables import (
    Column,
    columns_of,
    digits_of,
    span_text,
    summary_rows,
)
from colmap_affrect.comparison.verdict import cautions, changes, headline, wrong_poses
from colmap_affrect.options import flat
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.report import page, view_graph
from colmap_affrect.report.pictures import thumbnails
from colmap_affrect.report.scene import read_scene
from colmap_affrect.report.view_graph import Node

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"

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


def write_page(comparison: Comparison, output_path: Path, progress: Progress = SILENT) -> Path:
    """Write ``report.html`` into the folder of a comparison, and return its path.

    It is one file that loads nothing. Whatever is missing, such as a photograph that cannot be read
    or a model that is not there, is said in its place. Raises WorkspaceError when it cannot be
    written.
    """
    columns = columns_of(comparison)
    names, folder = comparison.image_names, Path(comparison.image_path)
    graphs = [column.method.seeds[0].pair_inliers for column in columns]
    cards = cards_of(columns, comparison)
    index = {name: number for number, name in enumerate(names)}
    layout = view_graph.lay_out(names, graphs)
    paths = {c.name: comparison.model_path(c.method, output_path) for c in columns}
    views = read_scene(paths)
    kinds = [{card.name: card.marks[number].kind for card in cards} for number in range(len(views))]
    content = {
        "comparison": comparison,
        "headline": headline(comparison),
        "changes": changes(comparison),
        "cautions": cautions(comparison),
        "bars": _bars(columns, len(names)),
        "has_wrong_poses": bool(wrong_poses(comparison)),
        "columns": columns,
        "failed": [method for method in comparison.methods if method.failed],
        "rows": summary_rows(columns, comparison),
        "filters": FILTERS,
        "cards": cards,
        "thumbnails": thumbnails(folder, names, progress),
        "image_index": index,
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "settings": flat(comparison.settings),
        "method_options": {c.name: flat(c.method.options) for c in columns},
        "layout": layout,
        "edges": [view_graph.edge_paths(names, layout, graph) for graph in graphs],
        "num_pairs": list(map(len, graphs)),
        "views": views,
        "kinds": KINDS,
        "script_data": {
            "matrices": [view_graph.matrix(names, graph) for graph in graphs],
            "views": [view.script_data(index, k) for view, k in zip(views, kinds, strict=True)],
        },
    }
    folders = [folder, output_path.resolve()]
    return page.write_page(output_path / "report.html", TEMPLATE, content, folders)


def _bars(columns: Sequence[Column], num_images: int) -> list[dict[str, Any]]:
    bars = []
    for column in columns:
        known = [span for span in (column.method.registered, column.method.correct) if span]
        first, *correct = (span_text(span, digits_of([span.mean], 1)) for span in known)
        text = ", ".join([f"{first} of {num_images}", *(f"{each} correct" for each in correct)])
        shares = [span.mean / max(1, num_images) for span in known]
        bars.append({"column": column, "shares": shares, "text": text})
    return bars


@dataclass(frozen=True)
class Mark(Node):
    """What one method does with one photograph."""

    column: Column
    is_uncertain: bool  # doubtful, and ground truth does not say that it is right

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        return "wrong" if self.is_wrong else "uncertain" if self.is_uncertain else "shared"


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet; it has the same number everywhere on the page."""

    number: int
    name: str
    marks: tuple[Mark, ...]
    groups: tuple[str, ...]


def cards_of(columns: Sequence[Column], comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    cards, with_truth = [], comparison.names_with_truth
    for number, name in enumerate(comparison.image_names, 1):
        marks = tuple(
            _mark(column, number, name, has_truth=name in with_truth) for column in columns
        )
        tests = {
            "all": True,
            "differ": len({name in c.method.usually_registered for c in columns}) > 1,
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": any(mark.is_wrong for mark in marks),
            "uncertain": any(mark.is_uncertain for mark in marks),
            "none": name in comparison.registered_by_none,
        }
        groups = tuple(group for group, passes in tests.items() if passes)
        cards.append(Card(number, name, marks, groups))
    return cards


def _mark(column: Column, number: int, name: str, *, has_truth: bool) -> Mark:
    method, seeds = column.method, column.method.seeds
    registering = [seed for seed in seeds if name in seed.registered_names]
    correct = [s for s in registering if s.scores is not None and name in s.scores.correct_names]
    state, text = "always", f"{column.name}: registered"
    if not registering:
        state, text = "never", f"{column.name}: not registered"
    elif len(registering) < len(seeds):
        state = "sometimes"
        text += f" with {len(registering)} of {len(seeds)} seeds"
    is_wrong = has_truth and len(correct) < len(registering)
    if is_wrong:
        text += f", correctly with {len(correct)}" if correct else ", wrongly"
    elif correct:
        text += ", correctly"
    doubt = method.usually_doubted.get(name)
    if doubt and (is_wrong or not has_truth):
        text += f", doubtful: {doubt}"
    is_uncertain = bool(doubt) and not has_truth
    return Mark(number, name, state, is_wrong, text, column=column, is_uncertain=is_uncertain)
