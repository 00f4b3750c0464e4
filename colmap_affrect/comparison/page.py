"""A comparison of methods as one page, ``report.html``."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path
from typing import Any

from colmap_affrect.comparison.pose_scores import AUC_THRESHOLDS_DEG, MAX_CORRECT_ERROR_DEG
from colmap_affrect.comparison.results import Comparison, MethodResult
from colmap_affrect.comparison.tables import (
    Column,
    columns_of,
    digits_of,
    span_text,
    summary_rows,
)
from colmap_affrect.comparison.verdict import cautions, changes, headline, is_rectified, wrong_poses
from colmap_affrect.options import flat
from colmap_affrect.pairs.base import Pair
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.report import page, view_graph
from colmap_affrect.report.match_plots import MatchPlot, SideBySide, plot_inliers
from colmap_affrect.report.pictures import Picture, photograph_pictures, thumbnails
from colmap_affrect.report.scene import read_scene
from colmap_affrect.report.view_graph import Node

TEMPLATE = Path(__file__).parent / "templates" / "comparison.html"
FILE_NAME = "report.html"

MATCH_PICTURE_PX = 560
MAX_NUM_TABLE_PAIRS = 200


def write_page(comparison: Comparison, output_path: Path, progress: Progress = SILENT) -> Path:
    """Write ``report.html`` into the folder of a comparison, and return its path.

    It is one file that loads nothing. Whatever is missing, such as a photograph that cannot be read
    or a model that is not there, is said in its place. Raises WorkspaceError when it cannot be
    written.
    """
    columns = columns_of(comparison)
    methods = [column.method for column in columns]
    folder = Path(comparison.image_path)
    rectifying = [method.name for method in methods if is_rectified(method)]
    chosen = choose_pairs(methods, rectifying)
    of_pairs = list(dict.fromkeys(name for pair in chosen for name in pair))
    pair_pictures = photograph_pictures(folder, sorted(of_pairs), MATCH_PICTURE_PX)
    rows = pair_rows(methods)
    content = {
        "comparison": comparison,
        "headline": headline(comparison),
        "changes": changes(comparison),
        "cautions": cautions(comparison),
        "bars": _bars(columns, comparison),
        "has_wrong_poses": bool(wrong_poses(comparison)),
        "columns": columns,
        "column_of": {column.name: column for column in columns},
        "failed": [method for method in comparison.methods if method.failed],
        "rows": summary_rows(columns, comparison),
        "filters": FILTERS,
        "thumbnails": thumbnails(folder, comparison.image_names, progress),
        "image_index": {name: index for index, name in enumerate(comparison.image_names)},
        "pair_rows": rows[:MAX_NUM_TABLE_PAIRS],
        "num_verified_pairs": len(rows),
        "pair_pictures": pair_pictures,
        "pair_plots": plot_pairs(chosen, pair_pictures, output_path),
        "rectifying": rectifying,
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "auc_thresholds_deg": AUC_THRESHOLDS_DEG,
        "settings": flat(comparison.settings),
        "method_options": {method.name: flat(method.options) for method in methods},
        **_graphs_and_models(columns, comparison, output_path),
    }
    folders = [folder, output_path.resolve()]
    return page.write_page(output_path / FILE_NAME, TEMPLATE, content, folders)


def _bars(columns: Sequence[Column], comparison: Comparison) -> list[dict[str, Any]]:
    total = max(1, len(comparison.image_names))
    bars = []
    for column in columns:
        known = [span for span in (column.method.registered, column.method.correct) if span]
        first, *correct = (span_text(span, digits_of([span.mean], 1)) for span in known)
        text = ", ".join([f"{first} of {total}", *(f"{each} correct" for each in correct)])
        shares = [span.mean / total for span in known]
        bars.append({"column": column, "shares": shares, "text": text})
    return bars


def _graphs_and_models(
    columns: Sequence[Column], comparison: Comparison, output_path: Path
) -> dict[str, Any]:
    names = comparison.image_names
    graphs = [column.method.pair_inliers for column in columns]
    layout = view_graph.lay_out(names, graphs)
    cards = cards_of(columns, comparison)
    paths = comparison.model_paths(output_path)
    views = read_scene({column.name: paths[column.name] for column in columns})
    index = {name: number for number, name in enumerate(names)}
    kinds = [{card.name: card.marks[number].kind for card in cards} for number in range(len(views))]
    used = {kind for of_view in kinds for kind in of_view.values()}
    first, later = graphs[:1], graphs[1:]
    notes = [f"{len(graph)} verified pairs" for graph in graphs]
    for number, graph in enumerate(later, 1):
        sides = {"new": graph.keys() - graphs[0].keys(), "lost": graphs[0].keys() - graph.keys()}
        notes[number] += "".join(f", {len(pairs)} {what}" for what, pairs in sides.items() if pairs)
    return {
        "cards": cards,
        "layout": layout,
        "edges": [
            *(view_graph.edge_paths(names, layout, graph) for graph in first),
            *(view_graph.differing_edge_paths(names, layout, graph, *first) for graph in later),
        ],
        "edge_notes": notes,
        "views": views,
        "kinds": {kind: text for kind, text in KINDS.items() if kind in used},
        "script_data": {
            "matrices": [view_graph.matrix(names, graph) for graph in graphs],
            "views": [
                view.script_data(index, of_view) for view, of_view in zip(views, kinds, strict=True)
            ],
        },
    }


FILTERS = {
    "all": "All",
    "differ": "Methods differ",
    "seeds": "Seeds disagree",
    "wrong": "Registered wrongly",
    "uncertain": "Doubtful",
    "none": "Registered by none",
}


KINDS = {
    "shared": "registered by other methods, too",
    "only": "registered by this method only",
    "uncertain": "doubtful, or contradicts other seeds or methods",
    "wrong": "at a wrong place",
}
"""How cameras are drawn; each has a colour of this name."""


@dataclass(frozen=True)
class Mark(Node):
    """What one method does with one photograph."""

    column: Column
    # doubtful, or in a pose that contradicts those of other seeds or of most other methods
    is_uncertain: bool
    is_only: bool  # usually registered by no other method

    @property
    def kind(self) -> str:
        """One of ``KINDS``."""
        if self.is_wrong:
            return "wrong"
        return "uncertain" if self.is_uncertain else "only" if self.is_only else "shared"


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet; it has the same number everywhere on the page."""

    number: int
    name: str
    marks: tuple[Mark, ...]
    groups: tuple[str, ...]


