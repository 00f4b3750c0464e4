"""What a comparison found, as plain data.

Registered is not correct: poses are held against ground truth where there is one.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from statistics import fmean, median
from typing import Any, Self

from colmap_affrect.colmap.model_files import Poses, pose_errors, relative_pose
from colmap_affrect.options import Summarized, documented
from colmap_affrect.pairs.lists import Pair

PairErrors = Mapping[Pair, tuple[float, float]]
"""By the sorted names of two images: the errors of their relative pose in degrees, of the rotation
and of the direction of the translation."""
MAX_CORRECT_ERROR_DEG = 5.0
"""An image is registered correctly if its relative poses to at least half of the other registered
images are off by at most this, in rotation and in translation direction."""


@dataclass(frozen=True)
class PoseScores:
    """A model against ground truth, in the registered images that have a true pose."""

    correct_names: tuple[str, ...]  # registered correctly (``MAX_CORRECT_ERROR_DEG``)
    wrong_names: tuple[str, ...]  # the others
    median_rotation_error_deg: float | None  # of the pairs of these images; None without pairs


def pair_errors(estimated: Poses, truth: Poses) -> PairErrors:
    """Compute the errors of the relative poses of all pairs of images that both have."""
    names = sorted(estimated.keys() & truth.keys())
    return {
        (name1, name2): pose_errors(
            relative_pose(estimated[name1], estimated[name2]),
            relative_pose(truth[name1], truth[name2]),
        )
        for name1, name2 in itertools.combinations(names, 2)
    }


def correct_images(errors: PairErrors) -> tuple[str, ...]:
    """Return the images in at least half of whose pairs both errors are at most the limit."""
    right = (pair for pair, both in errors.items() if max(both) <= MAX_CORRECT_ERROR_DEG)
    num_right = Counter(itertools.chain.from_iterable(right))
    names = {name for pair in errors for name in pair}
    return tuple(sorted(name for name in names if 2 * num_right[name] >= len(names) - 1))


def pose_scores(estimated: Poses, truth: Poses, image_names: Sequence[str]) -> PoseScores:
    """Measure the poses of registered images against ground truth, of the images given only."""
    errors = pair_errors(estimated, {name: truth[name] for name in truth.keys() & image_names})
    correct = correct_images(errors)
    wrong = {name for pair in errors for name in pair} - set(correct)
    rotations_deg = [rotation for rotation, _ in errors.values()]
    return PoseScores(correct, tuple(sorted(wrong)), median(rotations_deg) if errors else None)


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
        return cls(fmean(numbers), min(numbers), max(numbers))


@dataclass(frozen=True)
class SeedResult:
    """Verification and mapping of one method with one seed."""

    seed: int
    models: tuple[tuple[str, ...], ...]  # image names of each model, the largest first
    model_path: str  # the largest model, relative to the folder of the comparison; empty if none
    verified_pairs: int
    # of the largest model, as all that follow
    points3D: int
    mean_track_length: float  # images per point
    mean_reprojection_error_px: float
    sure: tuple[str, ...] = ()  # images that the mapper is sure of
    doubtful: Mapping[str, str] = field(default_factory=dict)  # images that may be wrong: why
    wall_s: Mapping[str, float] = field(default_factory=dict)  # seconds of ``verify`` and ``map``
    scores: PoseScores | None = None  # against ground truth; None where there is none

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Images of the largest model."""
        return self.models[0] if self.models else ()


@dataclass(frozen=True)
class Measure:
    """A number of every seed, and how tables write it."""

    title: str  # of its column
    of: Callable[[SeedResult], float | None]  # None where a seed has no such number
    digits: int = 1  # decimals, where not all values are whole


def _of_model(name: str) -> Callable[[SeedResult], float | None]:
    return lambda seed: getattr(seed, name) if seed.models else None


MEASURES = {
    "registered": Measure("registered", lambda seed: len(seed.registered_names)),
    "correct": Measure("correct", lambda s: len(s.scores.correct_names) if s.scores else None),
    "num_sure": Measure("sure", lambda seed: None if seed.scores else len(seed.sure)),
    "num_doubtful": Measure("doubtful", lambda seed: None if seed.scores else len(seed.doubtful)),
    "verified_pairs": Measure("pairs", lambda seed: seed.verified_pairs),
    "points3D": Measure("points", _of_model("points3D"), 0),
    "mean_track_length": Measure("track", _of_model("mean_track_length"), 2),
    "mean_reprojection_error_px": Measure("px", _of_model("mean_reprojection_error_px"), 2),
    "median_rotation_error_deg": Measure(
        "degrees", lambda seed: seed.scores.median_rotation_error_deg if seed.scores else None, 2
    ),
}
"""Numbers of every seed, by their names in JSON. With ground truth it is correct that counts,
without what the mapper is sure of."""


