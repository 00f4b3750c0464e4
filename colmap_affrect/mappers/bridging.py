"""Bridges: images that hang on a model by one verified pair.

The pair gives rotation and direction of translation, but not the scale, since its features are
not those whose depth the model knows. They lie beside them, though: the ratio of the model's depths
to those of the pair at neighbouring places is the scale (:mod:`colmap_affrect.geometry.two_views`).
What a bridge would do is judged by all other verified pairs of the images that it brings in.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.geometry.two_views import (
    ScaleEstimate,
    scale_between,
    scale_by_planes,
)
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    CameraById,
    PairGraph,
    RelativePose,
    VerifiedPair,
    cameras_of,
    inverse,
    poses_of,
)
from colmap_affrect.project.report import Bridge

RADIUS_FRAC = 0.03
"""Places of known depth are neighbours up to this part of the longer side of the image."""

PLANE_RADIUS = 4.0
"""Known depths on a plane may be so many times farther away."""

MIN_AGREEING = 10
MIN_AGREEING_SHARE = 0.5
"""A scale needs so many places that agree, and this share of all: right pairs have 80 to 100 %, and
chance a quarter."""


FOCAL_STEP = 0.02
"""Relative poses are estimated again when a focal length has changed by about this part."""


@dataclass(frozen=True)
class Part:
    """A model as bridges see it.

    Attributes:
        model: the model.
    """

    model: pycolmap.Reconstruction

    @cached_property
    def poses(self) -> dict[int, Pose]:
        """cam_from_world by image id."""
        return poses_of(self.model)

    @cached_property
    def cameras(self) -> dict[int, pycolmap.Camera]:
        """Camera by id of the image."""
        return cameras_of(self.model)

    def known_depths(self, image_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (K, 2) px and (K,) depths of the points that an image sees."""
        if image_id not in self._known:
            rotation, translation = self.poses[image_id]
            points = self.model.images[image_id].get_observation_points2D()
            places = np.array([p.xy for p in points]).reshape(-1, 2)
            world = np.array([self.model.points3D[p.point3D_id].xyz for p in points])
            depths = world.reshape(-1, 3) @ rotation[2] + translation[2]
            in_front = depths > 0
            self._known[image_id] = places[in_front], depths[in_front]
        return self._known[image_id]

    @cached_property
    def _known(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        return {}


@dataclass(frozen=True)
class Hypothesis:
    """A bridge that could be built.

    Attributes:
        bridge: what would be reported.
        image_id: of the image that comes in.
        pose: of this image, in the frame of the model.
        camera: of this image.
        agreeing: weight of the pairs between the model and this image, as far as they agree.
    """

    bridge: Bridge
    image_id: int
    pose: Pose
    camera: pycolmap.Camera
    agreeing: float

    @property
    def rank(self) -> float:
        """Higher for what more pairs agree with, and for scales that more places agree on."""
        agreement = self.bridge.num_agreeing / self.bridge.num_ratios
        return self.agreeing * agreement


class Bridges:
    """Finds bridges between models and images of one database."""

    def __init__(self, graph: PairGraph, random_seed: int) -> None:
        """Begin without any pose known."""
        self.graph, self.random_seed = graph, random_seed
        self._relative: dict[tuple[Any, ...], list[RelativePose]] = {}

    def find(self, part: Part) -> list[Hypothesis]:
        """Return all bridges from a model to other images, best first."""
        found = filter(None, self._to_images(part))
        return sorted(found, key=lambda hypothesis: -hypothesis.rank)

    def _to_images(self, part: Part) -> Iterator[Hypothesis | None]:
        for pair in self.graph.pairs:
            inside = [image_id in part.poses for image_id in pair.ids]
            if sum(inside) != 1:
                continue
            side = inside.index(True)
            near, far = pair.ids[side], pair.ids[1 - side]
            cameras = {near: part.cameras[near], far: self._camera(part, far)}
            for relative in self._poses(pair, cameras):
                scale = self._scale(part, near, side, relative)
                if scale is None:
                    continue
                pose = relative.pose if side == 0 else inverse(relative.pose)
                rotation, translation = part.poses[near]
                moved = pose[0] @ rotation, pose[0] @ translation + scale.scale * pose[1]
                yield self._judged(part, (near, far), moved, cameras[far], scale)

    def _scale(
        self, part: Part, image_id: int, side: int, relative: RelativePose
    ) -> ScaleEstimate | None:
        """Compare the depths of a pair in an image with those that a model knows there."""
        radius = RADIUS_FRAC * _longer_side(part.cameras[image_id])
        depths = relative.depths.first if side == 0 else relative.depths.second
        in_front = relative.depths.in_front
        places = self.graph.keypoints[image_id][relative.matches[in_front, side]]
        known = part.known_depths(image_id)
        positive = depths[in_front]
        return _trusted(scale_between(known, (places, positive), radius)) or _trusted(
            scale_by_planes(known, (places, positive), PLANE_RADIUS * radius)
        )

    def _judged(
        self,
        part: Part,
        ids: tuple[int, int],
        pose: Pose,
        camera: pycolmap.Camera,
        scale: ScaleEstimate,
    ) -> Hypothesis | None:
        """Ask all pairs between the model and an image; None where they disagree."""
        near, far = ids
        poses, cameras = {**part.poses, far: pose}, {**part.cameras, far: camera}
        weight = agreeing = 0.0
        for pair in self.graph.pairs_inside(poses):
            if far in pair.ids:
                weight += pair.weight
                agreeing += pair.weight * self.graph.agreement(pair, poses, cameras)
        if agreeing < MIN_SHARE * weight:
            return None
        numbers = scale.num_agreeing, scale.num_ratios, scale.error_frac
        return Hypothesis(Bridge(self.graph.names[near], *numbers), far, pose, camera, agreeing)

    def _poses(self, pair: VerifiedPair, cameras: CameraById) -> list[RelativePose]:
        focals = [cameras[image_id].mean_focal_length() for image_id in pair.ids]
        key = (pair.ids, *np.round(np.log(focals) / FOCAL_STEP).astype(int))
        if key not in self._relative:
            self._relative[key] = self.graph.relative_poses(pair, cameras, self.random_seed)
        return self._relative[key]

    def _camera(self, part: Part, image_id: int) -> pycolmap.Camera:
        """Return the camera that an image would have in a model."""
        usual = self.graph.cameras[image_id]
        alike = (known for known in part.cameras.values() if known.camera_id == usual.camera_id)
        return next(alike, usual)


def _longer_side(camera: pycolmap.Camera) -> int:
    return max(camera.width, camera.height)


def _trusted(estimate: ScaleEstimate | None) -> ScaleEstimate | None:
    """Return an estimate on which enough places agree."""
    if estimate is None or estimate.num_agreeing < MIN_AGREEING:
        return None
    return estimate if estimate.share >= MIN_AGREEING_SHARE else None
