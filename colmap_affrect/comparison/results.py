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
images are off by at most this, in rotation and in translation direction. It is the limit of solved
pairs in ``evaluation/truths``, which is that of the paper.
"""


@dataclass(frozen=True)
class PoseScores:
    """Registered images that have a true pose, by whether they are registered correctly."""

    correct_names: tuple[str, ...]  # registered correctly (``MAX_CORRECT_ERROR_DEG``)
    wrong_names: tuple[str, ...]  # the others
    # Over the pairs of these images; None without pairs
    median_rotation_error_deg: float | None


def pair_errors(estimated: Poses, truth: Poses) -> PairErrors:
    """Compute the errors of the relative poses of all pairs of images that both have."""
    errors = {}
    names = sorted(estimated.keys() & truth.keys())
    for name1, name2 in itertools.combinations(names, 2):
        errors[name1, name2] = pose_errors(
            relative_pose(estimated[name1], estimated[name2]),
            relative_pose(truth[name1], truth[name2]),
        )
    return errors


def correct_images(errors: PairErrors) -> tuple[str, ...]:
    """Return the images that at least half of their pairs with other images place correctly."""
    num_correct: dict[str, int] = {}
    for pair, (rotation_deg, direction_deg) in errors.items():
        is_correct = max(rotation_deg, direction_deg) <= MAX_CORRECT_ERROR_DEG
        for name in pair:
            num_correct[name] = num_correct.get(name, 0) + is_correct
    num_others = len(num_correct) - 1
    correct = list[str]()
    for name, count in sorted(num_correct.items()):
        if 2 * count >= num_others:
            correct.append(name)
    return tuple(correct)


def pose_scores(
    estimated: Poses, truth: Poses, image_names: Sequence[str]
) -> PoseScores:
    """Score the poses of registered images against ground truth.

    Args:
        estimated: poses of the registered images.
        truth: true poses, in any world frame of any scale.
        image_names: images that are scored; others may be in both models.

    Returns:
        Which images are registered correctly, and how far the others are off.
    """
    scored = {name: truth[name] for name in truth.keys() & image_names}
    errors = pair_errors(estimated, scored)
    correct = correct_images(errors)
    names = set(itertools.chain.from_iterable(errors))
    rotations_deg = [rotation_deg for rotation_deg, _ in errors.values()]
    return PoseScores(
        correct_names=correct,
        wrong_names=tuple(sorted(names.difference(correct))),
        median_rotation_error_deg=median(rotations_deg) if errors else None,
    )


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
    # what follows is of the largest model
    points3D: int
    mean_track_length: float  # images per point
    mean_reprojection_error_px: float
    sure: tuple[str, ...] = ()  # images of high confidence
    # Images of low confidence: why
    doubtful: Mapping[str, str] = field(default_factory=dict)
    # Seconds of ``verify`` and ``map``
    wall_s: Mapping[str, float] = field(default_factory=dict)
    scores: PoseScores | None = None  # against ground truth; None where there is none

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Images of the largest model."""
        return self.models[0] if self.models else ()


Value = Callable[[SeedResult], float | None]


@dataclass(frozen=True)
class Measure:
    """A number of every seed, and how tables write it."""

    title: str  # of its column
    value: Value  # None where a seed has no such number
    digits: int = 1  # decimals, where not all values are whole


def _of_model(name: str) -> Value:
    """Return what tells a number of the largest model, where there is one."""
    return lambda seed: getattr(seed, name) if seed.models else None


def _num_correct(seed: SeedResult) -> float | None:
    return len(seed.scores.correct_names) if seed.scores else None


def _median_rotation_error_deg(seed: SeedResult) -> float | None:
    return seed.scores.median_rotation_error_deg if seed.scores else None


def _num_sure(seed: SeedResult) -> float | None:
    """Return how many images are sure, where no truth tells more."""
    return None if seed.scores else len(seed.sure)


def _num_unsure(seed: SeedResult) -> float | None:
    """Return how many images are neither sure nor doubtful, where no truth tells more."""
    if seed.scores:
        return None
    return len(seed.registered_names) - len(seed.sure) - len(seed.doubtful)


def _num_doubtful(seed: SeedResult) -> float | None:
    return None if seed.scores else len(seed.doubtful)


MEASURES = {
    "registered": Measure("registered", lambda seed: len(seed.registered_names)),
    "correct": Measure("correct", _num_correct),
    "num_sure": Measure("sure", _num_sure),
    "num_unsure": Measure("unsure", _num_unsure),
    "num_doubtful": Measure("doubtful", _num_doubtful),
    "verified_pairs": Measure("pairs", lambda seed: seed.verified_pairs),
    "points3D": Measure(title="points", value=_of_model("points3D"), digits=0),
    "mean_track_length": Measure(
        title="track", value=_of_model("mean_track_length"), digits=2
    ),
    "mean_reprojection_error_px": Measure(
        title="px", value=_of_model("mean_reprojection_error_px"), digits=2
    ),
    "median_rotation_error_deg": Measure(
        title="degrees", value=_median_rotation_error_deg, digits=2
    ),
}
"""Numbers of every seed, by their names in JSON."""


