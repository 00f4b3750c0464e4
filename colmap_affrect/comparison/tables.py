"""A comparison as a table for the terminal and as JSON."""

import json
import textwrap
from collections.abc import Sequence
from itertools import zip_longest

from colmap_affrect.comparison.results import Comparison, MethodResult, Span
from colmap_affrect.comparison.verdict import verdict

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
