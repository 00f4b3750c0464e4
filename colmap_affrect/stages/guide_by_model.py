"""Guided matching of pairs that never matched, in the geometry that a model gives them.

Where both views see the same part of a model their epipolar lines are known, and among the few
features near a line one can stand out that was ambiguous in the whole image. All that is found
obeys the model's geometry, right or wrong, so that verification alone proves nothing: local affine
frames, which are not looked at before, must agree with it as well.
"""

import time
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import undistorted
from colmap_affrect.conventions import colmap_from_pixel
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.two_views import essential_matrix
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.report import StageReport
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.guide import Guiding, current, recorded_guiding
from colmap_affrect.stages.one_guided_pair import GuidedTask
from colmap_affrect.stages.pairs import deleted_pairs
from colmap_affrect.stages.verify import verified_inliers


@dataclass(frozen=True)
class View:
    """An image of a model."""

    camera: pycolmap.Camera  # its intrinsics
    pose: Array  # (3, 4), camera from world
    points: Array  # (N, 3) of the model that it sees

    @classmethod
    def of(cls, image: pycolmap.Image, model: pycolmap.Reconstruction) -> Self:
        """Return an image that has a pose."""
        points = [model.points3D[p.point3D_id].xyz for p in image.get_observation_points2D()]
        pose = np.asarray(image.cam_from_world().matrix(), np.float64)
        return cls(model.cameras[image.camera_id], pose, np.array(points).reshape(-1, 3))

    def num_visible(self, points: Array) -> int:
        """Return how many of (N, 3) points are in front of the camera and inside its image."""
        seen = points @ self.pose[:, :3].T + self.pose[:, 3]
        seen = seen[seen[:, 2] > 0]
        if not len(seen):
            return 0
        pixels = np.asarray(self.camera.img_from_cam(seen), np.float64)
        size = (self.camera.width, self.camera.height)
        return int(((pixels >= 0) & (pixels <= size)).all(axis=1).sum())


def fundamental_matrix(first: View, second: View) -> Array:
    """Return F of two views with ``x2^T F x1 = 0``, for pixels without distortion."""
    rotation = second.pose[:, :3] @ first.pose[:, :3].T
    translation = second.pose[:, 3] - rotation @ first.pose[:, 3]
    inverse1, inverse2 = (
        np.linalg.inv(view.camera.calibration_matrix()) for view in (first, second)
    )
    return np.asarray(inverse2.T @ essential_matrix(rotation, translation) @ inverse1)


def guide_by_model(context: Context, model: pycolmap.Reconstruction) -> StageReport:
    """Match the pairs of registered images that overlap by a model and are not verified.

    A pair gets a two-view geometry when its guided matches verify. Images overlap when each sees as
    many points of the other as an image needs in tracks (``min_num_tracks``). Pairs that were
    guided before are left alone. ``num_done`` counts the pairs that were matched now.
    """
    start = time.perf_counter()
    context.workspace.require("verify")
    options = recorded_guiding(context.workspace)
    context.workspace.record_options("guide", options.to_mapping())
    guiding = Guiding(context, options)
    views = {
        image.name: View.of(image, model)
        for image in model.images.values()
        if image.has_pose and image.name in guiding.ids
    }
    known = verified_inliers(context).keys() | {pair.names for pair in current(context)}
    deleted = deleted_pairs(context.workspace)
    todo = [
        (first, second)
        for first, second in combinations(sorted(views, key=guiding.ids.__getitem__), 2)
        if (first, second) not in known
        and frozenset((first, second)) not in deleted
        and min(
            views[first].num_visible(views[second].points),
            views[second].num_visible(views[first].points),
        )
        >= max(1, options.min_num_tracks)
    ]

    def task(pair: Pair) -> GuidedTask:
        first, second = (views[name] for name in pair)
        points1, points2 = (
            undistorted(
                views[name].camera,
                colmap_from_pixel(context.features.read_frames(name)[:, :, 2]).astype(np.float64),
            )
            for name in pair
        )
        matrix, nothing = fundamental_matrix(first, second), np.zeros((0, 2), np.int64)
        whole = GuidedTask(pair, matrix, False, (points1, points2), nothing)
        return whole.scaled((guiding.scales[pair[0]], guiding.scales[pair[1]]))

    with context.progress.stage("guide by model", len(todo), "pairs") as advance:
        guiding.guide(todo, advance, lambda batch: [task(pair) for pair in batch])
    return StageReport("guide", time.perf_counter() - start, len(todo))
