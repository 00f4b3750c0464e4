"""Mapping as one estimate: all adjustments have priors of the cameras, one number chooses models.

Models grow from several first pairs as in COLMAP's incremental mapper, and are joined by bridges;
pairs that contradict their loops are tried without. What is kept is what has most evidence
(:mod:`colmap_affrect.mappers.evidence`).
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_copy import copy_without_pairs
from colmap_affrect.mappers.adjustment import (
    EXIF_SIGMA,
    FAST,
    FINAL,
    USUAL_SIGMA,
    Adjuster,
    FocalPrior,
    has_long_tracks,
)
from colmap_affrect.mappers.base import Bridge, MappedModel, MappingTask
from colmap_affrect.mappers.evidence import MIN_GAIN, Evidence
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.loops import contradicting_pairs
from colmap_affrect.mappers.pair_graph import PairGraph, graph_of
from colmap_affrect.mappers.sparse import Joiner
from colmap_affrect.options import within

LARGE = 100  # images from which on COLMAP's own pipeline maps
ZOOMS = 1.0, 1.4, 0.7, 2.0
"""Factors of the usual focal length near which unknown ones begin: all lenses from wide to long."""
SHARED_SIGMA = 0.1
"""Deviation of the logarithm of those that several images share, while models grow: two or three of
these images do not tell it, and models that are to be joined must agree."""
NUM_STARTS = 3  # models that are joined to the others in turn
MIN_POINTS = 10  # of a first pair
ALWAYS = 10  # images up to which everything is adjusted after each one
GROWTH = 1.15  # from then on, everything is adjusted when the model has grown by this factor
NUM_LAST_ROUNDS = 2  # of finding points anew and adjusting to the end

Models = list[pycolmap.Reconstruction]


class EstimateOptions(PipelineOptions):
    """Incremental mapping with priors of the cameras."""

    name: Literal["estimate"] = "estimate"
    is_complete: ClassVar[bool] = True
    max_num_attempts: Annotated[int, within(1, 100)] = 1
    init_min_num_inliers: Annotated[int, within(1, 1_000_000)] = 40
    init_min_tri_angle_deg: Annotated[float, within(0.0, 180.0)] = 4.0
    noise_px: Annotated[float, within(0.01, 100.0)] = 0.7
    """Standard deviation of keypoints; larger errors count less and less."""
    num_seeds: Annotated[int, within(1, 1000)] = 6
    """First pairs in a row that bring nothing, after which no others are tried."""


class Grower:
    """Grows models from first pairs, as COLMAP's incremental mapper does."""

    def __init__(
        self,
        cache: pycolmap.DatabaseCache,
        adjuster: Adjuster,
        native: pycolmap.IncrementalPipelineOptions,
    ) -> None:
        self.cache, self.adjuster, self.native = cache, adjuster, native
        self.options, self.triangulation = native.get_mapper(), native.get_triangulation()

    def grow(self, pair: tuple[int, int]) -> pycolmap.Reconstruction | None:
        """Return the model that a first pair of image ids ends with, None if it makes none."""
        model, mapper = pycolmap.Reconstruction(), pycolmap.IncrementalMapper(self.cache)
        mapper.begin_reconstruction(model)
        for key, camera in model.cameras.items():
            prior = self.adjuster.priors[key]
            if prior.sigma and key not in self.adjuster.constant:
                for index in camera.focal_length_idxs():
                    camera.params[index] = prior.focal_px
        pose = mapper.estimate_initial_two_view_geometry(self.options, *pair)
        if pose is not None:
            mapper.register_initial_image_pair(self.options, *pair, pose)
            for image_id in pair:
                mapper.triangulate_image(self.triangulation, image_id)
            self._adjust(mapper, FAST)
        is_model = pose is not None and model.num_points3D() >= MIN_POINTS
        if is_model:
            self.complete(mapper)
        mapper.end_reconstruction(not is_model)
        return model if is_model else None

    def complete(self, mapper: pycolmap.IncrementalMapper) -> None:
        """Register images as long as there are any, and adjust to the end."""
        model = mapper.reconstruction
        adjusted = model.num_reg_images()
        while image_id := self._register_next(mapper):
            mapper.triangulate_image(self.triangulation, image_id)
            mapper.complete_and_merge_tracks(self.triangulation)
            count = model.num_reg_images()
            if count <= ALWAYS or count >= GROWTH * adjusted:
                self._adjust(mapper, FAST)
                adjusted = count
            else:
                near = mapper.find_local_bundle(self.options, image_id)
                self._adjust(mapper, FAST, [image_id, *near])
        for _ in range(NUM_LAST_ROUNDS):
            mapper.retriangulate(self.triangulation)
            mapper.complete_and_merge_tracks(self.triangulation)
            self._adjust(mapper, FINAL)

    def _adjust(
        self,
        mapper: pycolmap.IncrementalMapper,
        max_iterations: int,
        image_ids: Sequence[int] | None = None,
    ) -> None:
        self.adjuster.adjust(mapper.reconstruction, max_iterations, image_ids)
        mapper.filter_points(self.options)

    def _register_next(self, mapper: pycolmap.IncrementalMapper) -> int | None:
        """Register one more image, by points or else by matches alone; return its id."""
        for register, by_matches in (
            (mapper.register_next_image, False),
            (mapper.register_next_structure_less_image, True),
        ):
            for image_id in mapper.find_next_images(self.options, by_matches):
                if register(self.options, image_id):
                    return image_id
        return None


