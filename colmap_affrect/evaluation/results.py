"""What an evaluation found: as JSON for programs, as tables for people."""

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from colmap_affrect.comparison.tables import aligned
from colmap_affrect.evaluation.truths import PairResult
from colmap_affrect.options import Summarized, documented

DATA = Path(__file__).with_name("published.toml")
SECONDS = "seconds"  # the column of all time that a recipe took


def published(protocol: str) -> dict[str, dict[str, float]]:
    """Return what the paper says of methods by a protocol: columns, called as ours, by row."""
    return {
        f"paper: {method} ({table['label']})": dict(zip(table["columns"], row, strict=True))
        for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["tables"]
        if table["protocol"] == protocol
        for method, row in table["values"].items()
    }


@dataclass(frozen=True)
class RecipeResult:
    """What one recipe reached."""

    name: str  # its label
    summary: Mapping[str, Mapping[str, float]]  # columns of tables, by the kind of truth
    # number of failed pairs, seconds in all, and means over the pairs: ``solved`` from 0 to 1,
    # ``keypoints`` of an image, ``matches``, ``inliers``
    costs: Mapping[str, float]
    failures: Mapping[str, str]  # images that cannot be used, with the reason
    pairs: tuple[PairResult, ...]  # in the order of the dataset; failed ones among them


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
        values["recipes"] = {recipe.pop("name"): recipe for recipe in values["recipes"]}
        return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)

    def summary(self) -> str:
        """Return a table for each kind of truth with the paper's numbers, and costs."""
        parts = [f"{self.protocol}: {len(self.recipes[0].pairs)} pairs"]
        for kind, columns in self.recipes[0].summary.items():
            rows = {r.name: {**r.summary[kind], SECONDS: r.costs[SECONDS]} for r in self.recipes}
            papers = {k: row for k, row in self.published.items() if row.keys() & columns.keys()}
            parts.append(_table(kind, [*columns, SECONDS], {**rows, **papers}))
        costs = {recipe.name: recipe.costs for recipe in self.recipes}
        return "\n\n".join([*parts, _table("recipe", self.recipes[0].costs, costs)])


def _table(title: str, columns: Iterable[str], rows: Mapping[str, Mapping[str, float]]) -> str:
    """Format rows with two decimals, but for whole numbers; what a row lacks is empty."""

    def cell(value: float | None) -> str:
        return "" if value is None else f"{value:.{0 if value == round(value) else 2}f}"

    lines = [[name, *(cell(row.get(column)) for column in columns)] for name, row in rows.items()]
    return aligned([[title, *columns], *lines])
