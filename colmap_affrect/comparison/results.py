"""What a comparison found: frozen, printable, as JSON and as CSV.

Everything derived (means, who registers what alone, the verdict) is computed from the results of
single seeds, in one place each, so that terminal, page, JSON and CSV cannot disagree.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import fmean, median
from typing import Any, Self

from colmap_affrect.comparison import tables
from colmap_affrect.comparison.verdict import verdict
from colmap_affrect.errors import StoreError

Pair = tuple[str, str]
"""Names of two images, sorted."""

AUC_THRESHOLDS_DEG = (1.0, 3.0, 5.0, 10.0)
MAX_CORRECT_ERROR_DEG = 5.0
"""An image is registered correctly if its relative poses to at least half of the other registered
images are off by at most this, in rotation and in translation direction."""


@dataclass(frozen=True)
class Span:
    """Mean and range of a number over the seeds."""

    mean: float
    min: float
    max: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Self:
        """Return the span of one or more values.

        >>> Span.of([1, 3, 2])
        Span(mean=2.0, min=1.0, max=3.0)
        """
        numbers = [float(value) for value in values]
        return cls(sum(numbers) / len(numbers), min(numbers), max(numbers))


@dataclass(frozen=True)
class PoseScores:
    """The largest model of one seed against ground truth.

    Attributes:
        correct_names: images registered correctly (``MAX_CORRECT_ERROR_DEG``).
        pair_errors_deg: rotation error and error of the translation direction, in degrees, of
            every pair of registered images that have ground truth.
        num_pairs: pairs of all given images that have ground truth; those that are not in
            ``pair_errors_deg`` count as failures.
        auc: area under the curve of pairs whose larger error is below a threshold, up to
            1, 3, 5 and 10 degrees, by threshold; 0 to 1.
        median_position_error: of camera centres after similarity alignment, in units of the
            ground truth; None with fewer than three images, or all on one line.
    """

    correct_names: tuple[str, ...]
    pair_errors_deg: Mapping[Pair, tuple[float, float]]
    num_pairs: int
    auc: Mapping[float, float]
    median_position_error: float | None

    @property
    def median_rotation_error_deg(self) -> float | None:
        """Of the pairs of registered images; None without pairs."""
        errors = [rotation for rotation, _ in self.pair_errors_deg.values()]
        return median(errors) if errors else None

    @property
    def median_direction_error_deg(self) -> float | None:
        """Of the translations of the pairs of registered images; None without pairs."""
        errors = [direction for _, direction in self.pair_errors_deg.values()]
        return median(errors) if errors else None

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "correct_names": list(self.correct_names),
            "num_pairs": self.num_pairs,
            "auc": {f"{limit:g}": value for limit, value in self.auc.items()},
            "median_rotation_error_deg": self.median_rotation_error_deg,
            "median_direction_error_deg": self.median_direction_error_deg,
            "median_position_error": self.median_position_error,
            "pair_errors_deg": [[*pair, *errors] for pair, errors in self.pair_errors_deg.items()],
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build from :meth:`to_mapping`."""
        return cls(
            tuple(values["correct_names"]),
            {(a, b): (rotation, direction) for a, b, rotation, direction
             in values["pair_errors_deg"]},
            values["num_pairs"],
            {float(limit): value for limit, value in values["auc"].items()},
            values["median_position_error"],
        )  # fmt: skip


@dataclass(frozen=True)
class SeedResult:
    """Verification and mapping of one method with one seed.

    Attributes:
        seed: random seed.
        model_names: image names of each model, largest model first; empty if there is none.
        model_path: largest model, relative to the folder of the comparison; empty if none.
        num_points3D: of the largest model, as the next three.
        mean_track_length: images per point.
        mean_observations: observed points per registered image.
        mean_reprojection_error_px: over all observations.
        pair_inliers: verified pairs and their numbers of inliers.
        scores: against ground truth; None where there is none.
        wall_s: seconds of ``verify`` and ``map``.
        num_observations: observed points of each image of the largest model.
    """

    seed: int
    model_names: tuple[tuple[str, ...], ...]
    model_path: str
    num_points3D: int
    mean_track_length: float
    mean_observations: float
    mean_reprojection_error_px: float
    pair_inliers: Mapping[Pair, int]
    scores: PoseScores | None
    wall_s: Mapping[str, float]
    num_observations: Mapping[str, int] = field(default_factory=dict)

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Images of the largest model."""
        return self.model_names[0] if self.model_names else ()

    @property
    def correct_names(self) -> tuple[str, ...]:
        """Images registered correctly; without ground truth those registered."""
        return self.registered_names if self.scores is None else self.scores.correct_names

    @property
    def num_inliers(self) -> int:
        """Inliers of all verified pairs."""
        return sum(self.pair_inliers.values())

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {
            "seed": self.seed,
            **{key: measure(self) for key, measure in MEASURES.items()},
            "models": [list(names) for names in self.model_names],
            "model_path": self.model_path,
            "num_observations": dict(self.num_observations),
            "pair_inliers": _pair_rows(self.pair_inliers),
            "scores": self.scores.to_mapping() if self.scores else None,
            "wall_s": dict(self.wall_s),
        }

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build from :meth:`to_mapping`."""
        return cls(
            seed=values["seed"],
            model_names=tuple(tuple(names) for names in values["models"]),
            model_path=values["model_path"],
            num_points3D=values["points3D"],
            mean_track_length=values["mean_track_length"],
            mean_observations=values["mean_observations"],
            mean_reprojection_error_px=values["mean_reprojection_error_px"],
            pair_inliers=_pair_mapping(values["pair_inliers"]),
            scores=PoseScores.from_mapping(values["scores"]) if values["scores"] else None,
            wall_s=values["wall_s"],
            num_observations=values["num_observations"],
        )