class EstimateJoiner(Joiner):
    """Joins models by bridges, with the adjustments and the evidence of the estimate."""

    def __init__(
        self, graph: PairGraph, grower: Grower, evidence: Evidence, show: Callable[[int], None]
    ) -> None:
        super().__init__(graph, grower.native, show)
        self.grower, self.score = grower, evidence.of

    def finish(self, mapper: pycolmap.IncrementalMapper) -> None:
        """See :class:`Joiner`."""
        self.grower.complete(mapper)


class EstimateMapper(IncrementalMapper):
    """Maps small sets as one estimate; large ones, rigs and models to extend go COLMAP's way."""

    Options = EstimateOptions
    options: EstimateOptions

    def map(
        self, task: MappingTask, output_path: Path, random_seed: int, show: Callable[[int], None]
    ) -> list[MappedModel]:
        """See :class:`colmap_affrect.mappers.base.Mapper`."""
        native = self.native(task, random_seed)
        graph = graph_of(task, native.min_num_matches)
        has_rigs = any(rig.num_sensors() > 1 for rig in graph.cache.rigs.values())
        if task.extend or has_rigs or len(graph.keypoints) >= LARGE:
            return super().map(task, output_path, random_seed, show)
        native.mapper.init_max_forward_motion = 1.0  # the evidence decides about such pairs
        cameras = {camera.camera_id: camera for camera in graph.cameras.values()}
        priors = {key: FocalPrior.of(c, task.cameras.get(key)) for key, c in cameras.items()}
        if not self.options.keep_given_intrinsics:
            priors = {k: replace(p, sigma=p.sigma or EXIF_SIGMA) for k, p in priors.items()}
        adjuster = Adjuster(
            priors, self.options.noise_px, frozenset(task.constant_cameras(self.options))
        )
        search = _Search(adjuster, Evidence(graph, priors), native, self.options.num_seeds, show)
        best = search.best(graph)
        wrong = contradicting_pairs(graph, random_seed)
        trusted = graph.without(wrong)
        if wrong and not (best and trusted.is_explained_by(best[0].reconstruction)):
            path = output_path / "reduced.db"
            copy_without_pairs(task.database_path, path, wrong)
            again = search.best(graph_of(replace(task, database_path=path), native.min_num_matches))
            best = max(best, again, key=search.evidence_of)
        if native.extract_colors and task.image_path:
            for model in best:
                model.reconstruction.extract_colors_for_all_images(task.image_path)
        return best


