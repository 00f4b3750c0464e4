"""Plots of an evaluation, with the axes of the paper's figures."""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from colmap_affrect.evaluation.results import Evaluation, PublishedRow
from colmap_affrect.project.atomic_files import replace_bytes

SIZE_IN, DPI = (8.0, 5.0), 120
ERROR_LIMITS = (0.1, 100.0)
GRID = "#DDDDDD"
BARS = "#DDE3EA"
PAPER_STYLE: dict[str, Any] = dict(marker=".", linestyle=":", linewidth=1.2, alpha=0.8)
PAPER_THRESHOLD = "< "


def write_plots(evaluation: Evaluation, folder: Path) -> None:
    """Draw all plots that the results allow, as PNG.

    ``errors.png``: pairs with an error below each threshold. ``categories.png``: success by
    category, where there are some.
    """
    drawings = {"errors": _errors}
    if evaluation.category_title and len(_categories(evaluation)) > 1:
        drawings["categories"] = _success_by_category
    for name, draw in drawings.items():
        stream = io.BytesIO()
        with matplotlib.style.context("default"):
            draw(evaluation).savefig(stream, format="png")
        replace_bytes(folder / f"{name}.png", stream.getvalue())


def _figure() -> Figure:
    figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _published(evaluation: Evaluation) -> Iterator[tuple[PublishedRow, dict[str, Any]]]:
    for number, row in enumerate(evaluation.published, len(evaluation.recipes)):
        label = f"paper: {row.method} ({row.table})"
        yield row, dict(color=f"C{number}", label=label, **PAPER_STYLE)


def _errors(evaluation: Evaluation) -> Figure:
    """Number of pairs over the threshold of the error, as the paper's table on EVD."""
    figure = _figure()
    axes = figure.add_subplot()
    low, high = ERROR_LIMITS
    for number, recipe in enumerate(evaluation.recipes):
        errors = sorted(pair.error for pair in recipe.pairs if pair.error < high)
        steps = [low, *(max(error, low) for error in errors), high]
        counts = [0, *range(1, len(errors) + 1), len(errors)]
        style: dict[str, Any] = dict(color=f"C{number}", linewidth=2, clip_on=False, zorder=3)
        axes.step(steps, counts, where="post", label=recipe.name, **style)
    for row, style in _published(evaluation):
        points = sorted(
            (float(name.removeprefix(PAPER_THRESHOLD).split()[0]), value)
            for name, value in row.values.items()
            if name.startswith(PAPER_THRESHOLD)
        )
        if points:
            axes.plot(*zip(*points, strict=True), **style)
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.set_ylim(0, None)
    axes.set_xlabel(f"threshold of the {evaluation.error_title}")
    axes.set_ylabel(f"pairs with a smaller error, of {evaluation.num_pairs}")
    return _finished(figure, axes, f"{evaluation.protocol}: pairs below an error")


def _categories(evaluation: Evaluation) -> list[str]:
    """Return the categories in the order of the columns of the table, or as they come."""
    recipe = evaluation.recipes[0]
    there = dict.fromkeys(pair.category for pair in recipe.pairs if pair.category)
    return list(dict.fromkeys([*(name for name in recipe.summary if name in there), *there]))


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
    for number, recipe in enumerate(evaluation.recipes):
        shares = [recipe.solved_by_category[name] for name in categories]
        axes.plot(places, shares, marker="o", markersize=4, color=f"C{number}", label=recipe.name)
    for row, style in _published(evaluation):
        if any(name in row.values for name in categories):
            axes.plot(places, [row.values.get(name, math.nan) for name in categories], **style)
    axes.set_xticks(places, categories, rotation=30 if max(map(len, categories)) > 5 else 0)
    axes.set_ylim(0, 1.05)
    axes.set_xlabel(evaluation.category_title)
    axes.set_ylabel("solved share of pairs (bars: size of categories)")
    return _finished(figure, axes, f"{evaluation.protocol}: success by category")


def _finished(figure: Figure, axes: Axes, title: str) -> Figure:
    axes.set_title(title, fontsize=11)
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    figure.legend(fontsize=7, loc="outside lower center", ncols=2, frameon=False)
    return figure
