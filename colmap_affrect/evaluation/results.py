"""What an evaluation found: as JSON for programs, as tables for people."""

import json
import math
import textwrap
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from colmap_affrect.comparison.tables import aligned
from colmap_affrect.evaluation.protocol import GROUP, Number, PairResult
from colmap_affrect.evaluation.recipe_features import STEPS

DATA = Path(__file__).with_name("published.toml")
COMPLEXITY = "complexity"
"""Stands for a protocol: the paper's table of areas, keypoints, regions and warps per image."""

Interval = tuple[Number, Number]

PAIR_RESULT = TypeAdapter(PairResult)  # results of pairs from and to JSON; infinite errors are null
SECONDS = "seconds"  # the column of all time that a recipe took
WIDTH = 100
MAX_NOTES = 12


@dataclass(frozen=True)
class PublishedRow:
    """What a table (number and subject) of the paper says of one method.

    ``values`` are by column; those that our summaries have too are called the same.
    """

    method: str
    values: Mapping[str, float]
    table: str


def published(protocol: str) -> list[PublishedRow]:
    """Return the published rows of a protocol, table by table; none if there are none."""
    return [
        PublishedRow(
            method, dict(zip(table["columns"], map(float, values), strict=True)), table["label"]
        )
        for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["tables"]
        if table["protocol"] == protocol
        for method, values in table["values"].items()
    ]


@dataclass(frozen=True)
class Solved:
    """Mean of the protocol's success over the pairs, and its bootstrap interval (95 %)."""

    mean: float
    interval: Interval


@dataclass(frozen=True)
class RecipeResult:
    """What one recipe reached.

    Attributes:
        name: label of the recipe.
        summary: columns of the protocol's table by name, and ``seconds`` of all steps together.
        solved_by_category: mean success by category, of pairs that have one.
        p_value: of the paired test of success against the baseline; None without.
        num_images: that have features.
        complexity: mean per image, as :meth:`ImageCost.complexity`.
        seconds_per_step: means; of images per image, of pairs per pair.
        failures: images that cannot be used, with the reason.
        warnings: images that were not rectified though they were to be, with the reason.
        pairs: in the order of the dataset; failed ones among them.
    """

    name: str
    description: str
    summary: Mapping[str, Number]
    solved: Solved
    solved_by_category: Mapping[str, float]
    p_value: float | None
    num_images: int
    complexity: Mapping[str, float]
    seconds_per_step: Mapping[str, float]
    failures: Mapping[str, str]
    warnings: Mapping[str, str]
    pairs: tuple[PairResult, ...]


@dataclass(frozen=True)
class Evaluation:
    """Results of several recipes on one dataset.

    Attributes:
        error_title: what the errors are, with the unit.
        category_title: what the categories are; empty without.
        settings: everything that decides scores.
        baseline: label of the recipe that the others are tested against; empty for none.
        notes: what is missing or odd in the dataset.
        published: rows of the paper's tables for the same protocol.
        published_complexity: those of its table of complexity.
    """

    protocol: str
    error_title: Annotated[str, Field(alias="error")]
    category_title: Annotated[str, Field(alias="category")]
    dataset_path: str
    settings: Mapping[str, Any]
    baseline: str
    notes: tuple[str, ...]
    recipes: tuple[RecipeResult, ...]
    published: tuple[PublishedRow, ...]
    published_complexity: tuple[PublishedRow, ...]
    versions: Mapping[str, str]

    @property
    def num_pairs(self) -> int:
        """Pairs of the dataset."""
        return len(self.recipes[0].pairs)

    def to_json(self) -> str:
        """Return everything as JSON, recipes by name; infinite errors are null."""
        values = json.loads(TypeAdapter(Evaluation).dump_json(self, by_alias=True))
        for recipe in values["recipes"]:  # names first, for people
            recipe["pairs"] = [{"name": pair["name"], **pair} for pair in recipe["pairs"]]
        values["recipes"] = {recipe.pop("name"): recipe for recipe in values["recipes"]}
        return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)

    def summary(self) -> str:
        """Return the protocol's tables with the paper's numbers, costs, and notes."""
        notes = [*self.notes, *_failures(self.recipes, "\n".join(self.notes))]
        if len(notes) > MAX_NOTES:
            more = f"and {len(notes) - MAX_NOTES} more notes in evaluation.json"
            notes = [*notes[:MAX_NOTES], more]
        wrapped = [textwrap.fill(note, WIDTH, subsequent_indent="  ") for note in notes]
        tables = [_score_table(self, *group) for group in _groups(self)]
        parts = [
            f"{self.protocol}: {self.num_pairs} pairs",
            *tables,
            _chance_table(self),
            _cost_table(self),
            "\n".join(wrapped),
        ]
        return "\n\n".join(filter(None, parts))


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
    rows = [[recipe.name, *_cells(recipe.summary, columns)] for recipe in evaluation.recipes]
    head = [title or "recipe", *(column.rpartition(GROUP)[2] for column in columns)]
    return aligned([head, *rows, *_published_rows(evaluation.published, columns)])


def _published_rows(published: Iterable[PublishedRow], columns: Sequence[str]) -> list[list[str]]:
    return [
        [f"paper: {row.method} ({row.table})", *_cells(row.values, columns)]
        for row in published
        if set(columns) & row.values.keys() - {SECONDS}
    ]


def _chance_table(evaluation: Evaluation) -> str:
    """Return how many pairs count as solved, what chance may have to do with it, and means."""
    test = f"p against {evaluation.baseline}" if evaluation.baseline else ""
    means = ["keypoints", "matches", "inliers"]
    rows = [["recipe", "solved", "95 %", *([test] if test else []), "failed", *means]]
    for recipe in evaluation.recipes:
        low, high = recipe.solved.interval
        p_value = ["-" if recipe.p_value is None else f"{recipe.p_value:.3f}"] if test else []
        cells = [f"{recipe.solved.mean:.2f}", f"{low:.2f}-{high:.2f}", *p_value]
        counts = [(fmean(p.num_keypoints), p.num_matches, p.num_inliers) for p in recipe.pairs]
        used = [f"{fmean(column):.0f}" for column in zip(*counts, strict=True)]
        num_failed = sum(bool(pair.failure) for pair in recipe.pairs)
        rows.append([recipe.name, *cells, str(num_failed), *used])
    return aligned(rows)


def complexity_columns(recipe: RecipeResult) -> dict[str, float]:
    """Return the columns of the paper's table of complexity."""
    return {
        "warped Mpx": recipe.complexity["area_mpx"],
        "keypoints [K]": recipe.complexity["num_keypoints"] / 1000,
        "regions": recipe.complexity["num_regions"],
        "warps per region": recipe.complexity["warps_per_region"],
    }


def _cost_table(evaluation: Evaluation) -> str:
    columns = list(complexity_columns(evaluation.recipes[0]))
    head = ["per image (match, estimate: per pair)", *columns, *(f"{step} [s]" for step in STEPS)]
    rows = []
    for recipe in evaluation.recipes:
        seconds = [recipe.seconds_per_step[step] for step in STEPS]
        values = [*complexity_columns(recipe).values(), *seconds]
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


def _cells(values: Mapping[str, float], columns: Sequence[str]) -> list[str]:
    """Format counts, shares and seconds; those that are not known are empty."""

    def cell(value: float, column: str) -> str:
        if column == SECONDS:
            return f"{value:.1f}"
        return f"{value:.0f}" if value == math.floor(value) and "px" in column else f"{value:.2f}"

    return [cell(values[column], column) if column in values else "" for column in columns]
