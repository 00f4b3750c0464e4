"""A comparison of methods as one page that needs nothing beside it (the home of jinja2)."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import jinja2

from colmap_affrect.comparison.results import (
    AUC_THRESHOLDS_DEG,
    MAX_CORRECT_ERROR_DEG,
    Comparison,
    MethodResult,
    Pair,
    PoseScores,
    Span,
)
from colmap_affrect.errors import AffrectError
from colmap_affrect.extraction import Resources
from colmap_affrect.files import replace_text
from colmap_affrect.options import flat
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.report import view_graph
from colmap_affrect.report.match_plots import (
    MAX_NUM_LINES,
    PLOT_HEIGHT,
    ChosenPair,
    choose_pairs,
    contrast,
    plot_pairs,
)
from colmap_affrect.report.pictures import photograph_pictures
from colmap_affrect.report.scene import STILL_SIZE_PX, Scene, read_scene
from colmap_affrect.report.warp_views import WarpedPhotograph, rectifies, warped_photographs
from colmap_affrect.workspace import STAGES, Workspace

TEMPLATES = Path(__file__).parent / "templates"
FILE_NAME = "report.html"

METHOD_COLORS = (
    "#0b62a8", "#a34700", "#00714f", "#9b2d79", "#5d4bb0", "#7a5c00", "#a3213b", "#46606e",
)  # fmt: skip
"""Of the marks of methods; white text on them is readable."""

THUMBNAIL_PX = 160
MATCH_PICTURE_PX = 560
MAX_NUM_WARPED_PHOTOGRAPHS = 3
MAX_NUM_TABLE_PAIRS = 200
BYTES_PER_MB = 1_000_000
NOTHING = "-"
"""Where there is no number."""


@dataclass(frozen=True)
class Column:
    """A method that finished, as it is marked everywhere on the page."""

    letter: str
    color: str
    method: MethodResult

    @property
    def name(self) -> str:
        """Of the method."""
        return self.method.name

    @property
    def pair_inliers(self) -> Mapping[Pair, int]:
        """Verified pairs of the first seed."""
        return self.method.seeds[0].pair_inliers if self.method.seeds else {}


def write_page(
    comparison: Comparison,
    output_path: Path,
    progress: Progress = SILENT,
    resources: Resources | None = None,
) -> Path:
    """Write ``report.html`` into the folder of a comparison.

    It is one file that loads nothing. Whatever is missing, such as a photograph that cannot be
    read or a model that is not there, is said in its place.

    Args:
        comparison: the results; their paths are relative to ``output_path``.
        output_path: folder of the comparison.
        progress: where to show it.
        resources: weights and device of the methods that have networks, to draw their warps.

    Returns:
        The path of the page.

    Raises:
        WorkspaceError: when it cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES, encoding="utf-8"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.tests["contains"] = lambda values, value: value in values
    script = (TEMPLATES / "page.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    text = environment.get_template("page.html").render(
        _content(comparison, output_path, progress, resources),
        script=script,
        script_digest=digest,
        style=(TEMPLATES / "page.css").read_text(encoding="utf-8"),
    )
    path = output_path / FILE_NAME
    replace_text(path, text)
    return path