def cards_of(columns: Sequence[Column], comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    with_truth = comparison.names_with_truth
    usually_registered = [column.method.usually_registered for column in columns]
    only = comparison.only_registered_by if len(columns) > 1 else {}
    registered_by_none = set(comparison.registered_by_none)
    placed = [column.method.seeds[0].registered_names for column in columns]
    cards = []
    for number, name in enumerate(comparison.image_names, 1):
        truth, alone = name in with_truth, only.get(name)
        num_others = sum(name in names for names in placed) - 1
        marks = tuple(
            _mark(c, number, name, num_others, has_truth=truth, is_only=alone == c.name)
            for c in columns
        )
        tests = {
            "all": True,
            "differ": len({name in names for names in usually_registered}) > 1,
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": any(mark.is_wrong for mark in marks),
            "uncertain": any(mark.is_uncertain for mark in marks),
            "none": name in registered_by_none,
        }
        groups = tuple(group for group, passes in tests.items() if passes)
        cards.append(Card(number, name, marks, groups))
    return cards


def _mark(
    column: Column, number: int, name: str, num_others: int, *, has_truth: bool, is_only: bool
) -> Mark:
    """Mark what a method does with a photograph that some other methods place, too.

    Where ground truth does not know its pose it is uncertain in a method that doubts it, and in one
    that contradicts most others, not in all that one contradicts.
    """
    method, seeds = column.method, column.method.seeds
    registering = [seed for seed in seeds if name in seed.registered_names]
    correct = [s for s in registering if s.scores is not None and name in s.scores.correct_names]
    if not registering:
        state, text = "never", "not registered"
    elif len(registering) == len(seeds):
        state, text = "always", "registered"
    else:
        state, text = "sometimes", f"registered with {len(registering)} of {len(seeds)} seeds"
    is_wrong = has_truth and len(correct) < len(registering)
    if is_wrong:
        text += f", correctly with {len(correct)}" if correct else ", wrongly"
    elif correct:
        text += ", correctly"
    others = [other for other, names in method.disagreements.items() if name in names]
    doubt, is_unstable = method.usually_doubted.get(name), name in method.unstable_names
    is_odd = 2 * len(others) > max(0, num_others)
    if not has_truth or is_wrong:
        if doubt:
            text += f", doubtful: {doubt}"
        if is_unstable:
            text += ", in poses that contradict each other from seed to seed"
        if others:
            text += f", in a pose that contradicts that of {' and '.join(others)}"
    return Mark(
        number,
        name,
        state,
        is_wrong,
        f"{column.name}: {text}",
        column=column,
        is_uncertain=not has_truth and (bool(doubt) or is_unstable or is_odd),
        is_only=is_only,
    )


MAX_NUM_PAIRS = 6
MAX_PAIRS_OF_IMAGE = 2
FEW_INLIERS = 20


def contrast(counts: Sequence[int]) -> float:
    """Tell how much numbers of inliers differ: by a ratio, in which few count as hardly any.

    >>> contrast([0, 200]) > contrast([1000, 2000]) > contrast([0, 10]) > contrast([7, 7])
    True
    """
    return log((max(counts) + FEW_INLIERS) / (min(counts) + FEW_INLIERS))


def pair_rows(methods: Sequence[MethodResult]) -> list[tuple[Pair, list[int]]]:
    """Return the verified pairs with their inliers by method, those that differ most first."""
    pairs = sorted({pair for method in methods for pair in method.pair_inliers})
    rows = [(pair, [method.pair_inliers.get(pair, 0) for method in methods]) for pair in pairs]
    return sorted(rows, key=lambda row: -contrast(row[1]))


def choose_pairs(
    methods: Sequence[MethodResult], rectifying: Collection[str]
) -> dict[Pair, tuple[MethodResult, MethodResult]]:
    """Return the pairs with the largest differences, each image in at most two of them.

    Each has two methods: the best of those that warp photographs (``rectifying``) is the second,
    and the best of the others the first; where there is one kind only, the best and the worst.
    """
    warped = [method for method in methods if method.name in rectifying]
    plain = [method for method in methods if method.name not in rectifying]
    chosen = {}
    for pair, counts in pair_rows(methods):
        inliers = dict(zip([method.name for method in methods], counts, strict=True))

        def key(method: MethodResult, inliers: Mapping[str, int] = inliers) -> int:
            return inliers[method.name]

        if warped and plain:
            both = max(plain, key=key), max(warped, key=key)
        else:
            both = min(methods, key=key), max(methods, key=key)
        chosen[pair] = contrast(list(map(key, both))), both
    uses: Counter[str] = Counter()
    found: dict[Pair, tuple[MethodResult, MethodResult]] = {}
    for pair, (difference, both) in sorted(chosen.items(), key=lambda item: (-item[1][0], item[0])):
        fits = all(uses[name] < MAX_PAIRS_OF_IMAGE for name in pair)
        if fits and difference > 0 and len(found) < MAX_NUM_PAIRS:
            found[pair] = both
            uses.update(pair)
    return found


def plot_pairs(
    chosen: Mapping[Pair, tuple[MethodResult, MethodResult]],
    pictures: Mapping[str, Picture],
    output_path: Path,
) -> list[dict[str, Any]]:
    """Draw pairs whose photographs are among the pictures: ``shown``, ``plots`` by method."""
    sides = {p: SideBySide.of(p, pictures) for p in chosen if pictures.keys() >= set(p)}
    names = {pair: [method.name for method in chosen[pair]] for pair in sides}
    methods = {method.name: method for pair in sides for method in chosen[pair]}
    drawn: dict[str, dict[Pair, MatchPlot]] = {}
    for name, method in methods.items():
        workspace = Workspace(output_path / method.folder)
        drawn[name] = plot_inliers(
            [side for pair, side in sides.items() if name in names[pair]],
            method.pair_inliers,
            workspace.path / f"seed-{method.seeds[0].seed}" / "database.db",
            workspace.features,
        )
    return [
        {"shown": side, "plots": {name: drawn[name][pair] for name in names[pair]}}
        for pair, side in sides.items()
    ]
