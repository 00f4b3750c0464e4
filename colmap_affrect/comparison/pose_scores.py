"""Camera poses of a model against ground truth."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

from colmap_affrect.colmap.model_files import Poses, pose_errors, relative_pose
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
    given = {name: pose for name, pose in truth.items() if name in set(image_names)}
    errors = pair_errors(estimated, given)
    correct = correct_images(errors)
    names = {name for pair in errors for name in pair}
    return PoseScores(
        correct_names=correct,
        wrong_names=tuple(sorted(names - set(correct))),
        median_rotation_error_deg=median(r for r, _ in errors.values()) if errors else None,
    )
