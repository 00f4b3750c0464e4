"""The table of methods that finished, on the page and in the terminal; and JSON."""

import itertools
import json
import string
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from statistics import fmean

from pydantic import TypeAdapter

from colmap_affrect.comparison.pose_scores import AUC_THRESHOLDS_DEG, PoseScores
from colmap_affrect.comparison.results import MEASURES, OF_MODEL, Comparison, MethodResult, Span
from colmap_affrect.comparison.verdict import ranked, verdict
from colmap_affrect.project.record import STAGES

METHOD_COLORS = (
    "#0b62a8", "#a34700", "#00714f", "#9b2d79", "#5d4bb0", "#7a5c00", "#a3213b", "#46606e",
)  # fmt: skip
"""Of the marks of methods; white text on them is readable."""

MAIN_ROWS = {
    "registered", "correct", "models", "verified_pairs", "points3D", "mean_track_length", "total_s",
}  # fmt: skip
"""Rows that decide; the others are folded away."""

BYTES_PER_MB = 1_000_000
NOTHING = "-"  # where there is no number


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


def columns_of(comparison: Comparison) -> list[Column]:
    """Give each method that finished a letter and a colour, the best first."""
    letters = [*string.ascii_uppercase, *map(str, range(27, len(comparison.finished) + 1))]
    marks = zip(letters, itertools.cycle(METHOD_COLORS), ranked(comparison.finished), strict=False)
    return [Column(*mark) for mark in marks]


@dataclass(frozen=True)
class Row:
    """A line of the table of methods, and which cells have the best value, where methods differ."""

    key: str
    title: str
    cells: list[str]
    best: tuple[bool, ...]

    @property
    def is_main(self) -> bool:
        """Whether it is one of those that decide."""
        return self.key in MAIN_ROWS


Better = Callable[[Iterable[float]], float] | None  # which of the means is best, if any
Values = Callable[[MethodResult], Iterable[float | None]]  # of one method, None for no number
Figure = tuple[str, str, int, Better, Values]
"""Key and title of a line, decimals, what is best, and its values, of which it shows the span."""


def summary_rows(columns: Sequence[Column], comparison: Comparison) -> list[Row]:
    """Return the table of methods, without the lines that say nothing of any of them."""
    methods = [column.method for column in columns]
    rows = [_row(figure, methods) for figure in _figures(comparison, methods)]
    splits = [_splits(method) for method in methods]
    rows.insert(2, Row("models", "Images in each model", splits, (False,) * len(splits)))
    return [row for row in rows if any(cell != NOTHING for cell in row.cells)]


def _figures(comparison: Comparison, methods: Sequence[MethodResult]) -> list[Figure]:
    given = len(comparison.image_names)
    stages = {stage for method in methods for stage in method.stage_seconds}

    def measured(key: str) -> Values:
        return lambda method: [
            MEASURES[key](s) for s in method.seeds if s.model_names or key not in OF_MODEL
        ]

    def scored(value: Callable[[PoseScores], float | None]) -> Values:
        return lambda method: [value(seed.scores) for seed in method.seeds if seed.scores]

    def area(limit: float) -> Figure:
        title, value = f"AUC of relative poses at {limit:g}°", scored(lambda s: s.auc[f"{limit:g}"])
        return f"auc_{limit:g}", title, 3, max, value

    def median(key: str, title: str, digits: int) -> Figure:
        return key, f"Median {title}", digits, min, scored(lambda scores: getattr(scores, key))

    def seconds(stage: str) -> Figure:
        key, title = f"{stage}_s", f"Seconds to {stage}"
        return key, title, 1, min, lambda method: [method.stage_seconds.get(stage)]

    def keypoints(method: MethodResult) -> Iterable[float]:
        return [fmean(method.num_keypoints.values())] if method.num_keypoints else []

    return [
        ("registered", f"Registered, of {given}", 1, max, measured("registered")),
        ("correct", f"Registered correctly, of {given}", 1, max,
         scored(lambda scores: len(scores.correct_names))),
        ("verified_pairs", f"Verified pairs, of {comparison.num_pairs:,}", 1, None,
         measured("verified_pairs")),
        ("points3D", "3D points", 0, max, measured("points3D")),
        ("mean_track_length", "Images per 3D point", 2, None, measured("mean_track_length")),
        ("num_keypoints", "Keypoints per image", 0, None, keypoints),
        ("inliers", "Inliers in all pairs", 0, None, measured("inliers")),
        ("mean_observations", "3D points seen by an image", 0, None, measured("mean_observations")),
        ("mean_reprojection_error_px", "Reprojection error, px", 2, None,
         measured("mean_reprojection_error_px")),
        *map(area, AUC_THRESHOLDS_DEG),
        median("median_rotation_error_deg", "rotation error, °", 2),
        median("median_direction_error_deg", "error of translation direction, °", 2),
        median("median_position_error", "position error, units of the ground truth", 4),
        *map(seconds, sorted(stages, key=STAGES.index)),
        ("total_s", "Seconds in all", 1, min, lambda method: [method.total_s]),
        ("peak_memory_bytes", "Peak memory, MB", 0, min,
         lambda method: [method.peak_memory_bytes / BYTES_PER_MB]),
    ]  # fmt: skip