def _content(
    comparison: Comparison, output_path: Path, progress: Progress, resources: Resources | None
) -> dict[str, Any]:
    """Return what the template shows."""
    names = comparison.image_names
    folder = Path(comparison.image_path)
    columns = columns_of(comparison)
    thumbnails = photograph_pictures(folder, names, THUMBNAIL_PX, progress)
    rectifying = [c.name for c in columns if rectifies(output_path, c.method.folder)]
    chosen = choose_pairs(comparison, rectifying)
    chosen_names = sorted({name for item in chosen for name in item.names})
    pictures = photograph_pictures(folder, chosen_names, MATCH_PICTURE_PX)
    graphs = [column.pair_inliers for column in columns]
    layout = view_graph.lay_out(names, graphs)
    matrices = [view_graph.matrix(names, graph) for graph in graphs]
    scene = read_scene([column.method for column in columns], output_path)
    warped_method, warped, warped_error = _warps(
        comparison, rectifying, chosen, output_path, resources
    )
    return {
        "comparison": comparison,
        "columns": columns,
        "column_of": {column.name: column for column in columns},
        "failed": [method for method in comparison.methods if method.failed],
        "rows": summary_rows(columns, comparison),
        "has_ground_truth": comparison.has_ground_truth,
        "filters": FILTERS,
        "cards": cards_of(columns, comparison),
        "thumbnails": thumbnails,
        "image_index": {name: index for index, name in enumerate(names)},
        "layout": layout,
        "graph_size": view_graph.GRAPH_SIZE,
        "edges": [view_graph.edge_paths(names, layout, graph) for graph in graphs],
        "class_labels": view_graph.class_labels(),
        "class_colors": view_graph.CLASS_COLORS,
        "class_widths": view_graph.CLASS_WIDTHS,
        "max_num_thumbnails": view_graph.MAX_NUM_THUMBNAILS,
        "matrices": matrices,
        "pair_rows": pair_rows(columns)[:MAX_NUM_TABLE_PAIRS],
        "num_verified_pairs": len({pair for graph in graphs for pair in graph}),
        "pair_pictures": pictures,
        "pair_plots": plot_pairs(chosen, pictures, output_path),
        "plot_height": PLOT_HEIGHT,
        "max_num_lines": MAX_NUM_LINES,
        "rectifying": rectifying,
        "warped_method": warped_method,
        "warped": warped,
        "warped_error": warped_error,
        "views": scene.views,
        "still_size": STILL_SIZE_PX,
        "script_data": _script_data(comparison, matrices, scene),
        "max_correct_error_deg": MAX_CORRECT_ERROR_DEG,
        "auc_thresholds_deg": AUC_THRESHOLDS_DEG,
        "settings": flat(comparison.settings),
        "method_options": {c.name: flat(c.method.options) for c in columns},
    }


def columns_of(comparison: Comparison) -> list[Column]:
    """Give each method that finished a letter and a colour."""
    return [
        Column(
            chr(ord("A") + index) if index < 26 else str(index + 1),
            METHOD_COLORS[index % len(METHOD_COLORS)],
            method,
        )
        for index, method in enumerate(comparison.finished)
    ]


# --- Numbers


def number_text(value: float, digits: int = 1) -> str:
    """Write a number with so many digits after the point, without trailing zeros.

    >>> number_text(3.0), number_text(1234.56), number_text(0.123, 2)
    ('3', '1,234.6', '0.12')
    """
    text = f"{value:,.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def span_text(span: Span | None, digits: int = 1) -> str:
    """Write a mean, and the range where it is one.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8, 8])), span_text(None)
    ('7.5 (7-8)', '8', '-')
    """
    if span is None:
        return NOTHING
    low, mean, high = (number_text(value, digits) for value in (span.min, span.mean, span.max))
    return mean if low == high else f"{mean} ({low}-{high})"


@dataclass(frozen=True)
class Row:
    """A line of the table of methods.

    Attributes:
        key: for programs.
        title: what is counted.
        cells: one text per method.
        is_main: whether it is one of those that decide.
    """

    key: str
    title: str
    cells: list[str]
    is_main: bool = False


