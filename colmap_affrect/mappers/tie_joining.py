"""Joining by tie points: photographs to a model, and models to each other, whatever matches say."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import SIGMA_PX
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.mappers.adjustment import EXIF_SIGMA
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import Bridges
from colmap_affrect.mappers.evidence import Evidence
from colmap_affrect.mappers.growing import Grower, join
from colmap_affrect.mappers.pair_graph import CameraById, PoseById, cameras_of, poses_of
from colmap_affrect.mappers.search import ZOOMS
from colmap_affrect.mappers.tie_points import AGREEING_PX, MIN_NUM_POINTS, TiePoints

BY_HAND = "with tie points"  # the move, in a report
MAX_SIM3_ERROR = 0.1  # of tie points of two models, of their spread


class TieJoiner:
    """Joins photographs and models that tie points hold, whatever the matches say."""

    def __init__(self, points: TiePoints, grower: Grower, evidence: Evidence) -> None:
        self.points, self.grower, self.evidence = points, grower, evidence

    def join(self, models: Sequence[MappedModel]) -> list[MappedModel]:
        """Return models with all that joins them, and all tie points observed; large ones first.

        Bridges go on from there. Images that their tie points contradict are placed anew.
        """
        if not self.points.keypoints:
            return list(models)
        left = sorted(models, key=lambda mapped: -mapped.reconstruction.num_reg_images())
        joined = list[MappedModel]()
        while left:
            mapped, *left = left
            for image_id in self.points.misplaced(mapped.reconstruction):
                frame_id = mapped.reconstruction.images[image_id].frame_id
                mapped.reconstruction.deregister_frame(frame_id)
            while new := next(self._new_poses(mapped.reconstruction, left), None):
                mapped = self._with(mapped, *new)
                inside = set(mapped.reconstruction.reg_image_ids())
                left = [m for m in left if not inside >= set(m.reconstruction.reg_image_ids())]
            if BY_HAND in mapped.moves:
                self.grower.finish(mapped.reconstruction)
            self.points.observe(mapped.reconstruction)
            joined.append(mapped)
        return joined

    def _with(self, mapped: MappedModel, poses: PoseById, cameras: CameraById) -> MappedModel:
        """Place images, and what bridges join to them."""
        model = self.grower.placed(poses, cameras, copy.deepcopy(mapped.reconstruction))
        bridges = Bridges(self.grower.graph, self.grower.native.random_seed)
        moves = tuple(dict.fromkeys((*mapped.moves, BY_HAND)))
        placed = replace(mapped, reconstruction=model, moves=moves)
        return join(placed, bridges, self.grower, self.evidence)

    def _new_poses(
        self, model: pycolmap.Reconstruction, left: Sequence[MappedModel]
    ) -> Iterator[tuple[PoseById, CameraById]]:
        places = self.points.places(model)
        others = [mapped.reconstruction for mapped in left]
        for other in others:
            moved = self._moved(other, places)
            if moved is not None:
                yield poses_of(moved), cameras_of(moved)
        elsewhere = {i for m in (model, *others) for i in m.reg_image_ids()}
        for image in self.grower.graph.cache.images.values():
            if image.image_id not in elsewhere:
                found = self._registered(image, model, places)
                if found:
                    yield {image.image_id: found[0]}, {image.image_id: found[1]}

    def _moved(
        self, other: pycolmap.Reconstruction, places: Mapping[str, Array]
    ) -> pycolmap.Reconstruction | None:
        """Return a copy of a model, moved to where its tie points are in another one."""
        own = self.points.places(other)
        if len(names := sorted(own.keys() & places.keys())) < MIN_NUM_POINTS:
            return None
        source, target = (np.array([at[name] for name in names]) for at in (own, places))
        spread = float(np.linalg.norm(np.std(target, axis=0)))
        options = self._ransac(MAX_SIM3_ERROR * spread)
        found: Any = pycolmap.estimate_sim3d_robust(source, target, options)
        if not found or found["num_inliers"] < MIN_NUM_POINTS:
            return None
        moved = pycolmap.Reconstruction(other)
        moved.transform(found["tgt_from_src"])
        return moved

    def _registered(
        self, image: pycolmap.Image, model: pycolmap.Reconstruction, places: Mapping[str, Array]
    ) -> tuple[Pose, pycolmap.Camera] | None:
        """Return pose and camera of an image by its tie points; a focal length may be unknown."""
        marks = self.points.marks(image)
        if len(names := sorted(marks.keys() & places.keys())) < MIN_NUM_POINTS:
            return None
        points, known = (np.array([at[name] for name in names]) for at in (marks, places))
        key = image.camera_id
        is_used = key in {camera.camera_id for camera in cameras_of(model).values()}
        camera = copy.copy((model if is_used else self.grower.graph.cache).cameras[key])
        prior = self.grower.adjuster.priors[key]
        is_open = not is_used and prior.sigma > EXIF_SIGMA
        estimation = pycolmap.AbsolutePoseEstimationOptions(ransac=self._ransac(AGREEING_PX))
        refinement = pycolmap.AbsolutePoseRefinementOptions(
            refine_focal_length=is_open, loss_function_scale=SIGMA_PX
        )
        best, most = None, (MIN_NUM_POINTS - 1, 0.0)
        for zoom in ZOOMS if is_open else (1.0,):
            trial = copy.copy(camera)
            for index in trial.focal_length_idxs() if is_open else ():
                trial.params[index] = zoom * prior.focal_px
            found = pycolmap.estimate_and_refine_absolute_pose(
                points, known, trial, estimation, refinement
            )
            if found:
                rank = found["num_inliers"], -prior.cost(trial.mean_focal_length())
                matrix = found["cam_from_world"].matrix()
                if rank > most:
                    best, most = ((matrix[:, :3], matrix[:, 3]), trial), rank
        return best

    def _ransac(self, max_error: float) -> pycolmap.RANSACOptions:
        seed = max(self.grower.native.random_seed, 0)
        return pycolmap.RANSACOptions(max_error=max_error, random_seed=seed)
