"""Bridges: images that are registered by the relative pose of one verified pair.

The pair gives rotation and direction of translation, but not the scale, since its features are
not those whose depth the model knows. They lie beside them, though: the ratio of the depths of the
model to those of the pair, at neighbouring positions, is the scale
(:mod:`colmap_affrect.geometry.two_views`).
Bridges are ranked by all verified pairs of an image with the model.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.two_views import (
    NUM_INDEPENDENT,
    ScaleEstimate,
    scale_between,
    scale_by_planes,
)
from colmap_affrect.mappers.adjustment import Adjuster
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    CameraById,
    PairGraph,
    RelativePose,
    VerifiedPair,
    cameras_of,
    poses_of,
    used_cameras,
)
from colmap_affrect.project.report import Bridge

# Judged on bridges of the benchmark scenes whose poses are known.
# Of the longer side of an image: known depths so near are compared
DEPTH_RADIUS = 0.03
# Known depths on a common plane may be so many times farther away; judged
PLANE_RADIUS_FACTOR = 4.0
MIN_AGREEING_SHARE = 0.5  # of all ratios: right pairs have 0.8, chance 0.25; measured
# Of the logarithm: relative poses are estimated once for such a step; resource
FOCAL_STEP = 0.02


class _PosedModel:
    """The poses, cameras and depths of a model."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model = model
        self.poses = poses_of(model)
        self.cameras = cameras_of(model)
        self.known_depths = cache(self._known_depths)

    def _known_depths(self, image_id: int) -> tuple[Array, Array]:
        """Return (K, 2) px and (K,) depths of the points that an image sees."""
        rotation, translation = self.poses[image_id]
        keypoints = self.model.images[image_id].get_observation_points2D()
        positions = np.array([p.xy for p in keypoints]).reshape(-1, 2)
        points = np.array([self.model.points3D[p.point3D_id].xyz for p in keypoints])
        depths = points.reshape(-1, 3) @ rotation[2] + translation[2]
        is_in_front = depths > 0
        return positions[is_in_front], depths[is_in_front]


@dataclass(frozen=True)
class _OpenPair:
    """A verified pair with one image in a model, and one that is not in it."""

    pair: VerifiedPair
    side: int  # index of the image in the model, 0 or 1
    camera: pycolmap.Camera  # of the other image

    @property
    def inside(self) -> int:
        """The id of the image in the model."""
        return self.pair.ids[self.side]

    @property
    def outside(self) -> int:
        """The id of the image that is not in the model."""
        return self.pair.ids[1 - self.side]


@dataclass(frozen=True)
class BridgeHypothesis:
    """A bridge that could be built."""

    bridge: Bridge  # what would be reported
    image_id: int  # of the image that would be registered
    pose: Pose  # cam_from_world of this image
    camera: pycolmap.Camera  # of this image
    rank: float  # weight of the pairs that agree, times the share of depths that agree