def summary_rows(columns: Sequence[Column], comparison: Comparison) -> list[Row]:
    """Return the table of methods, without the lines that say nothing of any of them.

    The keys are those of ``comparison.json``.
    """
    methods = [column.method for column in columns]
    given = len(comparison.image_names)

    def measured(key: str, title: str, digits: int = 1, *, is_main: bool = False) -> Row:
        spans = [method.span(key) if method.seeds else None for method in methods]
        return Row(key, title, [span_text(span, digits) for span in spans], is_main)

    def scored(
        key: str, title: str, digits: int, value: Callable[[PoseScores], float | None]
    ) -> Row:
        spans = [_span_of_scores(method, value) for method in methods]
        return Row(key, title, [span_text(span, digits) for span in spans])

    correct = [span_text(method.correct) for method in methods]
    keypoints = [_mean(method.num_keypoints.values()) for method in methods]
    stages = dict.fromkeys(stage for method in methods for stage in method.stage_seconds)
    rows = [
        measured("registered", f"Registered, of {given}", is_main=True),
        Row("correct", f"Registered correctly, of {given}", correct, is_main=True),
        Row("models", "Images in each model", [_splits(method) for method in methods]),
        Row("num_keypoints", "Keypoints per image", keypoints),
        measured("verified_pairs", f"Verified pairs, of {comparison.num_pairs:,}", is_main=True),
        measured("inliers", "Inliers in all pairs", 0),
        measured("points3D", "3D points", 0, is_main=True),
        measured("mean_track_length", "Images per 3D point", 2),
        measured("mean_observations", "3D points seen by an image", 0),
        measured("mean_reprojection_error_px", "Reprojection error, px", 2),
        *(
            scored(
                f"auc_{limit:g}",
                f"AUC of relative poses at {limit:g}°",
                3,
                lambda scores, limit=limit: scores.auc[limit],  # type: ignore[misc]
            )
            for limit in AUC_THRESHOLDS_DEG
        ),
        scored(
            "median_rotation_error_deg",
            "Median rotation error, °",
            2,
            lambda scores: scores.median_rotation_error_deg,
        ),
        scored(
            "median_direction_error_deg",
            "Median error of translation direction, °",
            2,
            lambda scores: scores.median_direction_error_deg,
        ),
        scored(
            "median_position_error",
            "Median position error, units of the ground truth",
            4,
            lambda scores: scores.median_position_error,
        ),
        *(
            Row(f"{stage}_s", f"Seconds to {stage}", [_seconds(m, stage) for m in methods])
            for stage in sorted(stages, key=STAGES.index)
        ),
        Row(
            "total_s",
            "Seconds in all",
            [number_text(method.total_s) for method in methods],
            is_main=True,
        ),
        Row(
            "peak_memory_bytes",
            "Peak memory, MB",
            [number_text(method.peak_memory_bytes / BYTES_PER_MB, 0) for method in methods],
        ),
    ]
    return [row for row in rows if any(cell != NOTHING for cell in row.cells)]


def _span_of_scores(
    method: MethodResult, value: Callable[[PoseScores], float | None]
) -> Span | None:
    values = [value(seed.scores) for seed in method.seeds if seed.scores is not None]
    known = [number for number in values if number is not None]
    return Span.of(known) if known else None


def _mean(values: Iterable[int]) -> str:
    numbers = list(values)
    return number_text(fmean(numbers), 0) if numbers else NOTHING


def _splits(method: MethodResult) -> str:
    """Write the sizes of the models, once where all seeds agree."""
    splits = [" + ".join(str(len(m)) for m in s.model_names) or "none" for s in method.seeds]
    if len(set(splits)) <= 1:
        return splits[0] if splits else NOTHING
    return "; ".join(
        f"seed {seed.seed}: {split}" for seed, split in zip(method.seeds, splits, strict=True)
    )


def _seconds(method: MethodResult, stage: str) -> str:
    seconds = method.stage_seconds
    return number_text(seconds[stage]) if stage in seconds else NOTHING


# --- Photographs


@dataclass(frozen=True)
class Mark:
    """What one method does with one photograph.

    Attributes:
        column: the method.
        state: ``always``, ``sometimes`` or ``never`` registered.
        is_wrong: registered, but at a wrong place with some seed.
        is_doubtful: registered in poses that contradict those of other seeds or methods.
        text: the same in words.
    """

    column: Column
    state: str
    is_wrong: bool
    is_doubtful: bool
    text: str


@dataclass(frozen=True)
class Card:
    """A photograph on the contact sheet.

    Attributes:
        number: from 1, the same everywhere on the page.
        name: of the image.
        marks: one per method.
        groups: filters that it passes.
    """

    number: int
    name: str
    marks: tuple[Mark, ...]
    groups: tuple[str, ...]


FILTERS = {
    "all": "All",
    "differ": "Methods differ",
    "seeds": "Seeds disagree",
    "wrong": "Registered wrongly",
    "doubtful": "Doubtful",
    "none": "Registered by none",
}


