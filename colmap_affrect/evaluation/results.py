"""What an evaluation found: as JSON for programs, as tables and a plot for people."""

import io
import json
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from pydantic import Field, TypeAdapter

from colmap_affrect.comparison.tables import aligned
from colmap_affrect.evaluation.data import Number, PairResult
from colmap_affrect.evaluation.truths import GROUP
from colmap_affrect.project.atomic_files import replace_bytes

DATA = Path(__file__).with_name("published.toml")
ERROR_LIMITS = (0.1, 100.0)  # of the plot
SECONDS = "seconds"  # the column of all time that a recipe took


@dataclass(frozen=True)
class PublishedRow:
    """What the paper says of one method; columns that we have too are called the same."""

    method: str
    values: Mapping[str, float]  # by column
    table: str  # its number and subject


def published(protocol: str) -> list[PublishedRow]:
    """Return the published rows of a protocol, table by table; none if there are none."""
    return [
        PublishedRow(method, dict(zip(table["columns"], row, strict=True)), table["label"])
        for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["tables"]
        if table["protocol"] == protocol
        for method, row in table["values"].items()
    ]


@dataclass(frozen=True)
class RecipeResult:
    """What one recipe reached."""

    name: str  # its label
    description: str
    summary: Mapping[str, Number]  # columns of the protocol's table, and seconds of all steps
    solved: float  # mean of the pairs' ``solved``
    num_images: int  # that have features
    seconds_per_step: Mapping[str, float]  # ``extract`` an image, ``match``, ``estimate`` a pair
    failures: Mapping[str, str]  # images that cannot be used, with the reason
    warnings: Mapping[str, str]  # images that were not rectified though they were to be
    pairs: tuple[PairResult, ...]  # in the order of the dataset; failed ones among them


@dataclass(frozen=True)
class Evaluation:
    """Results of several recipes on one dataset."""

    protocol: str
    error_title: Annotated[str, Field(alias="error")]  # what errors are, with the unit
    dataset_path: str
    settings: Mapping[str, Any]  # everything that decides scores
    notes: tuple[str, ...]  # what is missing in the dataset
    recipes: tuple[RecipeResult, ...]
    published: list[PublishedRow]  # of the same protocol
    versions: Mapping[str, str]

    def to_json(self) -> str:
        """Return everything as JSON, recipes by name; infinite errors are null."""
        values = json.loads(TypeAdapter(Evaluation).dump_json(self, by_alias=True))
        values["recipes"] = {recipe.pop("name"): recipe for recipe in values["recipes"]}
        return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)

    def summary(self) -> str:
        """Return the protocol's tables with the paper's numbers, costs, and notes."""
        groups: dict[str, list[str]] = {}
        for column in (name for recipe in self.recipes for name in recipe.summary):
            group = groups.setdefault(column.rpartition(GROUP)[0], [])
            group += [column] * (column not in group)
        if groups[""] == [SECONDS]:  # stands in the last table then
            del groups[""]
        rows = [(recipe.name, recipe.summary) for recipe in self.recipes]
        rows += [(f"paper: {row.method} ({row.table})", row.values) for row in self.published]
        means = [(recipe.name, _means(recipe)) for recipe in self.recipes]
        parts = [
            f"{self.protocol}: {len(self.recipes[0].pairs)} pairs",
            *(_table(title, columns, rows) for title, columns in groups.items()),
            _table("", means[0][1], means),
            "\n".join(self.notes),
        ]
        return "\n\n".join(filter(None, parts))


def _means(recipe: RecipeResult) -> dict[str, str]:
    """Return how many pairs count as solved, how many failed, and costs."""
    failed = sum(bool(pair.failure) for pair in recipe.pairs)
    cells = {"solved": f"{recipe.solved:.2f}", "failed": str(failed)}
    counts = [(fmean(p.num_keypoints), p.num_matches, p.num_inliers) for p in recipe.pairs]
    for name, column in zip(
        ("keypoints", "matches", "inliers"), zip(*counts, strict=True), strict=True
    ):
        cells[name] = f"{fmean(column):.0f}"
    return cells | {f"{step} [s]": f"{s:.2f}" for step, s in recipe.seconds_per_step.items()}


def _table(
    title: str, columns: Collection[str], rows: Iterable[tuple[str, Mapping[str, Any]]]
) -> str:
    """Format the rows that have some of the columns: numbers with two digits, but for counts."""

    def cell(value: float | str, column: str) -> str:
        if isinstance(value, str):
            return value
        is_count = "< " in column and column.endswith("px")
        return f"{value:.{1 if column == SECONDS else 0 if is_count else 2}f}"

    lines = [[title or "recipe", *(column.rpartition(GROUP)[2] for column in columns)]]
    for name, values in rows:
        if values.keys() & set(columns) - {SECONDS}:
            cells = (cell(values.get(column, ""), column) for column in columns)
            lines.append([name, *cells])
    return aligned(lines)


def write_plot(evaluation: Evaluation, path: Path) -> None:
    """Draw the number of pairs of each recipe over the threshold of the error, as PNG.

    The axes are those of the paper's figure.
    """
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
