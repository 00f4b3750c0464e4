"""A comparison as a table for the terminal and as JSON."""

import json
import textwrap
from collections.abc import Sequence
from itertools import zip_longest

from colmap_affrect.comparison.method_table import columns_of, summary_rows
from colmap_affrect.comparison.results import Comparison
from colmap_affrect.comparison.verdict import verdict

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
    values = {"verdict": verdict(comparison), **comparison.to_mapping()}
    return json.dumps(values, indent=2, ensure_ascii=False) + "\n"