def _is_certain(best: MappedModel, graph: PairGraph) -> bool:
    """Tell whether a model has all images, and points enough to know their focal lengths."""
    model = best.reconstruction
    return graph.is_explained_by(model) and not best.bridges and has_long_tracks(model)


@dataclass(frozen=True)
class _Search:
    """Looks for the models with most evidence."""

    adjuster: Adjuster
    evidence: Evidence
    native: pycolmap.IncrementalPipelineOptions
    num_seeds: int
    show: Callable[[int], None]

    def evidence_of(self, models: Sequence[MappedModel]) -> float:
        """Return the evidence of the best of some models."""
        return self.evidence.of_best(model.reconstruction for model in models)

    def best(self, graph: PairGraph) -> list[MappedModel]:
        """Return the best model, and then the best ones of images that none before has."""
        best: list[MappedModel] = []
        for adjuster in self._hypotheses():
            found = self._near(graph, Grower(graph.cache, adjuster, self.native))
            if adjuster is not self.adjuster:
                for model in found:
                    self.adjuster.adjust(model.reconstruction, FINAL)
            best = max(best, found, key=self.evidence_of)
            if best and _is_certain(best[0], graph):
                break
        return best

    def _hypotheses(self) -> Iterator[Adjuster]:
        """Yield adjusters that keep unknown focal lengths near one value each, if there are any."""
        priors = self.adjuster.priors
        unknown = {key: prior for key, prior in priors.items() if prior.sigma > EXIF_SIGMA}
        counts = Counter(camera.camera_id for camera in self.evidence.graph.cameras.values())
        shared, sigma = {key for key in counts if counts[key] > 1}, (USUAL_SIGMA, SHARED_SIGMA)
        for zoom in ZOOMS if unknown else ():
            near = {
                key: FocalPrior(zoom * prior.focal_px, sigma[key in shared])
                for key, prior in unknown.items()
            }
            yield replace(self.adjuster, priors={**priors, **near})
        if not unknown:
            yield self.adjuster

    def _near(self, graph: PairGraph, grower: Grower) -> list[MappedModel]:
        """Return the best models near some focal lengths."""
        models = self._grown(graph, grower)
        if not models or graph.is_explained_by(models[0]):
            return [MappedModel(model) for model in models[:1]]
        joiner = EstimateJoiner(graph, grower, self.evidence, self.show)
        joined: list[tuple[pycolmap.Reconstruction, list[Bridge]]] = []
        for index, model in enumerate(models[:NUM_STARTS]):
            grown, bridges, _ = joiner.grow(model, models[:index] + models[index + 1 :])
            joined.append((grown, bridges))
        best, bridges = max(joined, key=lambda pair: self.evidence.of(pair[0]))
        found, inside = [MappedModel(best, tuple(bridges))], set(best.reg_image_ids())
        for model in models:
            if inside.isdisjoint(model.reg_image_ids()):
                found.append(MappedModel(model))
                inside.update(model.reg_image_ids())
        return found

    def _grown(self, graph: PairGraph, grower: Grower) -> Models:
        """Return models of different images, that with most evidence first."""
        models: dict[frozenset[int], tuple[float, pycolmap.Reconstruction]] = {}
        best, in_vain = 0.0, 0
        for pair in sorted(graph.pairs, key=lambda pair: -len(pair.matches)):
            if in_vain >= self.num_seeds:
                break
            model = grower.grow(pair.ids)
            if model is None:
                continue
            self.show(model.num_reg_images())
            images, evidence = frozenset(model.reg_image_ids()), self.evidence.of(model)
            in_vain = 0 if evidence > best + MIN_GAIN else in_vain + 1
            best = max(best, evidence)
            if images not in models or evidence > models[images][0]:
                models[images] = evidence, model
            has_all = len(images) == len(graph.keypoints)
            if (has_all and in_vain) or graph.is_explained_by(model):
                break
        ordered = sorted(models.values(), key=lambda found: -found[0])
        return [model for _, model in ordered]