def _row(figure: Figure, methods: Sequence[MethodResult]) -> Row:
    """Write means and, in brackets, ranges with as many decimals in all cells as any needs."""
    key, title, digits, better, values = figure
    numbers = [[v for v in values(method) if v is not None] for method in methods]
    spans = [Span.of(of_method) if of_method else None for of_method in numbers]
    known = [span for span in spans if span]
    means = {round(span.mean, digits) for span in known}
    best = better(means) if better and len(means) > 1 else None
    digits_of_mean = digits_of((span.mean for span in known), digits)
    digits_of_ends = digits_of((end for span in known for end in (span.min, span.max)), digits)
    cells = [span_text(span, digits_of_mean, digits_of_ends) for span in spans]
    is_best = [span is not None and round(span.mean, digits) == best for span in spans]
    return Row(key, title, cells, tuple(is_best))


def digits_of(values: Iterable[float], digits: int) -> int:
    """Return so many digits after the point, none where all values are whole."""
    return 0 if all(value == round(value) for value in values) else digits


def span_text(span: Span | None, digits: int = 1, digits_of_ends: int = 0) -> str:
    """Write a mean, and the range where its ends differ as they are written.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8, 8])), span_text(None)
    ('7.5 (7-8)', '8.0', '-')
    """
    if span is None:
        return NOTHING
    mean = f"{span.mean:,.{digits}f}"
    low, high = (f"{end:,.{digits_of_ends}f}" for end in (span.min, span.max))
    return mean if low == high else f"{mean} ({low}-{high})"


def _splits(method: MethodResult) -> str:
    """Write the sizes of the models, once where all seeds agree."""
    splits = [" + ".join(str(len(m)) for m in s.model_names) or "none" for s in method.seeds]
    if len(set(splits)) == 1:
        return splits[0]
    pairs = zip(method.seeds, splits, strict=True)
    return "; ".join(f"seed {seed.seed}: {split}" for seed, split in pairs)


WIDTH = 88

SHOWN = {
    "registered": "registered", "correct": "correct", "verified_pairs": "verified",
    "points3D": "points", "mean_track_length": "track", "mean_reprojection_error_px": "px",
    "total_s": "seconds", "peak_memory_bytes": "MB",
}  # fmt: skip
"""Lines of the table of methods that the terminal shows, as columns, and their short titles."""


def summary(comparison: Comparison) -> str:
    """Return the verdict under a table of methods."""
    columns = columns_of(comparison)
    rows = [row for row in summary_rows(columns, comparison) if row.key in SHOWN]
    cells = {
        column.name: [
            f"{row.cells[index]}{f' of {len(comparison.image_names)}' * (row.key == 'registered')}"
            for row in rows
        ]
        for index, column in enumerate(columns)
    }
    table = [[method.name, *cells.get(method.name, ["failed"])] for method in comparison.methods]
    lines = [aligned([["method", *(SHOWN[row.key] for row in rows)], *table])]
    only = comparison.only_registered_by if len(comparison.finished) > 1 else {}
    lines += [""] * bool(only)
    lines += [f"only {method} registers {name}" for name, method in only.items()]
    for paragraph in verdict(comparison):
        lines += ["", *textwrap.wrap(paragraph, WIDTH, break_on_hyphens=False)]
    return "\n".join(lines)


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Align columns, the first to the left; rows may end early.

    >>> print(aligned([["recipe", "< 1 px", "s"], ["default", "3"]]))
    recipe   < 1 px  s
    default       3
    """
    widths = [max(map(len, column)) for column in zip_longest(*rows, fillvalue="")]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=False))
        ).rstrip()
        for row in rows
    )


def to_json(comparison: Comparison) -> str:
    """Return ``comparison.json``: all results, and the verdict first."""
    content = TypeAdapter(Comparison).dump_python(comparison, mode="json", by_alias=True)
    values = {"verdict": verdict(comparison), **content}
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"
