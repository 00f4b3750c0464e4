"""Models that grow from a first pair, as in COLMAP's incremental mapper, and by bridges.

All adjustments have priors on intrinsics (:mod:`colmap_affrect.mappers.adjustment`).
"""

import copy
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FAST, FINAL, MEDIUM, Adjuster
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import BridgeFinder
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import (
    CameraById,
    PairGraph,
    PoseById,
    cameras_of,
    poses_of,
)

MIN_POINTS = 10  # of a first pair (judged)
MIN_FEW_POINTS = 6
"""Points that register an image whose pairs have few matches, or of such a first pair: three more
than determine a pose, each of which chance explains once in a thousand times (theory)."""
MIN_INIT_SHARE = 0.8
"""Inliers of a first pair, as a share of those of the strongest pair, where none has as many as are
asked for (resource: verification and scores decide)."""
# Images up to which each new one is followed by a global adjustment; resource
NUM_ALWAYS_ADJUSTED = 10
# Of the number of images from one global adjustment to the next; COLMAP has 1.1; resource
GROWTH = 1.15
NUM_LAST_ROUNDS = 2  # of triangulation and adjustment at the end (resource)
# Bridges that are built from one model before it is called complete (resource)
MAX_BRIDGES_IN_VAIN = 5


class Grower:
    """Grows models from first pairs, as COLMAP's incremental mapper does."""

    def __init__(
        self,
        graph: PairGraph,
        adjuster: Adjuster,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> None:
        """Prepare for the pairs of one graph.

        Args:
            graph: Verified pairs.
            adjuster: Makes all adjustments.
            native: Options of registration, triangulation and filters.
            show: Is told how many images a model has.
        """
        self.graph = graph
        self.adjuster = adjuster
        self.native = native
        self.show = show
        self.options = native.get_mapper()
        self.options_for_few_matches = native.get_mapper()
        self.options_for_few_matches.abs_pose_min_num_inliers = min(
            MIN_FEW_POINTS, self.options.abs_pose_min_num_inliers
        )
        self.triangulation = native.get_triangulation()
        self._is_stopped = False

    def stop(self) -> None:
        """Have models that grow in other threads end with their next image, unfinished."""
        self._is_stopped = True

    @contextmanager
    def _mapping(
        self, model: pycolmap.Reconstruction
    ) -> Iterator[pycolmap.IncrementalMapper]:
        mapper = pycolmap.IncrementalMapper(self.graph.cache)
        mapper.begin_reconstruction(model)
        yield mapper
        mapper.end_reconstruction(False)

    def grow(self, pair: tuple[int, int]) -> pycolmap.Reconstruction | None:
        """Return the model that begins with a pair of image ids, None if it makes none."""
        model = pycolmap.Reconstruction()
        with self._mapping(model) as mapper:
            self.adjuster.set_initial_focals(model)
            options = self._options_of_first()
            pose = mapper.estimate_initial_two_view_geometry(options, *pair)
            pose = pose or self._pose_by_few_matches(model, pair)
            if pose is None:
                return None
            mapper.register_initial_image_pair(options, *pair, pose)
            self._triangulate(mapper, pair)
            self._adjust(mapper, FAST)
            self.show(len(pair))
            if model.num_points3D() < self._min_num_points(pair):
                return None
            self._complete(mapper)
        return model

    def _min_num_points(self, pair: tuple[int, int]) -> int:
        """Return how many points a first pair must make."""
        with_few = self.graph.images_with_few_matches_only
        return MIN_POINTS if with_few.isdisjoint(pair) else MIN_FEW_POINTS

    def _options_of_first(self) -> pycolmap.IncrementalMapperOptions:
        """Return the options for a first pair; where no pair has many inliers, fewer are enough."""
        options = copy.copy(self.options)
        strongest = max(len(pair.matches) for pair in self.graph.pairs)
        enough = max(MIN_FEW_POINTS, math.floor(MIN_INIT_SHARE * strongest))
        options.init_min_num_inliers = min(options.init_min_num_inliers, enough)
        return options

    def _pose_by_few_matches(
        self, model: pycolmap.Reconstruction, ids: tuple[int, int]
    ) -> pycolmap.Rigid3d | None:
        """Return cam2_from_cam1 of a pair with few matches: COLMAP begins with no such pair."""
        pair = next((pair for pair in self.graph.pairs if pair.ids == ids), None)
        if pair is None or not pair.has_few_matches:
            return None
        cameras = {i: model.cameras[model.images[i].camera_id] for i in ids}
        found = self.graph.relative_poses(pair, cameras, self.native.random_seed)
        if not found:
            return None
        return pycolmap.Rigid3d(np.column_stack(found[0].pose))

    def adjust_fully(
        self, model: pycolmap.Reconstruction, max_iterations: int = FINAL
    ) -> None:
        """Triangulate again and adjust a model, by default until it converges.

        Args:
            model: Changed in place.
            max_iterations: Of each adjustment.
        """
        with self._mapping(model) as mapper:
            for _ in range(NUM_LAST_ROUNDS):
                self._refine(mapper, max_iterations)

    def triangulate_all(self, model: pycolmap.Reconstruction) -> None:
        """Triangulate all tracks of a model made from some of them, and adjust it a little."""
        with self._mapping(model) as mapper:
            self._triangulate(mapper, model.reg_image_ids())
            self._refine(mapper, FAST)

    def restart_from(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """Return a new model that begins with the poses and cameras of another one."""
        return self.register_at(
            poses_of(model), cameras_of(model), pycolmap.Reconstruction()
        )

    def remake(
        self, model: pycolmap.Reconstruction, max_iterations: int = FINAL
    ) -> pycolmap.Reconstruction:
        """Return a new model that begins with the poses and cameras of another one, adjusted.

        Args:
            model: It stays as it is.
            max_iterations: Of each adjustment; by default until it converges.
        """
        changed = self.restart_from(model)
        self.adjust_fully(changed, max_iterations)
        return changed

    def register_at(
        self, poses: PoseById, cameras: CameraById, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Register images with given poses; grow and adjust the model from there.

        Args:
            poses: cam_from_world by image id; images that the model has already stay.
            cameras: Cameras of these images, taken over where the model has not used them yet;
                others that it has not used begin with their priors.
            model: Changed in place; may be empty.

        Returns:
            The model.
        """
        used = {model.images[i].camera_id for i in model.reg_image_ids()}
        model.load(self.graph.cache)
        self.adjuster.set_initial_focals(model, used)
        for image_id, (rotation, translation) in poses.items():
            image = model.images[image_id]
            if image.has_pose or image.frame is None:
                continue
            if image.camera_id not in used:
                params = cameras[image_id].params.tolist()
                model.cameras[image.camera_id].params = params
            pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
            image.frame.set_cam_from_world(image.camera_id, pose)
            model.register_frame(image.frame_id)
        with self._mapping(model) as mapper:
            self._triangulate(mapper, poses)
            self._complete(mapper)
        self.show(model.num_reg_images())
        return model

    def _complete(self, mapper: pycolmap.IncrementalMapper) -> None:
        """Register images as long as there are any, and adjust all."""
        model = mapper.reconstruction
        num_adjusted = model.num_reg_images()
        image_id = self._register_next(mapper)
        while image_id:
            if self._is_stopped:
                return
            self._triangulate(mapper, [image_id])
            mapper.complete_and_merge_tracks(self.triangulation)
            num_images = model.num_reg_images()
            self.show(num_images)
            is_small = num_images <= NUM_ALWAYS_ADJUSTED
            if is_small or num_images >= GROWTH * num_adjusted:
                self._adjust(mapper, FAST)
                num_adjusted = num_images
            else:
                neighbors = mapper.find_local_bundle(self.options, image_id)
                self._adjust(mapper, FAST, [image_id, *neighbors])
            image_id = self._register_next(mapper)
        self._refine(mapper, MEDIUM)

    def _register_next(self, mapper: pycolmap.IncrementalMapper) -> int | None:
        """Register one more image by points that it sees; return its id."""
        with_few = self.graph.images_with_few_matches_only
        # Lower limits where any image needs them: each is registered by its own ones below.
        lowest = self.options_for_few_matches if with_few else self.options
        for image_id in mapper.find_next_images(lowest, False):
            has_few = image_id in with_few
            options = self.options_for_few_matches if has_few else self.options
            if mapper.register_next_image(options, image_id):
                return image_id
        return None

    def _triangulate(
        self, mapper: pycolmap.IncrementalMapper, image_ids: Collection[int]
    ) -> None:
        """Triangulate images, and those that a rig took with them."""
        for image_id in _with_frames(mapper.reconstruction, image_ids):
            mapper.triangulate_image(self.triangulation, image_id)

    def _refine(self, mapper: pycolmap.IncrementalMapper, max_iterations: int) -> None:
        mapper.retriangulate(self.triangulation)
        mapper.complete_and_merge_tracks(self.triangulation)
        self._adjust(mapper, max_iterations)

    def _adjust(
        self,
        mapper: pycolmap.IncrementalMapper,
        max_iterations: int,
        image_ids: Sequence[int] | None = None,
    ) -> None:
        self.adjuster.adjust(mapper.reconstruction, max_iterations, image_ids)
        mapper.filter_points(self.options)


def _with_frames(
    model: pycolmap.Reconstruction, image_ids: Collection[int]
) -> list[int]:
    """Return images, each followed by the others of its frame, once."""
    found = dict[int, None]()
    for image_id in image_ids:
        found[image_id] = None
        frame = model.images[image_id].frame
        if frame:
            same_frame = sorted(data.id for data in frame.image_ids)
            found |= dict.fromkeys(same_frame)
    return list(found)


def register_bridges(
    mapped: MappedModel, bridges: BridgeFinder, grower: Grower, scorer: ModelScorer
) -> MappedModel:
    """Register images by bridges as long as that raises the score of a model.

    Args:
        mapped: The model to begin with; it stays as it is.
        bridges: Finds the bridges to other images.
        grower: Registers an image with the pose of a bridge, and what follows from it.
        scorer: Decides whether the model is better with it.

    Returns:
        The model with all bridges.
    """
    model = mapped.reconstruction
    score = scorer.score(model)
    built = dict(mapped.bridges)
    has_grown = True
    while has_grown:
        has_grown = False
        for hypothesis in bridges.find(model)[:MAX_BRIDGES_IN_VAIN]:
            image_id = hypothesis.image_id
            grown = grower.register_at(
                {image_id: hypothesis.pose},
                {image_id: hypothesis.camera},
                copy.deepcopy(model),
            )
            grown_score = scorer.score(grown)
            has_grown = (
                grown.num_reg_images() > model.num_reg_images() and grown_score > score
            )
            if has_grown:
                model = grown
                score = grown_score
                built[grower.graph.names[image_id]] = hypothesis.bridge
                break
    return replace(mapped, reconstruction=model, bridges=built)
