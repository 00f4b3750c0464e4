"""The poses that photographs would have with other cameras, and how likely these cameras are.

Images of one size are taken for those of one camera, and given focal lengths for right, as long as
points do not contradict it. Few points contradict nothing. Where the photographs stand elsewhere
with cameras that fit as well, a pose is as sure as these are unlikely (model averaging: Hoeting et
al., Bayesian model averaging: a tutorial, 1999).
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import pose_errors, relative_pose
from colmap_affrect.mappers.pair_graph import poses_of


@dataclass(frozen=True)
class OtherPose:
    """The pose of an image with other cameras."""

    probability: float = 0.0  # of these cameras, against those of the model
    turn_deg: float = 0.0  # from the pose that the model has
    is_shared: bool = False  # whether these are one camera


NO_OTHER_POSE = OtherPose()


@dataclass(frozen=True)
class OtherCameras:
    """Other cameras of the images of a model."""

    log_odds: float = -math.inf  # that they are right, against those of the model
    turns_deg: Mapping[str, float] = field(default_factory=dict)  # by image name
    are_shared: bool = False  # one camera, where images of the model have their own

    def pose_of(self, name: str) -> OtherPose:
        """Return the pose of an image with these cameras."""
        probability = probability_of(self.log_odds)
        return OtherPose(probability, self.turns_deg.get(name, 0.0), self.are_shared)


NO_OTHER_CAMERAS = OtherCameras()


def probability_of(log_odds: float) -> float:
    """Return the probability of log odds, of any size."""
    return 0.5 * (1.0 + math.tanh(0.5 * log_odds))


def pose_turns_deg(
    model: pycolmap.Reconstruction,
    changed: pycolmap.Reconstruction,
    image_ids: Collection[int] | None = None,
) -> dict[str, float]:
    """Return by how much the poses of a model differ from those of a changed one.

    Args:
        model: The model.
        changed: The same images, with other cameras, or by other points.
        image_ids: Of the images that are looked at; by default all of both.

    Returns:
        By image name the median change of its poses beside the others, in degrees, in rotation or
        in direction, whichever is larger.
    """
    before = poses_of(model)
    after = poses_of(changed)

    def change_deg(first: int, second: int) -> float:
        old = relative_pose(before[first], before[second])
        new = relative_pose(after[first], after[second])
        return max(pose_errors(new, old))

    if image_ids is None:
        image_ids = before.keys() & after.keys()
    return median_changes(model, image_ids, change_deg)


def median_changes(
    model: pycolmap.Reconstruction,
    image_ids: Collection[int],
    change: Callable[[int, int], float],
) -> dict[str, float]:
    """Return the median of what changes between an image and each of the others.

    Args:
        model: Has the images.
        image_ids: Of the images.
        change: Of two images; what their order changes is small, and does not count.

    Returns:
        By image name; nothing of an image alone.
    """
    changes = defaultdict[int, list[float]](list)
    for first, second in itertools.combinations(sorted(image_ids), 2):
        of_both = change(first, second)
        changes[first].append(of_both)
        changes[second].append(of_both)
    found = dict[str, float]()
    for image_id, of_image in changes.items():
        found[model.images[image_id].name] = float(np.median(of_image))
    return found
