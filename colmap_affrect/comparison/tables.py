"""A comparison as a table for the terminal, as CSV and as JSON."""

import json
import textwrap
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from typing import Any

from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult, Span
from colmap_affrect.comparison.verdict import verdict
from colmap_affrect.project.report import csv_text

WIDTH = 88


def summary(comparison: Comparison) -> str:
    """Return the verdict under a table of methods."""
    columns = ["method", "registered", "verified", "points", "track", "px", "seconds", "MB"]
    if comparison.has_ground_truth:
        columns.insert(2, "correct")
    lines = [aligned([columns, *(_row(method, comparison) for method in comparison.methods)])]
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


def _row(method: MethodResult, comparison: Comparison) -> list[str]:
    if method.failed:
        return [method.name, "failed"]
    return [
        method.name,
        f"{_span(method.registered)} of {len(comparison.image_names)}",
        *([_span(method.correct)] if comparison.has_ground_truth else []),
        _span(method.span("verified_pairs")),
        _mean(method.span("points3D"), 0),
        _mean(method.span("mean_track_length"), 2),
        _mean(method.span("mean_reprojection_error_px"), 2),
        f"{method.total_s:.1f}",
        f"{method.peak_memory_bytes / 1e6:.0f}",
    ]


def _mean(span: Span | None, digits: int) -> str:
    return f"{span.mean:.{digits}f}" if span else "-"


def _span(span: Span | None) -> str:
    return span.text("{0.mean:.1f} [{0.min:g}-{0.max:g}]") if span else "-"


def to_json(comparison: Comparison) -> str:
    """Return ``comparison.json``: all results, and the verdict first."""
    values = {"verdict": verdict(comparison), **comparison.to_mapping()}
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"


def to_csv(comparison: Comparison) -> str:
    """Return ``comparison.csv``: a row for each method and seed, and for each failed method."""
    images = len(comparison.image_names)
    rows = [_cells(method, seed, images) for method in comparison.finished for seed in method.seeds]
    rows += [
        {"method": method.name, "images": images, "failed": method.failed}
        for method in comparison.methods
        if method.failed
    ]
    return csv_text(rows)


def _cells(method: MethodResult, seed: SeedResult, images: int) -> dict[str, Any]:
    cells = {
        "method": method.name,
        "images": images,
        "failed": "",
        "keypoints": sum(method.num_keypoints.values()),
        "raw_matches": sum(method.raw_matches.values()),
        "peak_memory_bytes": method.peak_memory_bytes,
        **_numbers(seed.to_mapping()),
    }
    if seed.scores:
        scores = seed.scores.to_mapping()
        cells |= {"correct": len(seed.scores.correct_names), **_numbers(scores)}
        cells |= {f"auc_{limit}": value for limit, value in scores["auc"].items()}
    return cells | {f"{key}_s": value for key, value in {**method.wall_s, **seed.wall_s}.items()}


def _numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if isinstance(value, int | float)}
