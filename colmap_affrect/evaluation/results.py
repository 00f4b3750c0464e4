"""What an evaluation found: as JSON for programs, as tables for people."""

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from colmap_affrect.comparison.tables import aligned
from colmap_affrect.errors import with_flags
from colmap_affrect.evaluation.truths import PairResult
from colmap_affrect.options import Summarized, documented
from colmap_affrect.project.image_failures import (
    ImageFailure,
    failures_to_mapping,
    texts_of_failures,
)

DATA = Path(__file__).with_name("published.toml")
SECONDS = "seconds"  # the column of all time that a recipe took


def published(protocol: str) -> dict[str, dict[str, float]]:
    """Return the rows of the paper's tables for a protocol; columns have the names of ours."""
    rows = {}
    for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["tables"]:
        if table["protocol"] == protocol:
            for method, values in table["values"].items():
                name = f"paper: {method} ({table['label']})"
                rows[name] = dict(zip(table["columns"], values, strict=True))
    return rows


@dataclass(frozen=True)
class RecipeResult:
    """The scores of one recipe."""

    name: str  # its label
    # Columns of tables, by the kind of truth
    summary: Mapping[str, Mapping[str, float]]
    # number of failed pairs, seconds in all, and means over the pairs: ``solved`` from 0 to 1,
    # ``keypoints`` of an image, ``matches``, ``inliers``
    costs: Mapping[str, float]
    failed: Mapping[str, ImageFailure]  # images that cannot be used, with the reason
    pairs: tuple[PairResult, ...]  # in the order of the dataset; failed ones among them

    @property
    def failures(self) -> dict[str, str]:
        """Why images cannot be used, in words, by their names."""
        return texts_of_failures(self.failed)


@documented
@dataclass(frozen=True)
class Evaluation(Summarized):
    """All recipes on the pairs of one dataset."""

    protocol: str
    """Name of the protocol."""
    dataset_path: str
    """Folder of the dataset."""
    settings: Mapping[str, Any]
    """Everything that decides scores."""
    recipes: tuple[RecipeResult, ...]
    """What each recipe reached."""
    published: Mapping[str, Mapping[str, float]]
    """Rows of the paper's tables for the protocol."""
    versions: Mapping[str, str]
    """Versions of Python and of the packages that decide results."""

    def to_json(self) -> str:
        """Return everything as JSON, recipes by name; infinite errors are null."""
        values = json.loads(TypeAdapter(Evaluation).dump_json(self))
        recipes = {}
        for recipe, written in zip(self.recipes, values["recipes"], strict=True):
            written["failures"] = texts_of_failures(recipe.failed, with_flags)
            written["failed"] = failures_to_mapping(recipe.failed)
            recipes[written.pop("name")] = written
        values["recipes"] = recipes
        return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)

    def summary(self) -> str:
        """Return a table for each kind of truth with the paper's numbers, and costs."""
        first = self.recipes[0]
        parts = [f"{self.protocol}: {len(first.pairs)} pairs"]
        for kind, columns in first.summary.items():
            rows: dict[str, Mapping[str, float]] = {}
            for recipe in self.recipes:
                rows[recipe.name] = {
                    **recipe.summary[kind],
                    SECONDS: recipe.costs[SECONDS],
                }
            for name, row in self.published.items():
                if row.keys() & columns.keys():
                    rows[name] = row
            parts.append(_table(kind, [*columns, SECONDS], rows))
        costs = {recipe.name: recipe.costs for recipe in self.recipes}
        parts.append(_table("recipe", first.costs, costs))
        return "\n\n".join(parts)


def _table(
    title: str, columns: Iterable[str], rows: Mapping[str, Mapping[str, float]]
) -> str:
    """Format rows with two decimals, but for whole numbers; what a row lacks is empty."""
    lines = [[title, *columns]]
    for name, row in rows.items():
        cells = [_cell(row.get(column)) for column in columns]
        lines.append([name, *cells])
    return aligned(lines)


def _cell(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if value == round(value) else f"{value:.2f}"