MEASURES: dict[str, Callable[[SeedResult], float]] = {
    "registered": lambda seed: len(seed.registered_names),
    "num_models": lambda seed: len(seed.model_names),
    "verified_pairs": lambda seed: len(seed.pair_inliers),
    "inliers": lambda seed: seed.num_inliers,
    "points3D": lambda seed: seed.num_points3D,
    "mean_track_length": lambda seed: seed.mean_track_length,
    "mean_observations": lambda seed: seed.mean_observations,
    "mean_reprojection_error_px": lambda seed: seed.mean_reprojection_error_px,
}
"""Numbers of every seed, by their names in JSON and CSV."""


@dataclass(frozen=True)
class MethodResult:
    """One method on all images.

    Attributes:
        name: ``sift``, ``sift-affine-dsp`` or the name of a recipe.
        summary: one line for people.
        num_keypoints: by image name; images that could not be read are missing.
        raw_matches: number of matches before verification of each pair.
        seeds: one result per seed, in the order asked for; empty if the method failed.
        wall_s: seconds of ``extract``, ``match`` and, for recipes that climb, ``escalate``.
        peak_memory_bytes: of the process that ran the method.
        failures: images that could not be used, with the reason.
        options: all options of the method.
        folder: its results, relative to the folder of the comparison.
        failed: why it failed as a whole; empty if it did not.
        unstable_names: images whose poses contradict each other from seed to seed.
        disagreements: by the name of another method, the images that both register with the
            first seed in poses that contradict each other.
    """

    name: str
    summary: str = ""
    num_keypoints: Mapping[str, int] = field(default_factory=dict)
    raw_matches: Mapping[Pair, int] = field(default_factory=dict)
    seeds: tuple[SeedResult, ...] = ()
    wall_s: Mapping[str, float] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    failures: Mapping[str, str] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: str = ""
    failed: str = ""
    unstable_names: tuple[str, ...] = ()
    disagreements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def registered(self) -> Span:
        """Images in the largest model."""
        return Span.of(len(seed.registered_names) for seed in self.seeds)

    @property
    def correct(self) -> Span | None:
        """Images registered correctly; None without ground truth."""
        scores = [seed.scores for seed in self.seeds if seed.scores is not None]
        return Span.of(len(item.correct_names) for item in scores) if scores else None

    @property
    def usually_registered(self) -> frozenset[str]:
        """Images that more than half of the seeds register."""
        return _usual([seed.registered_names for seed in self.seeds])

    @property
    def usually_correct(self) -> frozenset[str]:
        """Images that more than half of the seeds register correctly.

        Without ground truth, register.
        """
        return _usual([seed.correct_names for seed in self.seeds])

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds of every stage; of those that run once per seed, the mean."""
        stages = dict.fromkeys(stage for seed in self.seeds for stage in seed.wall_s)
        means = {stage: fmean(seed.wall_s[stage] for seed in self.seeds) for stage in stages}
        return {**self.wall_s, **means}

    @property
    def total_s(self) -> float:
        """Seconds from photographs to one model."""
        return sum(self.stage_seconds.values())

    def span(self, measure: str) -> Span:
        """Return one of ``MEASURES`` over the seeds."""
        return Span.of(MEASURES[measure](seed) for seed in self.seeds)

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for JSON; without seeds where the method failed."""
        shared = {
            "summary": self.summary,
            "failures": dict(self.failures),
            "options": dict(self.options),
            "folder": self.folder,
        }
        if self.failed:
            return {"failed": self.failed, **shared}
        return {
            **{key: asdict(self.span(key)) for key in MEASURES},
            "correct": asdict(self.correct) if self.correct else None,
            "registered_names": {str(s.seed): list(s.registered_names) for s in self.seeds},
            "wall_s": self.stage_seconds,
            "total_s": self.total_s,
            "peak_memory_bytes": self.peak_memory_bytes,
            "unstable_names": list(self.unstable_names),
            "disagreements": {name: list(these) for name, these in self.disagreements.items()},
            "num_keypoints": dict(self.num_keypoints),
            "raw_matches": _pair_rows(self.raw_matches),
            **shared,
            "seeds": [seed.to_mapping() for seed in self.seeds],
        }

    @classmethod
    def from_mapping(cls, name: str, values: Mapping[str, Any]) -> Self:
        """Build from :meth:`to_mapping`."""
        seeds = tuple(SeedResult.from_mapping(seed) for seed in values.get("seeds", ()))
        of_seeds = {stage for seed in seeds for stage in seed.wall_s}
        wall_s = values.get("wall_s", {})
        return cls(
            name=name,
            summary=values["summary"],
            num_keypoints=values.get("num_keypoints", {}),
            raw_matches=_pair_mapping(values.get("raw_matches", ())),
            seeds=seeds,
            wall_s={stage: wall_s[stage] for stage in wall_s if stage not in of_seeds},
            peak_memory_bytes=values.get("peak_memory_bytes", 0),
            failures=values["failures"],
            options=values["options"],
            folder=values["folder"],
            failed=values.get("failed", ""),
            unstable_names=tuple(values.get("unstable_names", ())),
            disagreements={
                other: tuple(names) for other, names in values.get("disagreements", {}).items()
            },
        )


