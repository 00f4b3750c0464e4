"""Tables of the registration benchmark."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import fmean
from typing import Any

Row = dict[str, Any]
"""What was measured for one method on one subset, or for one seed of it."""


def span(values: Iterable[float | None], digits: int = 0) -> str:
    """Format mean [min-max], shortened where all values are the same; - without values."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    low, high = f"{min(known):.{digits}f}", f"{max(known):.{digits}f}"
    return low if low == high else f"{fmean(known):.{digits + 1}f} [{low}-{high}]"


def summary_table(results: list[Row]) -> str:
    """Format "correct of registered" as a Markdown table of subsets by methods."""
    methods = list(dict.fromkeys(result["method"] for result in results))
    lines = [f"| subset | images | {' | '.join(methods)} |", f"|---|--:|{'--:|' * len(methods)}"]
    for subset in dict.fromkeys(result["subset"] for result in results):
        row = {result["method"]: result for result in results if result["subset"] == subset}
        cells = [
            f"{span(run['correct'] for run in row[method]['runs'])} of "
            f"{span(run['registered'] for run in row[method]['runs'])}"
            if method in row
            else ""
            for method in methods
        ]
        num_images = next(iter(row.values()))["num_images"]
        lines.append(f"| {subset} | {num_images} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def detail_table(results: list[Row]) -> str:
    """Format all that was measured as a Markdown table."""
    lines = [
        "| subset | images | method | correct | registered | all correct | rotation error (deg)"
        " | points | track length | reprojection error (px) | extraction (s/image)"
        " | matching (s/pair) | verification (s) | mapping (s) |",
        "|---|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for result in results:
        runs, num_images = result["runs"], result["num_images"]
        num_all = sum(run["correct"] == num_images for run in runs)
        cells = [
            result["subset"],
            str(num_images),
            result["method"],
            span(run["correct"] for run in runs),
            span(run["registered"] for run in runs),
            "-" if runs[0]["correct"] is None else f"{num_all} of {len(runs)}",
            span((run.get("rotation_error_deg") for run in runs), 2),
            span(run["points"] for run in runs),
            span((run.get("track_length") for run in runs), 2),
            span((run.get("reprojection_error") for run in runs), 2),
            f"{result['seconds']['extraction'] / num_images:.2f}",
            f"{result['seconds']['matching'] / (num_images * (num_images - 1) / 2):.3f}",
            f"{fmean(run['seconds']['verification'] for run in runs):.1f}",
            f"{fmean(run['seconds']['mapping'] for run in runs):.1f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def merge(results: list[Row], new: Row, subsets: list[str]) -> list[Row]:
    """Add a result in place of the one of the same subset and method; sort by both, SIFT first."""

    def key(row: Row) -> tuple[int, bool, str]:
        return subsets.index(row["subset"]), not row["method"].startswith("sift"), row["method"]

    kept = [row for row in results if key(row) != key(new)]
    return sorted([*kept, new], key=key)
