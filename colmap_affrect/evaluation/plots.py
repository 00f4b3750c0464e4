"""Plots of an evaluation, with the axes of the paper's figures."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from colmap_affrect.evaluation.results import Evaluation
from colmap_affrect.project.atomic_files import replace_bytes

ERROR_LIMITS = (0.1, 100.0)


def write_plots(evaluation: Evaluation, folder: Path) -> None:
    """Draw ``errors.png``, and ``categories.png`` where there are several categories."""
    drawings = {"errors": _errors}
    if evaluation.category_title and len(evaluation.recipes[0].solved_by_category) > 1:
        drawings["categories"] = _categories
    for name, draw in drawings.items():
        figure = Figure(figsize=(8.0, 5.0), dpi=120, layout="constrained")
        FigureCanvasAgg(figure)
        draw(evaluation, figure.add_subplot())
        figure.legend(fontsize=7, loc="outside lower center", ncols=2, frameon=False)
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
        replace_bytes(folder / f"{name}.png", stream.getvalue())


def _errors(evaluation: Evaluation, axes: Any) -> None:
    """Number of pairs over the threshold of the error."""
    low, high = ERROR_LIMITS
    for recipe in evaluation.recipes:
        errors = sorted(max(pair.error, low) for pair in recipe.pairs if pair.error < high)
        counts = [0, *range(1, len(errors) + 1), len(errors)]
        axes.step([low, *errors, high], counts, where="post", label=recipe.name, linewidth=2)
    axes.set(xscale="log", xlim=ERROR_LIMITS, ylim=(0, None))
    axes.set(xlabel=f"threshold of the {evaluation.error_title}")
    axes.set(ylabel=f"pairs with a smaller error, of {len(evaluation.recipes[0].pairs)}")


def _categories(evaluation: Evaluation, axes: Any) -> None:
    """Share of solved pairs over categories, their sizes as bars, the paper's numbers dotted."""
    first = evaluation.recipes[0]
    there = first.solved_by_category
    names = list(dict.fromkeys([*(name for name in first.summary if name in there), *there]))
    sizes = [sum(pair.category == name for pair in first.pairs) for name in names]
    bars = axes.bar(names, np.divide(sizes, max(sizes)), width=0.5, color="#DDE3EA")
    axes.bar_label(bars, sizes, fontsize=7, label_type="center")
    for recipe in evaluation.recipes:
        shares = [recipe.solved_by_category[name] for name in names]
        axes.plot(names, shares, marker="o", markersize=4, label=recipe.name)
    for row in evaluation.published:
        values = [row.values.get(name, math.nan) for name in names]
        label = f"paper: {row.method} ({row.table})"
        axes.plot(names, values, marker=".", linestyle=":", label=label)
    axes.tick_params(axis="x", rotation=30 if max(map(len, names)) > 5 else 0)
    axes.set(xlabel=evaluation.category_title, ylabel="solved share of pairs (bars: their number)")
