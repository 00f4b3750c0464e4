"""Plots of an evaluation, with the axes of the paper's figures."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from colmap_affrect.evaluation.costs import IMAGE_STEPS, PAIR_STEPS
from colmap_affrect.evaluation.results import Evaluation, RecipeResult
from colmap_affrect.files import replace_bytes

SIZE_IN = (8.0, 5.0)
DPI = 120
ERROR_LIMITS = (0.1, 100.0)
GRID = "#DDDDDD"
BARS = "#DDE3EA"
PAPER_STYLE: dict[str, Any] = dict(marker=".", linestyle=":", linewidth=1.2, alpha=0.8)
MIN_SECONDS = 0.01
ROOM_FOR_NUMBERS = 1.12
"""Of an axis, in lengths of the longest bar."""
ROW_IN = 0.42
"""Height of a row of bars."""

PAPER_THRESHOLD = "< "


def write_plots(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Draw all plots that the results allow, as PNG; return their paths.

    ``errors.png``: pairs with an error below each threshold. ``categories.png``: success by
    category, where there are some. ``times.png``: seconds by step. ``complexity.png``: area,
    keypoints, regions and warps per image.
    """
    drawings = {"errors": _errors, "times": _times, "complexity": _complexity}
    if evaluation.category_title and len(_categories(evaluation)) > 1:
        drawings["categories"] = _success_by_category
    paths = []
    for name, draw in drawings.items():
        path = folder / f"{name}.png"
        with matplotlib.style.context("default"):
            replace_bytes(path, _png(draw(evaluation)))
        paths.append(path)
    return paths


def _figure(height_in: float = SIZE_IN[1]) -> Figure:
    figure = Figure(figsize=(SIZE_IN[0], height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    return stream.getvalue()


def _colors(recipes: Sequence[RecipeResult]) -> list[str]:
    return [f"C{number % 10}" for number in range(len(recipes))]


def _paper_colors(evaluation: Evaluation) -> list[str]:
    """Return other colours than those of the recipes, as long as there are some."""
    first = len(evaluation.recipes)
    return [f"C{(first + number) % 10}" for number in range(len(evaluation.published))]


def _errors(evaluation: Evaluation) -> Figure:
    """Number of pairs over the threshold of the error, as the paper's table on EVD."""
    figure = _figure()
    axes = figure.add_subplot()
    low, high = ERROR_LIMITS
    for recipe, color in zip(evaluation.recipes, _colors(evaluation.recipes), strict=True):
        errors = sorted(e for e in (pair.score.error for pair in recipe.pairs) if e < high)
        steps = [low, *(max(error, low) for error in errors), high]
        counts = [0, *range(1, len(errors) + 1), len(errors)]
        style: dict[str, Any] = dict(color=color, linewidth=2, clip_on=False, zorder=3)
        axes.step(steps, counts, where="post", label=recipe.name, **style)
    for row, color in zip(evaluation.published, _paper_colors(evaluation), strict=True):
        points = sorted(
            (float(name.removeprefix(PAPER_THRESHOLD).split()[0]), value)
            for name, value in row.values.items()
            if name.startswith(PAPER_THRESHOLD)
        )
        if points:
            label = f"paper: {row.method} ({row.table})"
            axes.plot(*zip(*points, strict=True), color=color, label=label, **PAPER_STYLE)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(0, None)
    axes.set_xlabel(f"threshold of the {evaluation.error_title}")
    axes.set_ylabel(f"pairs with a smaller error, of {evaluation.num_pairs}")
    _finish(figure, axes, f"{evaluation.protocol}: pairs below an error")
    return figure


def _categories(evaluation: Evaluation) -> list[str]:
    """Return the categories in the order of the columns of the table, or as they come."""
    pairs = evaluation.recipes[0].pairs
    there = dict.fromkeys(pair.category for pair in pairs if pair.category)
    columns = [name for name in evaluation.recipes[0].summary if name in there]
    return [*columns, *(name for name in there if name not in columns)]


def _success_by_category(evaluation: Evaluation) -> Figure:
    """Accuracy over categories, their sizes as bars, the paper's numbers dotted."""
    figure = _figure()
    axes = figure.add_subplot()
    categories = _categories(evaluation)
    places = np.arange(len(categories))
    pairs = evaluation.recipes[0].pairs
    sizes = [sum(pair.category == name for pair in pairs) for name in categories]
    axes.bar(places, np.divide(sizes, max(sizes)), width=0.5, color=BARS, zorder=0)
    for place, size in enumerate(sizes):
        axes.text(place, 0.01, f"{size}", ha="center", va="bottom", fontsize=7, color="#667788")
    for recipe, color in zip(evaluation.recipes, _colors(evaluation.recipes), strict=True):
        shares = [recipe.solved_by_category[name] for name in categories]
        axes.plot(places, shares, marker="o", markersize=4, color=color, label=recipe.name)
    for row, color in zip(evaluation.published, _paper_colors(evaluation), strict=True):
        if any(name in row.values for name in categories):
            shares = [row.values.get(name, math.nan) for name in categories]
            label = f"paper: {row.method} ({row.table})"
            axes.plot(places, shares, color=color, label=label, **PAPER_STYLE)
    axes.set_xticks(places, categories, rotation=30 if max(map(len, categories)) > 5 else 0)
    axes.set_ylim(0, 1.05)
    axes.set_xlabel(evaluation.category_title)
    axes.set_ylabel("solved share of pairs (bars: size of categories)")
    _finish(figure, axes, f"{evaluation.protocol}: success by category")
    return figure


def _times(evaluation: Evaluation) -> Figure:
    """Seconds by step, one bar for each recipe: per image, and per pair."""
    recipes = evaluation.recipes
    figure = _figure(1.6 + 2 * ROW_IN * len(recipes))
    upper, lower = figure.subplots(2, 1)
    for axes, steps, unit, first in (
        (upper, IMAGE_STEPS, "image", 0),
        (lower, PAIR_STEPS, "pair", len(IMAGE_STEPS)),
    ):
        left = np.zeros(len(recipes))
        for number, step in enumerate(steps, first):
            widths = np.array([recipe.seconds_per_step()[step] for recipe in recipes])
            axes.barh(range(len(recipes)), widths, left=left, color=f"C{number}", label=step)
            left += widths
        for place, total in enumerate(left):
            axes.text(total, place, f" {total:.2f}", va="center", fontsize=8)
        axes.set_yticks(range(len(recipes)), [recipe.name for recipe in recipes])
        axes.invert_yaxis()
        axes.set_xlim(0, ROOM_FOR_NUMBERS * max(left.max(), MIN_SECONDS))
        axes.set_xlabel(f"seconds per {unit}")
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
        axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0, 1), ncols=4, frameon=False)
    return figure


