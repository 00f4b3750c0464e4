"""What an evaluation found, for programs: JSON and CSV; tables are in :mod:`tables`."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Self

from colmap_affrect.evaluation import tables
from colmap_affrect.evaluation.costs import PAIR_STEPS, ImageCost
from colmap_affrect.evaluation.protocol import PairResult, PairScore
from colmap_affrect.evaluation.published import PublishedRow

Interval = tuple[float, float]


@dataclass(frozen=True)
class RecipeResult:
    """What one recipe reached.

    Attributes:
        name: label of the recipe.
        description: one line for people.
        pairs: in the order of the dataset; failed ones among them.
        summary: columns of the protocol's table by name, and ``seconds``, of all steps of all
            images and pairs together.
        intervals: bootstrap intervals (95 %) over pairs of the columns, where there are any.
        solved: mean of the protocol's success over the pairs, and its interval.
        solved_by_category: mean success by category, of pairs that have one.
        p_value: of the paired test of success against the baseline; None without.
        cost: mean per image.
        num_images: that have features.
        failures: images that cannot be used, with the reason.
        warnings: images that were not rectified though they were to be, with the reason.
    """

    name: str
    description: str
    pairs: tuple[PairResult, ...]
    summary: Mapping[str, float]
    intervals: Mapping[str, Interval]
    solved: tuple[float, Interval]
    solved_by_category: Mapping[str, float]
    p_value: float | None
    cost: ImageCost
    num_images: int
    failures: Mapping[str, str] = field(default_factory=dict)
    warnings: Mapping[str, str] = field(default_factory=dict)

    @property
    def num_failed(self) -> int:
        """Pairs that could not be matched or scored at all."""
        return sum(bool(pair.failure) for pair in self.pairs)

    def seconds_per_step(self) -> dict[str, float]:
        """Return mean seconds by step: those of images per image, those of pairs per pair."""
        timed = [pair.seconds_by_step for pair in self.pairs if pair.seconds_by_step]
        per_pair = {
            step: math.fsum(seconds[step] for seconds in timed) / max(1, len(timed))
            for step in PAIR_STEPS
        }
        return {**self.cost.seconds(), **per_pair}

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; what is infinite becomes None."""
        return {
            "description": self.description,
            "summary": _plain(self.summary),
            "intervals": {name: _plain(limits) for name, limits in self.intervals.items()},
            "solved": {"mean": self.solved[0], "interval": list(self.solved[1])},
            "solved_by_category": dict(self.solved_by_category),
            "p_value": self.p_value,
            "num_images": self.num_images,
            "complexity": {
                "area_mpx": self.cost.area_mpx,
                "num_keypoints": self.cost.num_keypoints,
                "num_regions": self.cost.num_regions,
                "num_warps": self.cost.num_warps,
                "warps_per_region": self.cost.warps_per_region,
            },
            "seconds_per_step": self.seconds_per_step(),
            "failures": dict(self.failures),
            "warnings": dict(self.warnings),
            "pairs": [pair_to_mapping(pair) for pair in self.pairs],
        }

    @classmethod
    def from_mapping(cls, name: str, values: Mapping[str, Any]) -> Self:
        """Read :meth:`to_mapping`."""
        size = dict(values["complexity"])
        del size["warps_per_region"]
        seconds = values["seconds_per_step"]
        steps = {f"{step}_s": seconds[step] for step in ImageCost().seconds()}
        return cls(
            name,
            values["description"],
            tuple(pair_from_mapping(pair) for pair in values["pairs"]),
            {key: _number(value) for key, value in values["summary"].items()},
            {
                key: (_number(low), _number(high))
                for key, (low, high) in values["intervals"].items()
            },
            (values["solved"]["mean"], _limits(values["solved"]["interval"])),
            values["solved_by_category"],
            values["p_value"],
            ImageCost(**size, **steps),
            values["num_images"],
            values["failures"],
            values["warnings"],
        )


