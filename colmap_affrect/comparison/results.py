"""What a comparison found: frozen, printable, as JSON and as CSV.

Everything derived (means, who registers what alone, the verdict) is computed from the results of
single seeds, in one place each, so that terminal, page, JSON and CSV cannot disagree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

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
            ground truth; None with fewer than three images.
    """

    correct_names: tuple[str, ...]
    pair_errors_deg: Mapping[Pair, tuple[float, float]]
    num_pairs: int
    auc: Mapping[float, float]
    median_position_error: float | None


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

    @property
    def registered_names(self) -> tuple[str, ...]:
        """Images of the largest model."""
        return self.model_names[0] if self.model_names else ()


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
        names = {name for seed in self.seeds for name in seed.registered_names}
        return frozenset(
            name
            for name in names
            if 2 * sum(name in seed.registered_names for seed in self.seeds) > len(self.seeds)
        )


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
