"""The sparse mapper: COLMAP's incremental mapper, and bridges to what it leaves out."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.mappers.bridging import Bridges, Hypothesis, Part
from colmap_affrect.mappers.incremental import IncrementalMapper, IncrementalOptions
from colmap_affrect.mappers.pair_graph import PairGraph, poses_of


class SparseOptions(IncrementalOptions):
    """Incremental mapping, then bridges by single pairs."""

    name: Literal["sparse"] = "sparse"  # type: ignore[assignment]


class SparseMapper(IncrementalMapper):
    """Incremental mapping; what it leaves out, images and models, is joined by bridges."""

    Options = SparseOptions

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        models = super().map(task, output_path, random_seed, show)
        native = self.native(random_seed, intrinsics_given=task.intrinsics_given)
        graph = PairGraph.read(task.database_path, native.min_num_matches)
        missing = set(graph.keypoints)
        for model in models:
            if missing <= set(model.reconstruction.reg_image_ids()):
                return models
        with open_database(task.database_path) as database:
            options = pycolmap.DatabaseCacheOptions(min_num_matches=native.min_num_matches)
            cache = pycolmap.DatabaseCache.create(database, options)
        joiner = Joiner(graph, cache, native, show)
        joined = joiner.join([model.reconstruction for model in models])
        for model in joined:
            if model.bridges and native.extract_colors:
                model.reconstruction.extract_colors_for_all_images(task.image_path)
        return joined


class Joiner:
    """Joins models and images by bridges until nothing joins."""

    def __init__(
        self,
        graph: PairGraph,
        cache: pycolmap.DatabaseCache,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> None:
        """Keep what all steps need."""
        self.graph, self.cache, self.native, self.show = graph, cache, native, show
        self.bridges = Bridges(graph, native.random_seed)

    def join(self, models: Iterable[pycolmap.Reconstruction]) -> list[MappedModel]:
        """Let the best model grow, then the next one, with the models that are left."""
        left = sorted(models, key=self.score, reverse=True)
        joined = []
        while left:
            model, bridges, left = self.grow(left[0], left[1:])
            inside = set(model.reg_image_ids())
            left = [other for other in left if not inside >= set(other.reg_image_ids())]
            joined.append(MappedModel(model, tuple(bridges)))
        return joined

    def score(self, model: pycolmap.Reconstruction) -> float:
        """Return how well a model agrees with the verified pairs."""
        part = Part(model)
        return self.graph.score(part.poses, part.cameras)

    def grow(
        self, model: pycolmap.Reconstruction, others: list[pycolmap.Reconstruction]
    ) -> tuple[pycolmap.Reconstruction, list[Bridge], list[pycolmap.Reconstruction]]:
        """Bridge from a model until nothing joins; return it, its bridges and the other models."""
        built: list[Bridge] = []
        failed: set[tuple[Any, ...]] = set()
        score = self.score(model)
        while True:
            hypotheses = self.bridges.find(Part(model), [Part(other) for other in others])
            untried = [h for h in hypotheses if (h.bridge.pair, h.bridge.names) not in failed]
            if not untried:
                return model, built, others
            best = untried[0]
            grown = self.applied(best, model)
            new_score = self.score(grown)
            came_in = set(best.poses) & set(grown.reg_image_ids())
            if new_score <= score or not came_in:
                failed.add((best.bridge.pair, best.bridge.names))
                continue
            model, score = grown, new_score
            built.append(best.bridge)
            failed.clear()
            if best.other is not None:
                others = [other for i, other in enumerate(others) if i != best.other]

    def applied(
        self, hypothesis: Hypothesis, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Return a copy of a model with the images of a bridge, grown and refined from there."""
        model = copy.deepcopy(model)
        known = {model.images[i].camera_id for i in model.reg_image_ids()}
        model.load(self.cache)
        for image_id, (rotation, translation) in hypothesis.poses.items():
            image = model.images[image_id]
            if image.has_pose:
                continue
            if image.camera_id not in known:
                model.cameras[image.camera_id].params = hypothesis.cameras[image_id].params
            matrix = _matrix(rotation, translation)
            image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(matrix))
            model.register_frame(image.frame_id)
        mapper = pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        for image_id in hypothesis.poses:
            mapper.triangulate_image(self.native.get_triangulation(), image_id)
        self._refine(mapper)
        self._register_next(mapper, model)
        mapper.end_reconstruction(False)
        self.show(model.num_reg_images())
        return model

    def _register_next(
        self, mapper: pycolmap.IncrementalMapper, model: pycolmap.Reconstruction
    ) -> None:
        """Register images by their tracks as long as there are any, as COLMAP's pipeline does."""
        native = self.native
        options, triangulation = native.get_mapper(), native.get_triangulation()
        registered = True
        any_registered = False
        while registered:
            registered = False
            for image_id in mapper.find_next_images(options, False):
                if mapper.register_next_image(options, image_id):
                    mapper.triangulate_image(triangulation, image_id)
                    mapper.iterative_local_refinement(
                        native.ba_local_max_refinements,
                        native.ba_local_max_refinement_change,
                        options,
                        native.get_local_bundle_adjustment(),
                        triangulation,
                        image_id,
                    )
                    registered = any_registered = True
                    break
        if any_registered:
            self._refine(mapper)

    def _refine(self, mapper: pycolmap.IncrementalMapper) -> None:
        native = self.native
        mapper.iterative_global_refinement(
            native.ba_global_max_refinements,
            native.ba_global_max_refinement_change,
            native.get_mapper(),
            native.get_global_bundle_adjustment(),
            native.get_triangulation(),
        )


def _matrix(rotation: Any, translation: Any) -> Any:
    import numpy as np

    return np.column_stack([rotation, translation])
