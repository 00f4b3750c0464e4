"""Joining by tie points: photographs to a model, and models to each other, whatever matches say."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import SIGMA_PX
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.colmap.two_views import Cameras
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import BridgeFinder
from colmap_affrect.mappers.growing import Grower, register_bridges
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import CameraById, PoseById, cameras_of, poses_of
from colmap_affrect.mappers.tie_points import AGREEING_PX, MIN_NUM_POINTS, TiePoints

BY_HAND = "with tie points"  # what made the model, in the words of a report
MIN_NUM_OF_FIRST = 7
"""Tie points of two images that begin a model: two more than determine an essential matrix
(theory)."""
MAX_SIM3_ERROR = 0.1  # of tie points of two models, in units of their spread (judged)


@dataclass(frozen=True)
class _NewImages:
    """Images that tie points register into a model."""

    poses: PoseById
    cameras: CameraById


@dataclass(frozen=True)
class _Resection:
    """A pose of an image by its tie points."""

    pose: Pose  # cam_from_world
    camera: pycolmap.Camera  # with the focal length that was found
    num_inliers: int
    focal_cost: float  # by the prior of the focal length

    @property
    def rank(self) -> tuple[int, float]:
        """Larger is better."""
        return self.num_inliers, -self.focal_cost


class TieJoiner:
    """Joins photographs and models that have tie points in common, whatever the matches say."""

    def __init__(self, points: TiePoints, grower: Grower, scorer: ModelScorer) -> None:
        """Take the tie points of the graph that a grower works with."""
        self.points = points
        self.grower = grower
        self.scorer = scorer

    def join(self, models: Sequence[MappedModel]) -> list[MappedModel]:
        """Return models with all that joins them, and all tie points observed; large ones first.

        Bridges go on from there. Images that their tie points contradict are taken out, of the
        given models, too, and registered again where these allow it.
        """
        if not self.points.keypoints:
            return list(models)
        left = sorted(
            models, key=lambda mapped: -mapped.reconstruction.num_reg_images()
        )
        joined = list[MappedModel]()
        if not left:
            left = self._begun()
        while left:
            mapped = left.pop(0)
            for image_id in self.points.misplaced(mapped.reconstruction):
                frame_id = mapped.reconstruction.images[image_id].frame_id
                mapped.reconstruction.deregister_frame(frame_id)
            new = self._next_images(mapped, left)
            while new:
                mapped = self._with(mapped, new)
                left = _not_inside(left, mapped)
                new = self._next_images(mapped, left)
            if BY_HAND in mapped.hypotheses:
                self.grower.adjust_fully(mapped.reconstruction)
            self.points.observe(mapped.reconstruction)
            joined.append(mapped)
        return joined

    def _begun(self) -> list[MappedModel]:
        """Return the model of the two images with most tie points in common that tell a pose."""
        graph = self.grower.graph
        marks_of = {}
        for image in graph.cache.images.values():
            marks_of[image.image_id] = self.points.marks(image)
        together = dict[tuple[int, int], list[str]]()
        for first, second in combinations(sorted(marks_of), 2):
            names = sorted(marks_of[first].keys() & marks_of[second].keys())
            if len(names) >= MIN_NUM_OF_FIRST:
                together[first, second] = names
        for ids in sorted(together, key=lambda ids: (-len(together[ids]), ids)):
            cameras = {i: copy.copy(graph.cameras[i]) for i in ids}
            for image_id, camera in list(cameras.items()):
                prior = self.grower.adjuster.priors[camera.camera_id]
                if not prior.has_prior_focal_length:
                    cameras[image_id] = _with_focal(camera, prior.starts_px[0])
            points = []
            for image_id in ids:
                found = [marks_of[image_id][name] for name in together[ids]]
                points.append(np.array(found, np.float64))
            both = cameras[ids[0]], cameras[ids[1]]
            relative = self._relative_pose(points[0], points[1], both)
            if relative is not None:
                poses = {ids[0]: (np.eye(3), np.zeros(3)), ids[1]: relative}
                model = self.grower.register_at(
                    poses, cameras, pycolmap.Reconstruction()
                )
                return [MappedModel(model, hypotheses=(BY_HAND,))]
        return []

    def _relative_pose(
        self, points1: Array, points2: Array, cameras: Cameras
    ) -> Pose | None:
        """Return cam2_from_cam1 of the marks of two images.

        Args:
            points1: (N, 2) px in the first image.
            points2: (N, 2) px in the second one.
            cameras: Of both.

        Returns:
            The pose, with a translation of length 1; None where too few
            marks agree with one.
        """
        options = self._ransac(AGREEING_PX)
        found: Any = pycolmap.estimate_essential_matrix(
            points1, points2, *cameras, options
        )
        if not found or found["num_inliers"] < MIN_NUM_OF_FIRST:
            return None
        matrix = found["cam2_from_cam1"].matrix()
        return matrix[:, :3], matrix[:, 3]

    def _with(self, mapped: MappedModel, new: _NewImages) -> MappedModel:
        """Register images, and what bridges register from there."""
        model = copy.deepcopy(mapped.reconstruction)
        model = self.grower.register_at(new.poses, new.cameras, model)
        hypotheses = (
            mapped.hypotheses
            if BY_HAND in mapped.hypotheses
            else (*mapped.hypotheses, BY_HAND)
        )
        registered = replace(mapped, reconstruction=model, hypotheses=hypotheses)
        grower = self.grower
        seed = grower.native.random_seed
        bridges = BridgeFinder(grower.graph, grower.adjuster, seed)
        return register_bridges(registered, bridges, self.grower, self.scorer)

    def _next_images(
        self, mapped: MappedModel, left: Sequence[MappedModel]
    ) -> _NewImages | None:
        """Return the next images that tie points register, those of whole models first."""
        model = mapped.reconstruction
        others = [other.reconstruction for other in left]
        return next(self._new_images(model, others), None)

    def _new_images(
        self, model: pycolmap.Reconstruction, others: Sequence[pycolmap.Reconstruction]
    ) -> Iterator[_NewImages]:
        positions = self.points.positions(model)
        registered = set(model.reg_image_ids())
        for other in others:
            registered.update(other.reg_image_ids())
            aligned = self._aligned(other, positions)
            if aligned is not None:
                yield _NewImages(poses_of(aligned), cameras_of(aligned))
        for image in self.grower.graph.cache.images.values():
            if image.image_id not in registered:
                found = self._resected(image, model, positions)
                if found:
                    yield _NewImages(
                        {image.image_id: found.pose}, {image.image_id: found.camera}
                    )

    def _aligned(
        self, other: pycolmap.Reconstruction, positions: Mapping[str, Array]
    ) -> pycolmap.Reconstruction | None:
        """Return a copy of a model, moved to where its tie points are in another one.

        Args:
            other: The model to move.
            positions: Positions of tie points in the model to move it to, by name.

        Returns:
            The copy; None if too few tie points agree on a similarity.
        """
        own = self.points.positions(other)
        names = sorted(own.keys() & positions.keys())
        if len(names) < MIN_NUM_POINTS:
            return None
        source = np.array([own[name] for name in names])
        target = np.array([positions[name] for name in names])
        return moved_onto(
            other,
            source=source,
            target=target,
            min_num_inliers=MIN_NUM_POINTS,
            random_seed=self.grower.native.random_seed,
        )

    def _resected(
        self,
        image: pycolmap.Image,
        model: pycolmap.Reconstruction,
        positions: Mapping[str, Array],
    ) -> _Resection | None:
        """Return the best pose of an image by its tie points.

        Args:
            image: An image that is not in the model.
            model: The model.
            positions: Positions of its tie points, by name.

        Returns:
            Pose and camera, with a focal length that may have been unknown; None if too few tie
            points agree.
        """
        marks = self.points.marks(image)
        names = sorted(marks.keys() & positions.keys())
        if len(names) < MIN_NUM_POINTS:
            return None
        points2d = np.array([marks[name] for name in names])
        points3d = np.array([positions[name] for name in names])
        trials, is_open = self._trial_cameras(image, model)
        best: _Resection | None = None
        for trial in trials:
            found = self._resection(points2d, points3d, trial, refine_focal=is_open)
            if found and (best is None or found.rank > best.rank):
                best = found
        return best

    def _trial_cameras(
        self, image: pycolmap.Image, model: pycolmap.Reconstruction
    ) -> tuple[list[pycolmap.Camera], bool]:
        """Return the cameras that an image may have, and whether the focal length is open."""
        key = image.camera_id
        used = {camera.camera_id for camera in cameras_of(model).values()}
        if key in used:
            return [copy.copy(model.cameras[key])], False
        camera = self.grower.graph.cache.cameras[key]
        prior = self.grower.adjuster.priors[key]
        if prior.has_prior_focal_length:
            return [copy.copy(camera)], False
        trials = [_with_focal(camera, focal_px) for focal_px in prior.starts_px]
        return trials, True

    def _resection(
        self,
        points2d: Array,
        points3d: Array,
        camera: pycolmap.Camera,
        *,
        refine_focal: bool,
    ) -> _Resection | None:
        """Estimate a pose.

        Args:
            points2d: (N, 2) px.
            points3d: (N, 3) positions.
            camera: Changed in place if its focal length is refined.
            refine_focal: Whether that is to be done.

        Returns:
            Pose and camera; None if too few points agree.
        """
        estimation = pycolmap.AbsolutePoseEstimationOptions(
            ransac=self._ransac(AGREEING_PX)
        )
        refinement = pycolmap.AbsolutePoseRefinementOptions(
            refine_focal_length=refine_focal, loss_function_scale=SIGMA_PX
        )
        found = pycolmap.estimate_and_refine_absolute_pose(
            points2d, points3d, camera, estimation, refinement
        )
        if not found or found["num_inliers"] < MIN_NUM_POINTS:
            return None
        matrix = found["cam_from_world"].matrix()
        prior = self.grower.adjuster.priors[camera.camera_id]
        focal_cost = prior.cost(camera.mean_focal_length())
        pose = matrix[:, :3], matrix[:, 3]
        return _Resection(pose, camera, found["num_inliers"], focal_cost)

    def _ransac(self, max_error: float) -> pycolmap.RANSACOptions:
        return _ransac_options(max_error, self.grower.native.random_seed)


def moved_onto(
    model: pycolmap.Reconstruction,
    source: Array,
    target: Array,
    min_num_inliers: float,
    random_seed: int,
) -> pycolmap.Reconstruction | None:
    """Return a copy of a model, moved by a similarity that points of it and others tell.

    Args:
        model: It stays as it is.
        source: (N, 3) positions in the model.
        target: (N, 3) positions of the same points where it is moved to.
        min_num_inliers: Points that must agree.
        random_seed: Of RANSAC.

    Returns:
        The copy; None where too few points agree on a similarity.
    """
    spread = float(np.linalg.norm(np.std(target, axis=0)))
    options = _ransac_options(MAX_SIM3_ERROR * spread, random_seed)
    found: Any = pycolmap.estimate_sim3d_robust(source, target, options)
    if not found or found["num_inliers"] < min_num_inliers:
        return None
    moved = pycolmap.Reconstruction(model)
    moved.transform(found["tgt_from_src"])
    return moved


def _ransac_options(max_error: float, random_seed: int) -> pycolmap.RANSACOptions:
    return pycolmap.RANSACOptions(max_error=max_error, random_seed=max(random_seed, 0))


def _with_focal(camera: pycolmap.Camera, focal_px: float) -> pycolmap.Camera:
    """Return a copy of a camera with another focal length."""
    changed = copy.copy(camera)
    for index in changed.focal_length_idxs():
        changed.params[index] = focal_px
    return changed


def _not_inside(models: Sequence[MappedModel], whole: MappedModel) -> list[MappedModel]:
    """Leave out models all of whose images another one has."""
    inside = set(whole.reconstruction.reg_image_ids())
    found = list[MappedModel]()
    for mapped in models:
        if not inside.issuperset(mapped.reconstruction.reg_image_ids()):
            found.append(mapped)
    return found