class BridgeFinder:
    """Finds bridges between models and images of one database."""

    def __init__(self, graph: PairGraph, adjuster: Adjuster, random_seed: int) -> None:
        """Begin without any pose known.

        Args:
            graph: Pairs that bridges are built by.
            adjuster: Has the priors of cameras that a model has not used yet.
            random_seed: For the relative poses.
        """
        self.graph = graph
        self.adjuster = adjuster
        self.random_seed = random_seed
        self._relative_poses: dict[tuple[Any, ...], list[RelativePose]] = {}

    def find(self, model: pycolmap.Reconstruction) -> list[BridgeHypothesis]:
        """Return all bridges from a model to other images, best first."""
        posed = _PosedModel(model)
        found = list[BridgeHypothesis]()
        for open_pair in self._open_pairs(posed):
            found += self._hypotheses(posed, open_pair)
        return sorted(found, key=lambda hypothesis: -hypothesis.rank)

    def _open_pairs(self, posed: _PosedModel) -> Iterator[_OpenPair]:
        used = used_cameras(posed.model)
        for pair in self.graph.pairs:
            is_inside = [image_id in posed.poses for image_id in pair.ids]
            if sum(is_inside) == 1:
                side = is_inside.index(True)
                of_database = self.graph.cameras[pair.ids[1 - side]]
                camera = used.get(of_database.camera_id)
                if camera is None:
                    camera = self.adjuster.initial_camera(of_database)
                yield _OpenPair(pair=pair, side=side, camera=camera)

    def _hypotheses(
        self, posed: _PosedModel, open_pair: _OpenPair
    ) -> Iterator[BridgeHypothesis]:
        """Yield the bridges that the relative poses of a pair allow."""
        inside = open_pair.inside
        outside = open_pair.outside
        camera = open_pair.camera
        cameras = {inside: posed.cameras[inside], outside: camera}
        for relative in self._poses_of_pair(open_pair.pair, cameras):
            scale = self._scale(posed, open_pair, relative)
            if scale is None:
                continue
            pose = _chained(
                known=posed.poses[inside],
                relative=relative.pose,
                side=open_pair.side,
                scale=scale.scale,
            )
            agreeing = self._agreeing_weight(posed, outside, pose, camera)
            if agreeing is not None:
                bridge = Bridge(
                    by=self.graph.names[inside],
                    num_agreeing=scale.num_agreeing,
                    num_ratios=scale.num_ratios,
                    scale_error_frac=scale.error_frac,
                )
                yield BridgeHypothesis(
                    bridge=bridge,
                    image_id=outside,
                    pose=pose,
                    camera=camera,
                    rank=agreeing * scale.share,
                )

    def _scale(
        self, posed: _PosedModel, open_pair: _OpenPair, relative: RelativePose
    ) -> ScaleEstimate | None:
        """Compare the depths of a pair in the image of the model with those of the model."""
        image_id = open_pair.inside
        side = open_pair.side
        camera = posed.cameras[image_id]
        known = posed.known_depths(image_id)
        keypoints = self.graph.keypoints[image_id]
        positions = keypoints[relative.matches[:, side]].astype(np.float64)
        of_pair = positions, relative.depths[side]
        radius_px = DEPTH_RADIUS * max(camera.width, camera.height)
        scale = scale_between(known, of_pair, radius_px)
        if not _is_certain(scale):
            scale = scale_by_planes(known, of_pair, PLANE_RADIUS_FACTOR * radius_px)
        return scale if _is_certain(scale) else None

    def _agreeing_weight(
        self, posed: _PosedModel, image_id: int, pose: Pose, camera: pycolmap.Camera
    ) -> float | None:
        """Return the weight of the pairs that agree with an image's pose, None if most do not."""
        poses = {**posed.poses, image_id: pose}
        cameras = {**posed.cameras, image_id: camera}
        total = agreeing = 0.0
        for pair in self.graph.pairs_inside(poses):
            if image_id in pair.ids:
                weight = float(np.sqrt(len(pair.matches)))
                total += weight
                agreeing += weight * self.graph.agreement(pair, poses, cameras)
        return agreeing if agreeing >= MIN_SHARE * total else None

    def _poses_of_pair(
        self, pair: VerifiedPair, cameras: CameraById
    ) -> list[RelativePose]:
        """Return the relative poses of a pair; for nearly the same focal lengths the same ones."""
        focals = [cameras[image_id].mean_focal_length() for image_id in pair.ids]
        steps = np.round(np.log(focals) / FOCAL_STEP).astype(int)
        key = (pair.ids, *steps)
        if key not in self._relative_poses:
            self._relative_poses[key] = self.graph.relative_poses(
                pair, cameras, self.random_seed
            )
        return self._relative_poses[key]


def _is_certain(scale: ScaleEstimate | None) -> bool:
    if scale is None:
        return False
    return scale.num_agreeing >= NUM_INDEPENDENT and scale.share >= MIN_AGREEING_SHARE


def _chained(known: Pose, relative: Pose, side: int, scale: float) -> Pose:
    """Return cam_from_world of the other image of a pair.

    Args:
        known: cam_from_world of one image.
        relative: cam2_from_cam1 of the pair.
        side: Which image the known one is, 0 for the first and 1 for the second.
        scale: Length of the relative translation in units of the model.
    """
    other_from_known = relative if side == 0 else _inverse(relative)
    rotation, translation = other_from_known
    known_rotation, known_translation = known
    return rotation @ known_rotation, rotation @ known_translation + scale * translation


def _inverse(pose: Pose) -> Pose:
    """Return the inverse of a pose."""
    rotation, translation = pose
    return rotation.T, -rotation.T @ translation
