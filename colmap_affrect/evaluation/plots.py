"""The plot of an evaluation, with the axes of the paper's figure."""

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from colmap_affrect.evaluation.results import Evaluation
from colmap_affrect.project.atomic_files import replace_bytes

ERROR_LIMITS = (0.1, 100.0)


def write_plot(evaluation: Evaluation, path: Path) -> None:
    """Draw the number of pairs of each recipe over the threshold of the error, as PNG."""
    figure = Figure(figsize=(8.0, 5.0), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes, (low, high) = figure.add_subplot(), ERROR_LIMITS
    for recipe in evaluation.recipes:
        errors = sorted(max(pair.error, low) for pair in recipe.pairs if pair.error < high)
        counts = [0, *range(1, len(errors) + 1), len(errors)]
        axes.step([low, *errors, high], counts, where="post", label=recipe.name, linewidth=2)
    axes.set(xscale="log", xlim=ERROR_LIMITS, ylim=(0, None))
    axes.set(xlabel=f"threshold of the {evaluation.error_title}")
    axes.set(ylabel=f"pairs with a smaller error, of {len(evaluation.recipes[0].pairs)}")
    figure.legend(fontsize=7, loc="outside lower center", ncols=2, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    replace_bytes(path, stream.getvalue())
