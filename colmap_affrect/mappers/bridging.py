"""Bridges: images that hang on a model by one verified pair.

The pair gives rotation and direction of translation, but not the scale, since its features are
not those whose depth the model knows. They lie beside them, though: the ratio of the model's depths
to those of the pair at neighbouring places is the scale (:mod:`colmap_affrect.geometry.two_views`).
What a bridge would do is judged by all other verified pairs of the images that it brings in.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.two_views import ScaleEstimate, scale_between, scale_by_planes
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    CameraById,
    PairGraph,
    RelativePose,
    VerifiedPair,
    cameras_of,
    poses_of,
)
from colmap_affrect.project.report import Bridge

RADIUS_FRAC = 0.03  # of the longer side of an image: places of known depth so near are neighbours
PLANE_RADIUS = 4.0  # known depths on a plane may be so many times farther away
MIN_AGREEING, MIN_AGREEING_SHARE = 10, 0.5
"""A scale needs so many places that agree, and this share: right pairs have 80 %, chance 25 %."""
FOCAL_STEP = 0.02  # change of a focal length from which on relative poses are estimated again


class _Part:
    """A model as bridges see it."""

    def __init__(self, model: pycolmap.Reconstruction) -> None:
        self.model, self.poses, self.cameras = model, poses_of(model), cameras_of(model)
        self.known_depths = cache(self._known_depths)

    def _known_depths(self, image_id: int) -> tuple[Array, Array]:
        """Return (K, 2) px and (K,) depths of the points that an image sees."""
        rotation, translation = self.poses[image_id]
        points = self.model.images[image_id].get_observation_points2D()
        places = np.array([p.xy for p in points]).reshape(-1, 2)
        world = np.array([self.model.points3D[p.point3D_id].xyz for p in points])
        depths = world.reshape(-1, 3) @ rotation[2] + translation[2]
        return places[depths > 0], depths[depths > 0]


@dataclass(frozen=True)
class Hypothesis:
    """A bridge that could be built."""

    bridge: Bridge  # what would be reported
    image_id: int  # of the image that comes in
    pose: Pose  # of this image, in the frame of the model
    camera: pycolmap.Camera  # of this image
    rank: float  # higher for what more pairs agree with, and for scales that more places agree on


class Bridges:
    """Finds bridges between models and images of one database."""

    def __init__(self, graph: PairGraph, random_seed: int) -> None:
        """Begin without any pose known."""
        self.graph, self.random_seed = graph, random_seed
        self._relative: dict[tuple[Any, ...], list[RelativePose]] = {}

    def find(self, model: pycolmap.Reconstruction) -> list[Hypothesis]:
        """Return all bridges from a model to other images, best first."""
        return sorted(self._to_images(_Part(model)), key=lambda hypothesis: -hypothesis.rank)

    def _to_images(self, part: _Part) -> Iterator[Hypothesis]:
        camera_of = {camera.camera_id: camera for camera in part.cameras.values()}
        for pair in self.graph.pairs:
            inside = [image_id in part.poses for image_id in pair.ids]
            if sum(inside) != 1:
                continue
            side = inside.index(True)
            near, far = pair.ids[side], pair.ids[1 - side]
            usual = self.graph.cameras[far]
            camera = camera_of.get(usual.camera_id, usual)
            for relative in self._poses(pair, {near: part.cameras[near], far: camera}):
                scale = self._scale(part, near, side, relative)
                if scale is None:
                    continue
                turn, shift = relative.pose  # cam2_from_cam1
                if side == 1:
                    turn, shift = turn.T, -turn.T @ shift
                rotation, translation = part.poses[near]
                pose = turn @ rotation, turn @ translation + scale.scale * shift
                agreeing = self._agreeing(part, far, pose, camera)
                if agreeing is not None:
                    numbers = scale.num_agreeing, scale.num_ratios, scale.error_frac
                    bridge = Bridge(self.graph.names[near], *numbers)
                    yield Hypothesis(bridge, far, pose, camera, agreeing * scale.share)

    def _scale(
        self, part: _Part, image_id: int, side: int, relative: RelativePose
    ) -> ScaleEstimate | None:
        """Compare the depths of a pair in an image with those that a model knows there."""
        camera, known = part.cameras[image_id], part.known_depths(image_id)
        radius = RADIUS_FRAC * max(camera.width, camera.height)
        places = self.graph.keypoints[image_id][relative.matches[:, side]].astype(np.float64)
        own = places, relative.depths[side]
        for estimate, distance in (scale_between, radius), (scale_by_planes, PLANE_RADIUS * radius):
            scale = estimate(known, own, distance)
            if scale and scale.num_agreeing >= MIN_AGREEING and scale.share >= MIN_AGREEING_SHARE:
                return scale
        return None

    def _agreeing(
        self, part: _Part, image_id: int, pose: Pose, camera: pycolmap.Camera
    ) -> float | None:
        """Return the weight of agreeing pairs of model and image; None where most disagree."""
        poses, cameras = {**part.poses, image_id: pose}, {**part.cameras, image_id: camera}
        weight = agreeing = 0.0
        for pair in self.graph.pairs_inside(poses):
            if image_id in pair.ids:
                own = float(np.sqrt(len(pair.matches)))
                weight += own
                agreeing += own * self.graph.agreement(pair, poses, cameras)
        return agreeing if agreeing >= MIN_SHARE * weight else None

    def _poses(self, pair: VerifiedPair, cameras: CameraById) -> list[RelativePose]:
        focals = [cameras[image_id].mean_focal_length() for image_id in pair.ids]
        key = (pair.ids, *np.round(np.log(focals) / FOCAL_STEP).astype(int))
        if key not in self._relative:
            self._relative[key] = self.graph.relative_poses(pair, cameras, self.random_seed)
        return self._relative[key]
