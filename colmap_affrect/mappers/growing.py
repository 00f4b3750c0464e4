"""Models that grow from a first pair, as in COLMAP's incremental mapper, and by bridges.

All adjustments know what is known of the cameras (:mod:`colmap_affrect.mappers.adjustment`).
"""

import copy
from collections.abc import Callable, Sequence

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FAST, FINAL, MEDIUM, Adjuster
from colmap_affrect.mappers.bridging import Bridges, Hypothesis, Part
from colmap_affrect.mappers.evidence import Evidence
from colmap_affrect.mappers.pair_graph import CameraById, PairGraph, PoseById
from colmap_affrect.project.report import Bridge

MIN_POINTS = 10  # of a first pair
ALWAYS = 10  # images up to which everything is adjusted after each one
GROWTH = 1.15  # from then on, everything is adjusted when the model has grown by this factor
NUM_LAST_ROUNDS = 2  # of finding points anew and adjusting to the end
MAX_TRIALS = 5  # bridges from one model that are tried before nothing more is expected to join it

Models = list[pycolmap.Reconstruction]


class Grower:
    """Grows models from first pairs, as COLMAP's incremental mapper does."""

    def __init__(
        self,
        cache: pycolmap.DatabaseCache,
        adjuster: Adjuster,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> None:
        self.cache, self.adjuster, self.native, self.show = cache, adjuster, native, show
        self.options, self.triangulation = native.get_mapper(), native.get_triangulation()

    def grow(self, pair: tuple[int, int]) -> pycolmap.Reconstruction | None:
        """Return the model that a first pair of image ids ends with, None if it makes none."""
        model, mapper = pycolmap.Reconstruction(), pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        self.adjuster.begin(model)
        pose = mapper.estimate_initial_two_view_geometry(self.options, *pair)
        if pose is not None:
            mapper.register_initial_image_pair(self.options, *pair, pose)
            for image_id in pair:
                mapper.triangulate_image(self.triangulation, image_id)
            self._adjust(mapper, FAST)
            self.show(len(pair))
        is_model = pose is not None and model.num_points3D() >= MIN_POINTS
        if is_model:
            self.complete(mapper)
        mapper.end_reconstruction(not is_model)
        return model if is_model else None

    def complete(self, mapper: pycolmap.IncrementalMapper) -> None:
        """Register images as long as there are any, and adjust all."""
        model = mapper.reconstruction
        adjusted = model.num_reg_images()
        while image_id := self._register_next(mapper):
            mapper.triangulate_image(self.triangulation, image_id)
            mapper.complete_and_merge_tracks(self.triangulation)
            count = model.num_reg_images()
            self.show(count)
            if count <= ALWAYS or count >= GROWTH * adjusted:
                self._adjust(mapper, FAST)
                adjusted = count
            else:
                near = mapper.find_local_bundle(self.options, image_id)
                self._adjust(mapper, FAST, [image_id, *near])
        self._refine(mapper, MEDIUM)

    def finish(self, model: pycolmap.Reconstruction, max_iterations: int = FINAL) -> None:
        """Find points anew and adjust a model, by default to the end."""
        mapper = pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        for _ in range(NUM_LAST_ROUNDS):
            self._refine(mapper, max_iterations)
        mapper.end_reconstruction(False)

    def fill(self, model: pycolmap.Reconstruction, max_iterations: int) -> None:
        """Find all points of a model that some of them made, and adjust it."""
        mapper = pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        for image_id in model.reg_image_ids():
            mapper.triangulate_image(self.triangulation, image_id)
        self._refine(mapper, max_iterations)
        mapper.end_reconstruction(False)

    def _refine(self, mapper: pycolmap.IncrementalMapper, max_iterations: int) -> None:
        mapper.retriangulate(self.triangulation)
        mapper.complete_and_merge_tracks(self.triangulation)
        self._adjust(mapper, max_iterations)

    def applied(
        self, hypothesis: Hypothesis, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Return a copy of a model with the image of a bridge, grown and adjusted from there."""
        poses = {hypothesis.image_id: hypothesis.pose}
        cameras = {hypothesis.image_id: hypothesis.camera}
        return self.placed(poses, cameras, copy.deepcopy(model))

    def placed(
        self, poses: PoseById, cameras: CameraById, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Register images where they are said to be; grow and adjust the model from there."""
        known = {model.images[i].camera_id for i in model.reg_image_ids()}
        model.load(self.cache)
        for image_id, (rotation, translation) in poses.items():
            image = model.images[image_id]
            if image.has_pose or image.frame is None:
                continue
            if image.camera_id not in known:
                parameters = cameras[image_id].params.tolist()
                model.cameras[image.camera_id].params = parameters
            pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
            image.frame.set_cam_from_world(image.camera_id, pose)
            model.register_frame(image.frame_id)
        mapper = pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        for image_id in poses:
            mapper.triangulate_image(self.triangulation, image_id)
        self.complete(mapper)
        mapper.end_reconstruction(False)
        self.show(model.num_reg_images())
        return model

    def _adjust(
        self,
        mapper: pycolmap.IncrementalMapper,
        max_iterations: int,
        image_ids: Sequence[int] | None = None,
    ) -> None:
        self.adjuster.adjust(mapper.reconstruction, max_iterations, image_ids)
        mapper.filter_points(self.options)

    def _register_next(self, mapper: pycolmap.IncrementalMapper) -> int | None:
        """Register one more image by points that it sees; return its id."""
        for image_id in mapper.find_next_images(self.options, False):
            if mapper.register_next_image(self.options, image_id):
                return image_id
        return None


class Joiner:
    """Joins images to models by bridges until nothing joins."""

    def __init__(self, graph: PairGraph, grower: Grower, evidence: Evidence) -> None:
        self.graph, self.grower, self.evidence = graph, grower, evidence
        self.bridges = Bridges(graph, grower.native.random_seed)

    def join(
        self, model: pycolmap.Reconstruction
    ) -> tuple[pycolmap.Reconstruction, dict[str, Bridge]]:
        """Bridge from a model to images until nothing joins; return its bridges, too."""
        built: dict[str, Bridge] = {}
        score = self.evidence.of(model)
        while True:
            for hypothesis in self.bridges.find(Part(model))[:MAX_TRIALS]:
                grown = self.grower.applied(hypothesis, model)
                new_score = self.evidence.of(grown)
                new = set(grown.reg_image_ids()) - set(model.reg_image_ids())
                if new and new_score > score:
                    break
            else:
                return model, built
            model, score = grown, new_score
            built[self.graph.names[hypothesis.image_id]] = hypothesis.bridge