def measured(seed: SeedResult) -> dict[str, float | None]:
    """Return the values of ``MEASURES``, None where a seed has no such number."""
    return {key: measure.value(seed) for key, measure in MEASURES.items()}


@dataclass(frozen=True)
class MethodResult:
    """One method on all images."""

    name: str  # label of the method
    _: KW_ONLY
    summary: str = ""  # of the method
    folder: str = ""  # of its results, relative to the folder of the comparison
    options: Mapping[str, Any] = field(default_factory=dict)
    failed: str = ""  # why it failed as a whole; empty if it did not
    # Images that cannot be used: why
    failures: Mapping[str, str] = field(default_factory=dict)
    lacks: str = ""  # how to get the weights that it ran without
    # Seconds of stages before all seeds
    wall_s: Mapping[str, float] = field(default_factory=dict)
    peak_memory_bytes: int = 0
    # In the order asked for; empty if the method failed
    seeds: tuple[SeedResult, ...] = ()

    def span(self, measure: str) -> Span | None:
        """Return one of ``MEASURES`` over the seeds that have it; None without any."""
        known = []
        for seed in self.seeds:
            value = measured(seed)[measure]
            if value is not None:
                known.append(value)
        return Span.of(known) if known else None

    @property
    def registered(self) -> Span:
        """Images in the largest model."""
        return Span.of(len(seed.registered_names) for seed in self.seeds)

    @property
    def trusted(self) -> Span:
        """Images registered correctly; without ground truth those of high confidence."""
        counts = []
        for seed in self.seeds:
            names = seed.scores.correct_names if seed.scores else seed.sure
            counts.append(len(names))
        return Span.of(counts)

    @property
    def shown_seed(self) -> SeedResult | None:
        """The first seed that has a model."""
        return next((seed for seed in self.seeds if seed.model_path), None)

    @cached_property
    def usually_registered(self) -> frozenset[str]:
        """Images that more than half of the seeds register."""
        return frozenset(_in_most([seed.registered_names for seed in self.seeds]))

    @cached_property
    def usually_doubted(self) -> dict[str, str]:
        """Images of low confidence with more than half of the seeds, with the last reason."""
        reasons: dict[str, str] = {}
        for seed in self.seeds:
            reasons.update(seed.doubtful)
        names = _in_most([seed.doubtful for seed in self.seeds])
        return {name: reasons[name] for name in names}

    @property
    def stage_seconds(self) -> dict[str, float]:
        """Seconds of every stage; of those that run once per seed, the mean.

        The first seed of a recipe with levels has none: escalation has verified and mapped.
        """
        seconds = dict(self.wall_s)
        for stage in itertools.chain.from_iterable(seed.wall_s for seed in self.seeds):
            seconds[stage] = fmean([seed.wall_s.get(stage, 0.0) for seed in self.seeds])
        return seconds

    @property
    def total_s(self) -> float:
        """Seconds from photographs to one model."""
        return sum(self.stage_seconds.values())


def _in_most(names_by_seed: Sequence[Iterable[str]]) -> list[str]:
    """Return the sorted names that more than half of the seeds have."""
    counts = Counter(itertools.chain.from_iterable(names_by_seed))
    names = list[str]()
    for name, count in sorted(counts.items()):
        if 2 * count > len(names_by_seed):
            names.append(name)
    return names


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
        # Imported here: that module imports this one.
        from colmap_affrect.comparison.tables import summary

        return summary(self)

    @property
    def finished(self) -> list[MethodResult]:
        """The methods that did not fail, most photographs first, of equals the fastest."""

        def rank(method: MethodResult) -> tuple[float, float, float]:
            return (-method.trusted.mean, -method.registered.mean, method.total_s)

        finished = [method for method in self.methods if not method.failed]
        return sorted(finished, key=rank)

    @property
    def has_ground_truth(self) -> bool:
        """Whether models were scored against ground truth."""
        seeds = itertools.chain.from_iterable(method.seeds for method in self.methods)
        return any(seed.scores for seed in seeds)

    @cached_property
    def registered_by(self) -> dict[str, list[str]]:
        """Names of the methods that usually register each image."""
        registered_by: dict[str, list[str]] = {name: [] for name in self.image_names}
        for method in self.finished:
            for name in method.usually_registered.intersection(registered_by):
                registered_by[name].append(method.name)
        return registered_by

    @property
    def only_registered_by(self) -> dict[str, str]:
        """Image name to the one method that usually registers it."""
        found = dict[str, str]()
        for name, methods in self.registered_by.items():
            if len(methods) == 1:
                found[name] = methods[0]
        return found

    @property
    def registered_by_none(self) -> tuple[str, ...]:
        """Images that no method usually registers."""
        names = list[str]()
        for name, methods in self.registered_by.items():
            if not methods:
                names.append(name)
        return tuple(names)
