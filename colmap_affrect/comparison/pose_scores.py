"""Camera poses of a model against ground truth, or against another model."""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, computed_field

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.poses import Poses, pose_errors, relative_pose
from colmap_affrect.pairs.base import Pair

PairErrors = Annotated[
    Mapping[Pair, tuple[float, float]],
    BeforeValidator(lambda rows: {(row[0], row[1]): tuple(row[2:]) for row in rows}),
    PlainSerializer(lambda errors: [[*pair, *both] for pair, both in errors.items()]),
]
"""By the sorted names of two images: the errors of their relative pose in degrees, of the rotation
and of the direction of the translation; in JSON rows of both."""

AUC_THRESHOLDS_DEG = (1.0, 3.0, 5.0, 10.0)
MAX_CORRECT_ERROR_DEG = 5.0
"""An image is registered correctly if its relative poses to at least half of the other registered
images are off by at most this, in rotation and in translation direction."""
MIN_IMAGES_TO_ALIGN = 3
MAX_ALIGNMENT_ERROR = 0.05  # of the true extent; centres farther off do not decide alignment


@dataclass(frozen=True)
class PoseScores:
    """A model against ground truth."""

    correct_names: tuple[str, ...]  # images registered correctly (``MAX_CORRECT_ERROR_DEG``)
    pair_errors_deg: PairErrors  # of every pair of registered images that have ground truth
    num_pairs: int  # of all images with truth; those without errors count as failures
    auc: Mapping[str, float]  # area under the curve, 0 to 1, by the threshold in degrees
    # of camera centres after similarity alignment, in units of the ground truth; None with fewer
    # than three images, or all on one line
    median_position_error: float | None

    @computed_field  # type: ignore[prop-decorator]  # of a property, as pydantic documents it
    @property
    def median_rotation_error_deg(self) -> float | None:
        """Of the pairs of registered images; None without pairs."""
        return median(r for r, _ in self.pair_errors_deg.values()) if self.pair_errors_deg else None


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
    """Return the images whose relative poses to at least half of the others are right.

    A pair is right if both of its errors are at most ``MAX_CORRECT_ERROR_DEG``; all are given.
    """
    right = (pair for pair, both in errors.items() if max(both) <= MAX_CORRECT_ERROR_DEG)
    num_right = Counter(itertools.chain.from_iterable(right))
    names = {name for pair in errors for name in pair}
    return tuple(sorted(name for name in names if 2 * num_right[name] >= len(names) - 1))


def area_under_curve(errors_deg: Iterable[float], num_pairs: int, threshold_deg: float) -> float:
    """Integrate the share of pairs with at most an error over errors from 0 to a threshold.

    The exact area under the steps, divided by the threshold: from 0 to 1. Of ``num_pairs`` those
    without an error were not estimated, and are never below a threshold.
    """
    if not num_pairs:
        return 0.0
    return math.fsum(max(0.0, 1.0 - error / threshold_deg) for error in errors_deg) / num_pairs


def position_errors(estimated: Poses, truth: Poses) -> dict[str, float]:
    """Compute the distances of camera centres after the best similarity has aligned them.

    Centres that are far off do not pull at the alignment. In units of the ground truth; empty with
    fewer than three images, or centres on one line, which leaves the similarity open.
    """
    names = sorted(estimated.keys() & truth.keys())
    if len(names) < MIN_IMAGES_TO_ALIGN:
        return {}
    centres, true_centres = (
        np.array([-poses[name][0].T @ poses[name][1] for name in names])
        for poses in (estimated, truth)
    )
    extent = float(np.linalg.norm(np.ptp(true_centres, axis=0)))
    robust: Any = pycolmap.estimate_sim3d_robust(  # its stub says Sim3d, it is a dictionary
        centres,
        true_centres,
        pycolmap.RANSACOptions(max_error=MAX_ALIGNMENT_ERROR * extent, random_seed=0),
    )
    if not robust:
        return {}
    aligned = robust["tgt_from_src"]
    moved = centres @ aligned.matrix()[:, :3].T + aligned.matrix()[:, 3]
    return dict(zip(names, np.linalg.norm(moved - true_centres, axis=1).tolist(), strict=True))


def pose_scores(estimated: Poses, truth: Poses, image_names: Sequence[str]) -> PoseScores:
    """Measure the poses of registered images against ground truth, of the images given only."""
    given = {name: pose for name, pose in truth.items() if name in set(image_names)}
    errors = pair_errors(estimated, given)
    largest = [max(both) for both in errors.values()]
    num_pairs = math.comb(len(given), 2)
    distances = list(position_errors(estimated, given).values())
    return PoseScores(
        correct_names=correct_images(errors),
        pair_errors_deg=errors,
        num_pairs=num_pairs,
        auc={
            f"{limit:g}": area_under_curve(largest, num_pairs, limit)
            for limit in AUC_THRESHOLDS_DEG
        },
        median_position_error=float(np.median(distances)) if distances else None,
    )


def disagreeing_images(poses: Poses, other: Poses) -> tuple[str, ...]:
    """Return the images that two models have both, in poses that contradict each other.

    An image agrees if its relative poses to at least half of the other common images do.
    """
    errors = pair_errors(poses, other)
    agreeing = set(correct_images(errors))
    return tuple(sorted({name for pair in errors for name in pair} - agreeing))
