"""An evaluation as tables for the terminal, and as CSV."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, Any

from colmap_affrect.evaluation.costs import STEPS
from colmap_affrect.outcomes import csv_text

if TYPE_CHECKING:
    from colmap_affrect.evaluation.published import PublishedRow
    from colmap_affrect.evaluation.results import Evaluation, RecipeResult

WIDTH = 100
SECONDS = "seconds"
GROUP = ": "
"""Separates the name of a table from that of its column."""

MAX_NOTES = 12


def summary(evaluation: Evaluation) -> str:
    """Return the protocol's tables with the paper's numbers, costs, and notes."""
    parts = [f"{evaluation.protocol}: {evaluation.num_pairs} pairs"]
    for title, columns in _groups(evaluation):
        parts.append(_score_table(evaluation, title, columns))
    parts.append(_chance_table(evaluation))
    parts.append(_cost_table(evaluation))
    failures = _failures(evaluation.recipes, "\n".join(evaluation.notes))
    notes = [*evaluation.notes, *failures]
    if len(notes) > MAX_NOTES:
        more = f"and {len(notes) - MAX_NOTES} more notes in evaluation.json"
        notes = [*notes[:MAX_NOTES], more]
    wrapped = [textwrap.fill(note, WIDTH, subsequent_indent="  ") for note in notes]
    return "\n\n".join([*parts, *(["\n".join(wrapped)] if wrapped else [])])


def _groups(evaluation: Evaluation) -> list[tuple[str, list[str]]]:
    """Split the columns of all recipes into tables, by what stands before the colon."""
    columns = dict.fromkeys(name for recipe in evaluation.recipes for name in recipe.summary)
    groups: dict[str, list[str]] = {}
    for column in columns:
        title, separator, _ = column.rpartition(GROUP)
        groups.setdefault(title if separator else "", []).append(column)
    if groups.get("") == [SECONDS]:  # time stands in another table then
        del groups[""]
    return list(groups.items())


def _score_table(evaluation: Evaluation, title: str, columns: Sequence[str]) -> str:
    rows = [
        [recipe.name, *(_cell(recipe.summary.get(column), column) for column in columns)]
        for recipe in evaluation.recipes
    ]
    head = [title or "recipe", *(column.rpartition(GROUP)[2] for column in columns)]
    return aligned([head, *rows, *_published_rows(evaluation.published, columns)])


def _published_rows(published: Iterable[PublishedRow], columns: Sequence[str]) -> list[list[str]]:
    """Return the paper's rows that have some of the columns."""
    return [
        [
            f"paper: {row.method} ({row.table})",
            *(_cell(row.values.get(column), column) for column in columns),
        ]
        for row in published
        if set(columns) & row.values.keys() - {SECONDS}
    ]


def _chance_table(evaluation: Evaluation) -> str:
    """Return how many pairs count as solved, what chance may have to do with it, and means."""
    test = f"p against {evaluation.baseline}" if evaluation.baseline else ""
    means = ["keypoints", "matches", "inliers"]
    rows = [["recipe", "solved", "95 %", *([test] if test else []), "failed", *means]]
    for recipe in evaluation.recipes:
        mean, (low, high) = recipe.solved
        p_value = ["-" if recipe.p_value is None else f"{recipe.p_value:.3f}"] if test else []
        interval = f"{low:.2f}-{high:.2f}"
        used = [
            fmean(fmean(pair.num_keypoints) for pair in recipe.pairs),
            fmean(pair.num_matches for pair in recipe.pairs),
            fmean(pair.score.num_inliers for pair in recipe.pairs),
        ]
        cells = [f"{mean:.2f}", interval, *p_value, str(recipe.num_failed)]
        rows.append([recipe.name, *cells, *(f"{value:.0f}" for value in used)])
    return aligned(rows)


def _cost_table(evaluation: Evaluation) -> str:
    """Return complexity per image, as the paper's table, and seconds by step."""
    columns = ["warped Mpx", "keypoints [K]", "regions", "warps per region"]
    head = ["per image (match, estimate: per pair)", *columns, *(f"{step} [s]" for step in STEPS)]
    rows = []
    for recipe in evaluation.recipes:
        cost, seconds = recipe.cost, recipe.seconds_per_step()
        values = [
            cost.area_mpx, cost.num_keypoints / 1000, cost.num_regions, cost.warps_per_region,
            *(seconds[step] for step in STEPS),
        ]  # fmt: skip
        rows.append([recipe.name, *(f"{value:.2f}" for value in values)])
    paper = _published_rows(evaluation.published_complexity, columns)
    return aligned([head, *rows, *([*row, *[""] * len(STEPS)] for row in paper)])


def _failures(recipes: Iterable[RecipeResult], said: str) -> list[str]:
    """Say what failed, once for all recipes, unless it has been said."""
    texts: dict[str, list[str]] = {}
    for recipe in recipes:
        for name, why in {**recipe.failures, **recipe.warnings}.items():
            texts.setdefault(f"{name}: {why}", []).append(recipe.name)
        for pair in recipe.pairs:
            known = [said, *recipe.failures.values()]
            if pair.failure and not any(pair.failure in text for text in known):
                texts.setdefault(f"{pair.name} failed: {pair.failure}", []).append(recipe.name)
    return [f"{text} ({', '.join(names)})" for text, names in texts.items()]


def _cell(value: float | None, column: str) -> str:
    """Format a count, a share or seconds."""
    if value is None:
        return ""
    if column == SECONDS:
        return f"{value:.1f}"
    return f"{value:.0f}" if value == math.floor(value) and "px" in column else f"{value:.2f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Align columns, the first to the left.

    >>> print(aligned([["recipe", "< 1 px"], ["default", "3"]]))
    recipe   < 1 px
    default       3
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for number, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def evaluation_csv(evaluation: Evaluation) -> str:
    """Return a row for each recipe and pair."""
    rows = []
    for recipe in evaluation.recipes:
        for pair in recipe.pairs:
            score = pair.score
            row: dict[str, Any] = {
                "recipe": recipe.name,
                "pair": pair.name,
                "category": pair.category,
                "error": score.error,
                "num_inliers": score.num_inliers,
                "num_correct": "" if score.num_correct is None else score.num_correct,
                "num_matches": pair.num_matches,
                "num_keypoints1": pair.num_keypoints[0],
                "num_keypoints2": pair.num_keypoints[1],
                "seconds": pair.seconds,
                "level": pair.level,
                "failure": pair.failure,
            }
            rows.append({**row, **score.details})
    return csv_text(rows)
