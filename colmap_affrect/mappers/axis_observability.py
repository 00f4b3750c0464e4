"""How far the optical axes of a model may be off where nobody knows principal points.

A crop, or a print of a view camera, has its principal point anywhere. With another one the camera
turns, and what it sees hardly changes. A model is adjusted again with principal points so far away
that the camera is turned by as much as a right photograph may be off: how much the cost grows then
tells how likely that is.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster, EarlyStop
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.camera_priors import CameraPrior
from colmap_affrect.mappers.focal_observability import (
    MAX_NUM_IMAGES,
    MIN_COST,
    NUM_ITERATIONS,
    num_independent,
    with_fewer_points,
)

WRONG_DEG = 5.0  # by which the rotation of a right photograph may be off
MAX_COST = 20.0  # nats, from which on another axis is out of question
MAX_NUM_CAMERAS = 12  # whose axes are moved one at a time; of more every n-th one, to save time
DIRECTIONS = (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)


def axis_doubts(
    model: pycolmap.Reconstruction, task: MappingTask, priors: Mapping[int, CameraPrior]
) -> dict[int, float]:
    """Return how likely rotations are off by ``WRONG_DEG`` because principal points are unknown.

    Args:
        model: It stays as it is.
        task: What it was made from.
        priors: Priors of its cameras, by camera id.

    Returns:
        The probabilities by id of the camera, of those whose principal point is not held.
    """
    free = [key for key, prior in sorted(priors.items()) if prior.principal_point]
    if not free or model.num_reg_images() > MAX_NUM_IMAGES or not model.num_points3D():
        return {}
    trials = _AxisTrials(model, task, priors)
    step = math.ceil(len(free) / MAX_NUM_CAMERAS)
    tried = {key: trials.doubt(key) for key in free[::step]}
    most = max(tried.values())
    return {key: tried.get(key, most) for key in free}


class _AxisTrials:
    """Adjusts a model with other principal points."""

    def __init__(
        self, model: pycolmap.Reconstruction, task: MappingTask, priors: Mapping[int, CameraPrior]
    ) -> None:
        """Adjust a copy of the model as it is.

        Args:
            model: It stays as it is.
            task: Says which cameras are held.
            priors: Priors of its cameras, by camera id.
        """
        self.model = with_fewer_points(model)
        self.priors = {}
        for key, prior in priors.items():
            has_distortion = not model.cameras[key].is_undistorted()
            self.priors[key] = replace(prior, has_distortion=has_distortion)
        self.fixed = frozenset(key for key, record in task.cameras.items() if record.is_fixed)
        self.cost = max(self._adjust(self.model, self.priors), MIN_COST)
        num_observations = max(1, self.model.compute_num_observations())
        self.independent_share = num_independent(self.model) / num_observations

    def _adjust(
        self,
        model: pycolmap.Reconstruction,
        priors: Mapping[int, CameraPrior],
        early_stop: EarlyStop | None = None,
    ) -> float:
        refining = pycolmap.BundleAdjustmentOptions()
        adjuster = Adjuster(priors, NOISE_PX, refining, self.fixed)
        return adjuster.adjust(model, NUM_ITERATIONS, early_stop=early_stop)

    def doubt(self, camera_id: int) -> float:
        """Return the probability that an axis is off, by the direction that is likeliest."""
        prior = self.priors[camera_id]
        priors = {**self.priors, camera_id: replace(prior, principal_point=None)}
        least = MAX_COST
        for across, down in DIRECTIONS:
            trial = pycolmap.Reconstruction(self.model)
            camera = trial.camera(camera_id)
            distance_px = math.tan(math.radians(WRONG_DEG)) * camera.mean_focal_length()
            camera.principal_point_x += across * distance_px
            camera.principal_point_y += down * distance_px
            enough = 1.0 + MAX_COST / (self.independent_share * self.cost)
            early_stop = EarlyStop(self.cost, enough, NUM_ITERATIONS)
            growth = self._adjust(trial, priors, early_stop) - self.cost
            least = min(least, self.independent_share * growth)
        return min(1.0, math.exp(-least))
