"""What a comparison found, as frozen data; pydantic writes and reads it.

Everything derived (means, who registers what alone) is computed here from the results of single
seeds, so that terminal, page and JSON cannot disagree.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any, Self

from pydantic import (
    BeforeValidator,
    Field,
    PlainSerializer,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from colmap_affrect.comparison.pose_scores import PoseScores
from colmap_affrect.pairs.base import Pair

PairCounts = Annotated[
    Mapping[Pair, int],
    BeforeValidator(lambda rows: {(first, second): count for first, second, count in rows}),
    PlainSerializer(lambda counts: [[*pair, count] for pair, count in sorted(counts.items())]),
]
"""Numbers by pair; in JSON rows of two names and a number."""


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
class SeedResult:
    """Verification and mapping of one method with one seed."""

    seed: int
    # image names of each model, the largest model first
    model_names: Annotated[tuple[tuple[str, ...], ...], Field(alias="models")]
    model_path: str  # the largest model, relative to the folder of the comparison; empty if none
    # of the largest model, as all that follow
    num_points3D: Annotated[int, Field(alias="points3D")]
    mean_track_length: float  # images per point
    mean_reprojection_error_px: float
    pair_inliers: PairCounts  # of the verified pairs, whatever the model
    scores: PoseScores | None  # against ground truth; None where there is none
    wall_s: Mapping[str, float]  # seconds of ``verify`` and ``map``
    doubtful: Mapping[str, str] = field(default_factory=dict)  # images that cannot be trusted: why

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Images of the largest model."""
        return self.model_names[0] if self.model_names else ()

    @property
    def mean_observations(self) -> float:
        """Observed points per registered image."""
        return self.num_points3D * self.mean_track_length / max(1, len(self.registered_names))

    @property
    def correct_names(self) -> tuple[str, ...]:
        """Images registered correctly; without ground truth those registered."""
        return self.registered_names if self.scores is None else self.scores.correct_names

    @model_serializer(mode="wrap")
    def _with_measures(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        measures = {key: measure(self) for key, measure in MEASURES.items()}
        return {"seed": self.seed, **measures, **plain(self)}


MEASURES: dict[str, Callable[[SeedResult], float]] = {
    "registered": lambda seed: len(seed.registered_names),
    "num_doubtful": lambda seed: len(seed.doubtful),
    "num_models": lambda seed: len(seed.model_names),
    "verified_pairs": lambda seed: len(seed.pair_inliers),
    "inliers": lambda seed: sum(seed.pair_inliers.values()),
    "points3D": lambda seed: seed.num_points3D,
    "mean_track_length": lambda seed: seed.mean_track_length,
    "mean_observations": lambda seed: seed.mean_observations,
    "mean_reprojection_error_px": lambda seed: seed.mean_reprojection_error_px,
}
"""Numbers of every seed, by their names in JSON."""

OF_MODEL = {"points3D", "mean_track_length", "mean_observations", "mean_reprojection_error_px"}
"""Of these, what a seed without a model has none of."""


@dataclass(frozen=True)
class MethodResult:
    """One method on all images."""

    name: str  # label of the method
    _: KW_ONLY
    failed: str = ""  # why it failed as a whole; empty if it did not
    wall_s: Mapping[str, float] = field(default_factory=dict)  # of stages before all seeds
    peak_memory_bytes: int = 0
    # images whose poses contradict each other from seed to seed
    unstable_names: tuple[str, ...] = ()
    # by another method, images that both register with the first seed in contradicting poses
    disagreements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    num_keypoints: Mapping[str, int] = field(default_factory=dict)  # of images that could be read
    summary: str = ""
    failures: Mapping[str, str] = field(default_factory=dict)  # images that cannot be used: why
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: str = ""  # of its results, relative to the folder of the comparison
    seeds: tuple[SeedResult, ...] = ()  # in the order asked for; empty if the method failed

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
    def pair_inliers(self) -> Mapping[Pair, int]:
        """Verified pairs of the first seed."""
        return self.seeds[0].pair_inliers

    @property
    def shown_seed(self) -> SeedResult | None:
        """The first seed that has a model."""
        return next((seed for seed in self.seeds if seed.model_path), None)

    @cached_property
    def usually_registered(self) -> frozenset[str]:
        """Images that more than half of the seeds register."""
        return in_most([seed.registered_names for seed in self.seeds])

    @cached_property
    def usually_correct(self) -> frozenset[str]:
        """Images that more than half of the seeds register correctly (without truth: register)."""
        return in_most([seed.correct_names for seed in self.seeds])

    @cached_property
    def usually_doubted(self) -> dict[str, str]:
        """Images that cannot be trusted in more than half of the seeds, with a reason."""
        seeds = [dict(seed.doubtful) for seed in self.seeds]
        names = in_most([list(reasons) for reasons in seeds])
        return {name: next(r[name] for r in seeds if name in r) for name in sorted(names)}

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

    def span(self, measure: str) -> Span | None:
        """Return one of ``MEASURES`` over the seeds; those of models None without any."""
        seeds = [s for s in self.seeds if s.model_names or measure not in OF_MODEL]
        return Span.of(MEASURES[measure](seed) for seed in seeds) if seeds else None

    @model_serializer(mode="wrap")
    def _with_spans(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = plain(self)
        if self.failed:
            return {key: values[key] for key in KEPT_OF_FAILED}
        del values["failed"]
        return {
            **{key: self.span(key) for key in MEASURES},
            "correct": self.correct,
            "registered_names": {str(s.seed): s.registered_names for s in self.seeds},
            "total_s": self.total_s,
            **values,
            "wall_s": self.stage_seconds,
        }


KEPT_OF_FAILED = ("failed", "name", "summary", "failures", "options", "folder")


def in_most(names_of_seeds: Sequence[Sequence[str]]) -> frozenset[str]:
    """Return what more than half of the seeds name."""
    counts = Counter(name for names in names_of_seeds for name in names)
    return frozenset(name for name, count in counts.items() if 2 * count > len(names_of_seeds))


@dataclass(frozen=True)
class Comparison:
    """Several methods on one set of photographs."""

    image_names: tuple[str, ...]  # all images given, sorted
    image_path: str
    methods: tuple[MethodResult, ...]
    seeds: tuple[int, ...]
    num_pairs: int  # that were to be matched
    settings: Mapping[str, Any]  # cameras, masks, pair list, preset and mapper of all methods
    versions: Mapping[str, str]

    @property
    def finished(self) -> tuple[MethodResult, ...]:
        """The methods that did not fail."""
        return tuple(method for method in self.methods if not method.failed)

    def model_paths(self, output_path: Path) -> dict[str, Path | None]:
        """Return the folder of the first model of each finished method; None for none."""
        shown = {method.name: method.shown_seed for method in self.finished}
        return {name: output_path / s.model_path if s else None for name, s in shown.items()}

    @property
    def only_registered_by(self) -> dict[str, str]:
        """Image name to the one method that usually registers it."""
        by_image: dict[str, list[str]] = {name: [] for name in self.image_names}
        for method in self.finished:
            for name in method.usually_registered:
                by_image[name].append(method.name)
        return {name: methods[0] for name, methods in by_image.items() if len(methods) == 1}

    @cached_property
    def registered_by_none(self) -> tuple[str, ...]:
        """Images that no method usually registers."""
        registered = {name for method in self.finished for name in method.usually_registered}
        return tuple(name for name in self.image_names if name not in registered)

    @property
    def has_ground_truth(self) -> bool:
        """Whether models were measured against ground truth."""
        return any(method.correct for method in self.finished)

    @cached_property
    def names_with_truth(self) -> frozenset[str]:
        """Images whose poses were measured against ground truth, by any method."""
        scores = [seed.scores for method in self.finished for seed in method.seeds if seed.scores]
        return frozenset(name for each in scores for pair in each.pair_errors_deg for name in pair)

    @model_serializer(mode="wrap")
    def _with_totals(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        values: dict[str, Any] = plain(self)
        return {
            "images_total": len(self.image_names),
            "only_registered_by": self.only_registered_by,
            "registered_by_none": self.registered_by_none,
            "methods": {method.pop("name"): method for method in values.pop("methods")},
            **values,
        }
