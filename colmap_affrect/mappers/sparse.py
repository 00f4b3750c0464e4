"""The sparse mapper: COLMAP's incremental mapper, and bridges to what it leaves out."""

import copy
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import copy_without_pairs
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.mappers.bridging import Bridges, Hypothesis, Part
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.loops import contradicting_pairs
from colmap_affrect.mappers.pair_graph import PairGraph, graph_of

MAX_TRIALS = 5
"""Bridges from one model that are tried before nothing more is expected to join it."""


class SparseOptions(PipelineOptions):
    """Incremental mapping, then bridges by single pairs."""

    name: Literal["sparse"] = "sparse"


class SparseMapper(IncrementalMapper):
    """Incremental mapping; what it leaves out, images and models, is joined by bridges.

    Pairs that contradict the loops they stand in are left out when that explains the others
    better; a model that has all images and contradicts no others stays as it is.
    """

    Options = SparseOptions

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        models = self._mapped(task, output_path / "all", random_seed, show)
        native = self.native(task, random_seed)
        graph = graph_of(task, native.min_num_matches)
        if models and graph.is_explained_by(models[0]):
            return [MappedModel(model) for model in models]
        contradicting = contradicting_pairs(graph, random_seed)
        trusted = graph.without(contradicting)
        if models and trusted.is_explained_by(models[0]):
            return [MappedModel(model) for model in models]
        if contradicting:
            reduced = output_path / "reduced.db"
            copy_without_pairs(task.database_path, reduced, contradicting)
            again = replace(task, database_path=reduced, snapshot_path=None)
            others = self._mapped(again, output_path / "reduced", random_seed, show)
            models = max(models, others, key=trusted.best_score)
        if task.extend:
            task.extend.constrain(native)
        joined = Joiner(trusted, native, show).join(models)
        for model in joined:
            if task.extend:
                task.extend.adjust_others(model.reconstruction, native)
                task.extend.restore(model.reconstruction)
            if model.bridges and native.extract_colors and task.image_path:
                model.reconstruction.extract_colors_for_all_images(task.image_path)
        return joined

    def _mapped(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[pycolmap.Reconstruction]:
        output_path.mkdir()
        found = super().map(task, output_path, random_seed, show)
        return [model.reconstruction for model in found]


class Joiner:
    """Joins models and images by bridges until nothing joins."""

    def __init__(
        self,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> None:
        """Keep what all steps need."""
        self.graph, self.native, self.show = graph, native, show
        self.bridges = Bridges(graph, native.random_seed)
        self.score: Callable[[pycolmap.Reconstruction], float] = graph.score_of

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

    def grow(
        self, model: pycolmap.Reconstruction, others: list[pycolmap.Reconstruction]
    ) -> tuple[pycolmap.Reconstruction, list[Bridge], list[pycolmap.Reconstruction]]:
        """Bridge from a model until nothing joins; return it, its bridges and the other models."""
        built: list[Bridge] = []
        score = self.score(model)
        while True:
            hypotheses = self.bridges.find(Part(model), [Part(other) for other in others])
            for hypothesis in hypotheses[:MAX_TRIALS]:
                grown = self.applied(hypothesis, model)
                new_score = self.score(grown)
                new = set(grown.reg_image_ids()) - set(model.reg_image_ids())
                if new and new_score > score and self.graph.supports(grown, new):
                    break
            else:
                return model, built, others
            model, score = grown, new_score
            built.append(hypothesis.bridge)
            if hypothesis.other is not None:
                others = [other for i, other in enumerate(others) if i != hypothesis.other]

    def applied(
        self, hypothesis: Hypothesis, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Return a copy of a model with the images of a bridge, grown and refined from there."""
        model = copy.deepcopy(model)
        known = {model.images[i].camera_id for i in model.reg_image_ids()}
        model.load(self.graph.cache)
        for image_id, (rotation, translation) in hypothesis.poses.items():
            image = model.images[image_id]
            if image.has_pose or image.frame is None:
                continue
            if image.camera_id not in known:
                parameters = hypothesis.cameras[image_id].params.tolist()
                model.cameras[image.camera_id].params = parameters
            pose = pycolmap.Rigid3d(np.column_stack([rotation, translation]))
            image.frame.set_cam_from_world(image.camera_id, pose)
            model.register_frame(image.frame_id)
        mapper = pycolmap.IncrementalMapper(self.graph.cache)
        mapper.begin_reconstruction(model)
        for image_id in hypothesis.poses:
            mapper.triangulate_image(self.native.get_triangulation(), image_id)
        self.finish(mapper)
        mapper.end_reconstruction(False)
        self.show(model.num_reg_images())
        return model

    def finish(self, mapper: pycolmap.IncrementalMapper) -> None:
        """Refine a model, and register what can be by its tracks now."""
        self._refine(mapper)
        self._register_next(mapper)

    def _register_next(self, mapper: pycolmap.IncrementalMapper) -> None:
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
