"""Models that grow from a first pair, as in COLMAP's incremental mapper, and by bridges.

All adjustments know what is known of the cameras (:mod:`colmap_affrect.mappers.adjustment`).
"""

import copy
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FAST, FINAL, MEDIUM, Adjuster
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import Bridges
from colmap_affrect.mappers.evidence import Evidence
from colmap_affrect.mappers.pair_graph import CameraById, PairGraph, PoseById, cameras_of, poses_of

MIN_POINTS = 10  # of a first pair
ALWAYS = 10  # images up to which everything is adjusted after each one
GROWTH = 1.15  # from then on, everything is adjusted when the model has grown by this factor
NUM_LAST_ROUNDS = 2  # of finding points anew and adjusting to the end
MAX_TRIALS = 5  # bridges from one model that are tried before nothing more is expected to join it


class Grower:
    """Grows models from first pairs, as COLMAP's incremental mapper does."""

    def __init__(
        self,
        graph: PairGraph,
        adjuster: Adjuster,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> None:
        self.graph, self.adjuster, self.native, self.show = graph, adjuster, native, show
        self.options, self.triangulation = native.get_mapper(), native.get_triangulation()

    @contextmanager
    def _mapping(self, model: pycolmap.Reconstruction) -> Iterator[pycolmap.IncrementalMapper]:
        mapper = pycolmap.IncrementalMapper(self.graph.cache)
        mapper.begin_reconstruction(model)
        yield mapper
        mapper.end_reconstruction(False)

    def grow(self, pair: tuple[int, int]) -> pycolmap.Reconstruction | None:
        """Return the model that a first pair of image ids ends with, None if it makes none."""
        model = pycolmap.Reconstruction()
        with self._mapping(model) as mapper:
            self.adjuster.begin(model)
            pose = mapper.estimate_initial_two_view_geometry(self.options, *pair)
            if pose is None:
                return None
            mapper.register_initial_image_pair(self.options, *pair, pose)
            self._triangulate(mapper, pair)
            self._adjust(mapper, FAST)
            self.show(len(pair))
            if model.num_points3D() < MIN_POINTS:
                return None
            self._complete(mapper)
        return model

    def _complete(self, mapper: pycolmap.IncrementalMapper) -> None:
        """Register images as long as there are any, and adjust all."""
        model = mapper.reconstruction
        adjusted = model.num_reg_images()
        while image_id := self._register_next(mapper):
            self._triangulate(mapper, [image_id])
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
        with self._mapping(model) as mapper:
            for _ in range(NUM_LAST_ROUNDS):
                self._refine(mapper, max_iterations)

    def fill(self, model: pycolmap.Reconstruction) -> None:
        """Find all points of a model that some of them made, and adjust it a little."""
        with self._mapping(model) as mapper:
            self._triangulate(mapper, model.reg_image_ids())
            self._refine(mapper, FAST)

    def again(self, model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """Return a new model that begins with the poses and cameras of another one."""
        return self.placed(poses_of(model), cameras_of(model), pycolmap.Reconstruction())

    def placed(
        self, poses: PoseById, cameras: CameraById, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Register images where they are said to be; grow and adjust the model from there."""
        known = {model.images[i].camera_id for i in model.reg_image_ids()}
        model.load(self.graph.cache)
        for image_id, (rotation, translation) in poses.items():
            image = model.images[image_id]
            if image.has_pose or image.frame is None:
                continue
            if image.camera_id not in known:
                model.cameras[image.camera_id].params = cameras[image_id].params.tolist()
            pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
            image.frame.set_cam_from_world(image.camera_id, pose)
            model.register_frame(image.frame_id)
        with self._mapping(model) as mapper:
            self._triangulate(mapper, poses)
            self._complete(mapper)
        self.show(model.num_reg_images())
        return model

    def _triangulate(self, mapper: pycolmap.IncrementalMapper, image_ids: Collection[int]) -> None:
        """Find points of images, and of those of a rig that were taken with them."""
        for image_id in _of_frames(mapper.reconstruction, image_ids):
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

    def _register_next(self, mapper: pycolmap.IncrementalMapper) -> int | None:
        """Register one more image by points that it sees; return its id."""
        ids = mapper.find_next_images(self.options, False)
        return next((i for i in ids if mapper.register_next_image(self.options, i)), None)


def _of_frames(model: pycolmap.Reconstruction, image_ids: Collection[int]) -> list[int]:
    """Return images, each before the others of its frame, once."""
    found = dict[int, None]()
    for image_id in image_ids:
        found[image_id] = None
        frame = model.images[image_id].frame
        mates = sorted(data.id for data in frame.image_ids) if frame else []
        found |= dict.fromkeys(mates)
    return list(found)


def join(mapped: MappedModel, bridges: Bridges, grower: Grower, evidence: Evidence) -> MappedModel:
    """Bridge from a model to images until nothing joins."""
    model, built = mapped.reconstruction, dict(mapped.bridges)
    score = evidence.of(model)
    while True:
        for found in bridges.find(model)[:MAX_TRIALS]:
            place = {found.image_id: found.pose}, {found.image_id: found.camera}
            grown = grower.placed(*place, copy.deepcopy(model))
            new_score = evidence.of(grown)
            if grown.num_reg_images() > model.num_reg_images() and new_score > score:
                break
        else:
            return replace(mapped, reconstruction=model, bridges=built)
        model, score = grown, new_score
        built[grower.graph.names[found.image_id]] = found.bridge