def _complexity(evaluation: Evaluation) -> Figure:
    """The paper's complexity table as bars, its numbers below ours."""
    recipes = evaluation.recipes
    paper = evaluation.published_complexity
    names = [*(recipe.name for recipe in recipes), *(f"paper: {row.method}" for row in paper)]
    figure = _figure(1.2 + ROW_IN * len(names))
    columns = {
        "warped Mpx": [recipe.cost.area_mpx for recipe in recipes],
        "keypoints [K]": [recipe.cost.num_keypoints / 1000 for recipe in recipes],
        "regions": [recipe.cost.num_regions for recipe in recipes],
        "warps per region": [recipe.cost.warps_per_region for recipe in recipes],
    }
    colors = [*_colors(recipes), *["#BBBBBB"] * len(paper)]
    panels = figure.subplots(1, len(columns), sharey=True)
    for axes, (title, values) in zip(panels, columns.items(), strict=True):
        everything = [*values, *(row.values.get(title, 0.0) for row in paper)]
        axes.barh(range(len(names)), everything, color=colors)
        for place, value in enumerate(everything):
            axes.text(value, place, f" {value:.2f}", va="center", fontsize=7)
        axes.set_xlim(0, 1.4 * max([*everything, 0.1]))
        axes.set_title(title, fontsize=9)
        axes.grid(axis="x", color=GRID)
        axes.set_axisbelow(True)
    panels[0].set_yticks(range(len(names)), names)
    panels[0].invert_yaxis()
    figure.supxlabel("mean per image", fontsize=9)
    return figure


def _finish(figure: Figure, axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=11)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    figure.legend(fontsize=7, loc="outside lower center", ncols=2, frameon=False)
