"""What a comparison found, as frozen data; pydantic writes and reads it."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
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
        """Return the span of one or more values."""
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
    def correct_names(self) -> tuple[str, ...]:
        """Images registered correctly; without ground truth those registered."""
        return self.registered_names if self.scores is None else self.scores.correct_names

    @model_serializer(mode="wrap")
    def _with_measures(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {"seed": self.seed, **{k: m.of(self) for k, m in MEASURES.items()}, **plain(self)}


Better = Callable[[Iterable[float]], float] | None  # which of the means is best, if any


@dataclass(frozen=True)
class Measure:
    """A number of every seed, and how tables write it."""

    of: Callable[[SeedResult], float | None]  # None where a seed has no such number
    title: str  # of its line
    digits: int  # decimals, where not all values are whole
    better: Better = None
    column: str = ""  # title of its column in the terminal; empty: not shown there


def _of_scores(value: Callable[[PoseScores], float | None]) -> Callable[[SeedResult], float | None]:
    return lambda seed: value(seed.scores) if seed.scores else None


def _of_model(name: str) -> Callable[[SeedResult], float | None]:
    return lambda seed: getattr(seed, name) if seed.model_names else None


MEASURES = {
    "registered": Measure(
        lambda seed: len(seed.registered_names), "Registered, of {images}", 1, max, "registered"
    ),
    "correct": Measure(
        _of_scores(lambda scores: len(scores.correct_names)),
        "Registered correctly, of {images}", 1, max, "correct",
    ),
    "num_doubtful": Measure(lambda seed: len(seed.doubtful), "Doubtful", 1, min),
    "num_models": Measure(lambda seed: len(seed.model_names), "Models", 1),
    "verified_pairs": Measure(
        lambda seed: len(seed.pair_inliers), "Verified pairs, of {pairs}", 1, None, "verified"
    ),
    "points3D": Measure(_of_model("num_points3D"), "3D points", 0, max, "points"),
    "mean_track_length": Measure(
        _of_model("mean_track_length"), "Images per 3D point", 2, None, "track"
    ),
    "mean_reprojection_error_px": Measure(
        _of_model("mean_reprojection_error_px"), "Reprojection error, px", 2, None, "px"
    ),
    "median_rotation_error_deg": Measure(
        _of_scores(lambda scores: scores.median_rotation_error_deg),
        "Median rotation error, °", 2, min,
    ),
    "auc_5": Measure(
        _of_scores(lambda scores: scores.auc["5"]), "AUC of relative poses at 5°", 3, max
    ),
}  # fmt: skip
"""Numbers of every seed, by their names in JSON."""


@dataclass(frozen=True)
class MethodResult:
    """One method on all images."""

    name: str  # label of the method
    _: KW_ONLY
    failed: str = ""  # why it failed as a whole; empty if it did not
    wall_s: Mapping[str, float] = field(default_factory=dict)  # of stages before all seeds
    peak_memory_bytes: int = 0
    # by another method, images that both register with the first seed in contradicting poses
    disagreements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    num_keypoints: Mapping[str, int] = field(default_factory=dict)  # of images that could be read
    summary: str = ""
    failures: Mapping[str, str] = field(default_factory=dict)  # images that cannot be used: why
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: str = ""  # of its results, relative to the folder of the comparison
    seeds: tuple[SeedResult, ...] = ()  # in the order asked for; empty if the method failed

    def span(self, measure: str) -> Span | None:
        """Return one of ``MEASURES`` over the seeds that have it; None without any."""
        values = [MEASURES[measure].of(seed) for seed in self.seeds]
        known = [value for value in values if value is not None]
        return Span.of(known) if known else None

    @property
    def registered(self) -> Span:
        """Images in the largest model."""
        return Span.of(len(seed.registered_names) for seed in self.seeds)

    @property
    def correct(self) -> Span | None:
        """Images registered correctly; None without ground truth."""
        return self.span("correct")

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

    @model_serializer(mode="wrap")
    def _with_spans(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {
            **{key: self.span(key) for key in MEASURES},
            "registered_names": {str(s.seed): s.registered_names for s in self.seeds},
            "total_s": self.total_s,
            **plain(self),
            "wall_s": self.stage_seconds,
        }


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

    @property
    def only_registered_by(self) -> dict[str, str]:
        """Image name to the one method that usually registers it."""
        methods = {
            name: [method.name for method in self.finished if name in method.usually_registered]
            for name in self.image_names
        }
        return {name: found[0] for name, found in methods.items() if len(found) == 1}

    @cached_property
    def registered_by_none(self) -> tuple[str, ...]:
        """Images that no method usually registers."""
        registered = frozenset().union(*(method.usually_registered for method in self.finished))
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
