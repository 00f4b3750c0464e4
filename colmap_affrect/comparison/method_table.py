"""The table of methods on the page: a column for each that finished, a row for each figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

from colmap_affrect.colmap.poses import AUC_THRESHOLDS_DEG, PoseScores
from colmap_affrect.comparison.results import Comparison, MethodResult, Span
from colmap_affrect.project.workspace import STAGES
from colmap_affrect.report.page import number_text

METHOD_COLORS = (
    "#0b62a8", "#a34700", "#00714f", "#9b2d79", "#5d4bb0", "#7a5c00", "#a3213b", "#46606e",
)  # fmt: skip
"""Of the marks of methods; white text on them is readable."""

MAIN_ROWS = {"registered", "correct", "verified_pairs", "points3D", "total_s"}
"""Rows that decide."""

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


@dataclass(frozen=True)
class Row:
    """A line of the table of methods.

    Attributes:
        key: for programs, as in ``comparison.json``.
    """

    key: str
    title: str
    cells: list[str]

    @property
    def is_main(self) -> bool:
        """Whether it is one of those that decide."""
        return self.key in MAIN_ROWS


Line = tuple[str, str, Callable[[MethodResult], str]]
"""Key, title and how the cell of a method is written."""


def summary_rows(columns: Sequence[Column], comparison: Comparison) -> list[Row]:
    """Return the table of methods, without the lines that say nothing of any of them."""
    methods = [column.method for column in columns]
    lines = [*_model_lines(comparison), *_score_lines(), *_cost_lines(methods)]
    rows = [Row(key, title, [text(method) for method in methods]) for key, title, text in lines]
    return [row for row in rows if any(cell != NOTHING for cell in row.cells)]


def _model_lines(comparison: Comparison) -> list[Line]:
    given = len(comparison.image_names)

    def measured(key: str, title: str, digits: int = 1) -> Line:
        return key, title, lambda method: span_text(method.span(key), digits)

    return [
        measured("registered", f"Registered, of {given}"),
        ("correct", f"Registered correctly, of {given}", lambda m: span_text(m.correct)),
        ("models", "Images in each model", _splits),
        ("num_keypoints", "Keypoints per image", _mean_num_keypoints),
        measured("verified_pairs", f"Verified pairs, of {comparison.num_pairs:,}"),
        measured("inliers", "Inliers in all pairs", 0),
        measured("points3D", "3D points", 0),
        measured("mean_track_length", "Images per 3D point", 2),
        measured("mean_observations", "3D points seen by an image", 0),
        measured("mean_reprojection_error_px", "Reprojection error, px", 2),
    ]


def _score_lines() -> list[Line]:
    """Return the lines that only ground truth fills."""

    def scored(
        key: str, title: str, digits: int, value: Callable[[PoseScores], float | None]
    ) -> Line:
        def text(method: MethodResult) -> str:
            values = [value(seed.scores) for seed in method.seeds if seed.scores is not None]
            known = [number for number in values if number is not None]
            return span_text(Span.of(known) if known else None, digits)

        return key, title, text

    def area(limit: float) -> Line:
        title = f"AUC of relative poses at {limit:g}°"
        return scored(f"auc_{limit:g}", title, 3, lambda scores: scores.auc[limit])

    def median(key: str, title: str, digits: int) -> Line:
        return scored(key, f"Median {title}", digits, lambda scores: getattr(scores, key))

    return [
        *map(area, AUC_THRESHOLDS_DEG),
        median("median_rotation_error_deg", "rotation error, °", 2),
        median("median_direction_error_deg", "error of translation direction, °", 2),
        median("median_position_error", "position error, units of the ground truth", 4),
    ]


def _cost_lines(methods: Sequence[MethodResult]) -> list[Line]:
    def seconds(stage: str) -> Line:
        def text(method: MethodResult) -> str:
            known = method.stage_seconds
            return number_text(known[stage]) if stage in known else NOTHING

        return f"{stage}_s", f"Seconds to {stage}", text

    def memory(method: MethodResult) -> str:
        return number_text(method.peak_memory_bytes / BYTES_PER_MB, 0)

    stages = {stage for method in methods for stage in method.stage_seconds}
    return [
        *map(seconds, sorted(stages, key=STAGES.index)),
        ("total_s", "Seconds in all", lambda method: number_text(method.total_s)),
        ("peak_memory_bytes", "Peak memory, MB", memory),
    ]


def span_text(span: Span | None, digits: int = 1) -> str:
    """Write a mean, and the range where it is one.

    >>> span_text(Span.of([7, 8])), span_text(Span.of([8, 8])), span_text(None)
    ('7.5 (7-8)', '8', '-')
    """
    if span is None:
        return NOTHING
    low, mean, high = (number_text(value, digits) for value in (span.min, span.mean, span.max))
    return mean if low == high else f"{mean} ({low}-{high})"


def _mean_num_keypoints(method: MethodResult) -> str:
    return number_text(fmean(method.num_keypoints.values()), 0) if method.num_keypoints else NOTHING


def _splits(method: MethodResult) -> str:
    """Write the sizes of the models, once where all seeds agree."""
    splits = [" + ".join(str(len(m)) for m in s.model_names) or "none" for s in method.seeds]
    if len(set(splits)) == 1:
        return splits[0]
    return "; ".join(
        f"seed {seed.seed}: {split}" for seed, split in zip(method.seeds, splits, strict=True)
    )