def cards_of(columns: Sequence[Column], comparison: Comparison) -> list[Card]:
    """Return the contact sheet."""
    known = {
        name
        for column in columns
        for seed in column.method.seeds
        if seed.scores is not None
        for pair in seed.scores.pair_errors_deg
        for name in pair
    }
    usually_registered = [column.method.usually_registered for column in columns]
    registered_by_none = set(comparison.registered_by_none)
    cards = []
    for number, name in enumerate(comparison.image_names, 1):
        marks = tuple(_mark(column, name, name in known) for column in columns)
        tests = {
            "all": True,
            "differ": len({name in names for names in usually_registered}) > 1,
            "seeds": any(mark.state == "sometimes" for mark in marks),
            "wrong": any(mark.is_wrong for mark in marks),
            "doubtful": any(mark.is_doubtful for mark in marks),
            "none": name in registered_by_none,
        }
        groups = tuple(group for group, passes in tests.items() if passes)
        cards.append(Card(number, name, marks, groups))
    return cards


def _mark(column: Column, name: str, has_ground_truth: bool) -> Mark:
    seeds = column.method.seeds
    registering = [seed for seed in seeds if name in seed.registered_names]
    correct = [s for s in registering if s.scores is not None and name in s.scores.correct_names]
    if not registering:
        state, text = "never", "not registered"
    elif len(registering) == len(seeds):
        state, text = "always", "registered"
    else:
        state, text = "sometimes", f"registered with {len(registering)} of {len(seeds)} seeds"
    is_wrong = has_ground_truth and len(correct) < len(registering)
    if is_wrong:
        text += f", correctly with {len(correct)}" if correct else ", wrongly"
    elif correct:
        text += ", correctly"
    is_unstable = name in column.method.unstable_names
    others = [other for other, names in column.method.disagreements.items() if name in names]
    if is_unstable:
        text += ", in poses that contradict each other from seed to seed"
    if others:
        text += f", in a pose that contradicts that of {' and '.join(others)}"
    is_doubtful = is_unstable or bool(others)
    return Mark(column, state, is_wrong, is_doubtful, f"{column.name}: {text}")


# --- Pairs and models


def pair_rows(columns: Sequence[Column]) -> list[tuple[Pair, list[int]]]:
    """Return the verified pairs with their inliers by method, those that differ most first."""
    pairs = sorted({pair for column in columns for pair in column.pair_inliers})
    rows = [(pair, [column.pair_inliers.get(pair, 0) for column in columns]) for pair in pairs]
    return sorted(rows, key=lambda row: -contrast(row[1]))


def _warps(
    comparison: Comparison,
    rectifying: Sequence[str],
    chosen: Sequence[ChosenPair],
    output_path: Path,
    resources: Resources | None,
) -> tuple[str, list[WarpedPhotograph], str]:
    """Return the method whose warps are shown, those of a few photographs, or why there are none.

    It is the method with most registered images of those that rectify; its photographs are
    those of the pairs that are drawn.
    """
    methods = [m for m in comparison.finished if m.name in rectifying and m.seeds]
    if not methods:
        return "", [], ""
    best = max(methods, key=lambda method: method.registered.mean)
    of_pairs = [name for item in chosen for name in item.names]
    readable = [
        n for n in dict.fromkeys([*of_pairs, *comparison.image_names]) if n in best.num_keypoints
    ]
    names = readable[:MAX_NUM_WARPED_PHOTOGRAPHS]
    try:
        workspace = Workspace(output_path / best.folder)
        return best.name, warped_photographs(workspace, names, resources), ""
    except AffrectError as error:
        return best.name, [], str(error)


def _script_data(
    comparison: Comparison, matrices: Sequence[view_graph.Matrix], scene: Scene
) -> dict[str, Any]:
    """Return what the script reads."""
    return {
        "names": comparison.image_names,
        "matrices": [matrix.counts for matrix in matrices],
        "zoom": scene.zoom,
        "views": [
            {
                "points": view.points,
                "count": view.num_points,
                "cameras": [
                    {"name": name, "corners": corners.round(4).ravel().tolist()}
                    for name, corners in view.cameras
                ],
            }
            for view in scene.views
        ],
    }