@dataclass(frozen=True)
class MethodResult:
    """One method on all images."""

    name: str  # label of the method
    _: KW_ONLY
    summary: str = ""  # of the method
    folder: str = ""  # of its results, relative to the folder of the comparison
    options: Mapping[str, Any] = field(default_factory=dict)
    failed: str = ""  # why it failed as a whole; empty if it did not
    failures: Mapping[str, str] = field(default_factory=dict)  # images that cannot be used: why
    lacks: str = ""  # how to get the weights that it ran without
    wall_s: Mapping[str, float] = field(default_factory=dict)  # of stages before all seeds
    peak_memory_bytes: int = 0
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
    def right(self) -> Span:
        """Images registered correctly; without ground truth those that the mapper is sure of."""
        found = (s.scores.correct_names if s.scores else s.sure for s in self.seeds)
        return Span.of(map(len, found))

    @property
    def shown_seed(self) -> SeedResult | None:
        """The first seed that has a model."""
        return next((seed for seed in self.seeds if seed.model_path), None)

    @cached_property
    def usually_registered(self) -> frozenset[str]:
        """Images that more than half of the seeds register."""
        return _in_most([seed.registered_names for seed in self.seeds])

    @cached_property
    def usually_doubted(self) -> dict[str, str]:
        """Images that are doubtful with more than half of the seeds, with a reason."""
        reasons = {name: why for seed in self.seeds for name, why in seed.doubtful.items()}
        return {n: reasons[n] for n in sorted(_in_most([[*s.doubtful] for s in self.seeds]))}

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds of every stage; of those that run once per seed, the mean.

        The first seed of a recipe with levels has none: escalation has verified and mapped.
        """
        stages = dict.fromkeys(stage for seed in self.seeds for stage in seed.wall_s)
        means = {
            stage: fmean(seed.wall_s.get(stage, 0.0) for seed in self.seeds) for stage in stages
        }
        return {**self.wall_s, **means}

    @property
    def total_s(self) -> float:
        """Seconds from photographs to one model."""
        return sum(self.stage_seconds.values())


def _in_most(names_of_seeds: Sequence[Sequence[str]]) -> frozenset[str]:
    """Return what more than half of the seeds name."""
    counts = Counter(name for names in names_of_seeds for name in names)
    return frozenset(name for name, count in counts.items() if 2 * count > len(names_of_seeds))


@documented
@dataclass(frozen=True)
class Comparison(Summarized):
    """Several methods on one set of photographs."""

    image_names: tuple[str, ...]
    """All images that were given, sorted."""
    image_path: str
    """Folder of the photographs."""
    methods: tuple[MethodResult, ...]
    """What each method found."""
    seeds: tuple[int, ...]
    """Seeds of verification and mapping."""
    num_pairs: int
    """Pairs that were to be matched."""
    settings: Mapping[str, Any]
    """Cameras, masks, pair list, preset and mapper of all methods."""
    versions: Mapping[str, str]
    """Versions of Python and of the packages that decide results."""

    def summary(self) -> str:
        """Return the table of methods, and what it means."""
        from colmap_affrect.comparison.tables import summary  # which imports this module

        return summary(self)

    @property
    def finished(self) -> list[MethodResult]:
        """The methods that did not fail, most photographs first, of equals the fastest."""
        methods = [method for method in self.methods if not method.failed]
        return sorted(methods, key=lambda m: (-m.right.mean, -m.registered.mean, m.total_s))

    @property
    def has_ground_truth(self) -> bool:
        """Whether models were measured against ground truth."""
        return any(seed.scores for method in self.methods for seed in method.seeds)

    @cached_property
    def registered_by(self) -> dict[str, list[str]]:
        """Names of the methods that usually register each image."""
        finished = self.finished
        return {
            name: [method.name for method in finished if name in method.usually_registered]
            for name in self.image_names
        }

    @property
    def only_registered_by(self) -> dict[str, str]:
        """Image name to the one method that usually registers it."""
        return {name: found[0] for name, found in self.registered_by.items() if len(found) == 1}

    @property
    def registered_by_none(self) -> tuple[str, ...]:
        """Images that no method usually registers."""
        return tuple(name for name, found in self.registered_by.items() if not found)