@dataclass(frozen=True)
class Evaluation:
    """Results of several recipes on one dataset.

    Attributes:
        protocol: its name.
        error_title: what the errors are, with the unit.
        category_title: what the categories are; empty without.
        dataset_path: the dataset.
        settings: everything that decides scores.
        recipes: in the order given.
        notes: what is missing or odd in the dataset.
        baseline: label of the recipe that the others are tested against; empty for none.
        published: rows of the paper's tables for the same protocol.
        published_complexity: those of its table of complexity.
        versions: of libraries.
    """

    protocol: str
    error_title: str
    category_title: str
    dataset_path: str
    settings: Mapping[str, Any]
    recipes: tuple[RecipeResult, ...]
    notes: tuple[str, ...] = ()
    baseline: str = ""
    published: tuple[PublishedRow, ...] = ()
    published_complexity: tuple[PublishedRow, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def num_pairs(self) -> int:
        """Pairs of the dataset."""
        return len(self.recipes[0].pairs)

    def summary(self) -> str:
        """Return tables for the terminal."""
        return tables.summary(self)

    def to_csv(self) -> str:
        """Return a row for each recipe and pair."""
        return tables.evaluation_csv(self)

    def to_json(self) -> str:
        """Return everything as JSON; infinite errors are null."""
        return json.dumps(
            {
                "protocol": self.protocol,
                "error": self.error_title,
                "category": self.category_title,
                "dataset_path": self.dataset_path,
                "settings": self.settings,
                "baseline": self.baseline,
                "notes": self.notes,
                "recipes": {recipe.name: recipe.to_mapping() for recipe in self.recipes},
                "published": [_row_to_mapping(row) for row in self.published],
                "published_complexity": [_row_to_mapping(row) for row in self.published_complexity],
                "versions": self.versions,
            },
            indent=1,
            ensure_ascii=False,
            allow_nan=False,
        )

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read :meth:`to_json`."""
        values = json.loads(text)
        return cls(
            values["protocol"],
            values["error"],
            values["category"],
            values["dataset_path"],
            values["settings"],
            tuple(
                RecipeResult.from_mapping(name, recipe)
                for name, recipe in values["recipes"].items()
            ),
            tuple(values["notes"]),
            values["baseline"],
            tuple(PublishedRow(**row) for row in values["published"]),
            tuple(PublishedRow(**row) for row in values["published_complexity"]),
            values["versions"],
        )


def pair_to_mapping(pair: PairResult) -> dict[str, Any]:
    """Return plain values for JSON; infinite errors become None."""
    return {
        "name": pair.name,
        "category": pair.category,
        "error": _finite(pair.score.error),
        "num_inliers": pair.score.num_inliers,
        "num_correct": pair.score.num_correct,
        "num_matches": pair.num_matches,
        "num_keypoints": list(pair.num_keypoints),
        "seconds": pair.seconds,
        "seconds_by_step": dict(pair.seconds_by_step),
        "level": pair.level,
        "num_levels": pair.num_levels,
        "failure": pair.failure,
        "details": {key: _finite(value) for key, value in pair.score.details.items()},
    }


def pair_from_mapping(values: Mapping[str, Any]) -> PairResult:
    """Read :func:`pair_to_mapping`."""
    score = PairScore(
        _number(values["error"]),
        values["num_inliers"],
        values["num_correct"],
        {key: _number(value) for key, value in values["details"].items()},
    )
    first, second = values["num_keypoints"]
    return PairResult(
        values["name"],
        values["category"],
        score,
        values["num_matches"],
        values["seconds"],
        (first, second),
        values["seconds_by_step"],
        values["level"],
        values["num_levels"],
        values["failure"],
    )


def _row_to_mapping(row: PublishedRow) -> dict[str, Any]:
    return {"method": row.method, "values": dict(row.values), "table": row.table}


def _plain(values: Mapping[str, float] | Sequence[float]) -> Any:
    if isinstance(values, Mapping):
        return {key: _finite(value) for key, value in values.items()}
    return [_finite(value) for value in values]


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _number(value: float | None) -> float:
    return math.inf if value is None else value


def _limits(values: Sequence[float]) -> Interval:
    low, high = values
    return low, high