def _usual(names_of_seeds: Sequence[Sequence[str]]) -> frozenset[str]:
    """Return the names that more than half of the seeds have."""
    counts: dict[str, int] = {}
    for names in names_of_seeds:
        for name in names:
            counts[name] = counts.get(name, 0) + 1
    return frozenset(name for name, count in counts.items() if 2 * count > len(names_of_seeds))


def _pair_rows(values: Mapping[Pair, int]) -> list[list[Any]]:
    return [[*pair, value] for pair, value in sorted(values.items())]


def _pair_mapping(rows: Iterable[Sequence[Any]]) -> dict[Pair, int]:
    return {(first, second): value for first, second, value in rows}


@dataclass(frozen=True)
class Comparison:
    """Several methods on one set of photographs.

    Attributes:
        image_names: all images given, sorted.
        image_path: their folder.
        methods: in the order asked for.
        seeds: random seeds.
        num_pairs: pairs that were to be matched.
        settings: cameras, masks, pair list, preset and mapper that all methods had.
        versions: of the programs.
    """

    image_names: tuple[str, ...]
    image_path: str
    methods: tuple[MethodResult, ...]
    seeds: tuple[int, ...]
    num_pairs: int
    settings: Mapping[str, Any]
    versions: Mapping[str, str]

    @property
    def finished(self) -> tuple[MethodResult, ...]:
        """The methods that did not fail."""
        return tuple(method for method in self.methods if not method.failed)

    @property
    def only_registered_by(self) -> dict[str, str]:
        """Image name to the one method that usually registers it."""
        by_image = {
            name: [m.name for m in self.finished if name in m.usually_registered]
            for name in self.image_names
        }
        return {name: methods[0] for name, methods in by_image.items() if len(methods) == 1}

    @property
    def registered_by_none(self) -> tuple[str, ...]:
        """Images that no method usually registers."""
        registered = frozenset[str]().union(*(m.usually_registered for m in self.finished))
        return tuple(name for name in self.image_names if name not in registered)

    @property
    def has_ground_truth(self) -> bool:
        """Whether models were measured against ground truth."""
        return any(seed.scores for method in self.finished for seed in method.seeds)

    @property
    def verdict(self) -> tuple[str, ...]:
        """What was gained or lost, at what cost, and what is doubtful: paragraphs of text."""
        return verdict(self)

    def summary(self) -> str:
        """Return a table and the verdict for the terminal."""
        return tables.summary(self)

    def to_csv(self) -> str:
        """Return ``comparison.csv``: a row for each method and seed."""
        return tables.comparison_csv(self)

    def to_mapping(self) -> dict[str, Any]:
        """Return the content of ``comparison.json``."""
        return {
            "verdict": list(self.verdict),
            "images_total": len(self.image_names),
            "only_registered_by": self.only_registered_by,
            "registered_by_none": list(self.registered_by_none),
            "methods": {method.name: method.to_mapping() for method in self.methods},
            "seeds": list(self.seeds),
            "image_path": self.image_path,
            "image_names": list(self.image_names),
            "num_pairs": self.num_pairs,
            "settings": dict(self.settings),
            "versions": dict(self.versions),
        }

    def to_json(self) -> str:
        """Return ``comparison.json`` as text."""
        return json.dumps(self.to_mapping(), indent=2, ensure_ascii=False) + "\n"

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read ``comparison.json``.

        Raises:
            StoreError: when it is damaged or something else.
        """
        try:
            values = json.loads(text)
            return cls(
                image_names=tuple(values["image_names"]),
                image_path=values["image_path"],
                methods=tuple(
                    MethodResult.from_mapping(name, method)
                    for name, method in values["methods"].items()
                ),
                seeds=tuple(values["seeds"]),
                num_pairs=values["num_pairs"],
                settings=values["settings"],
                versions=values["versions"],
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise StoreError(f"not the result of a comparison ({error!r})") from error
