"""The sparse mapper: mapping as one estimate, for small sets with few matches."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import with_shared_cameras
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.camera_priors import EXIF_SIGMA, CameraPrior, camera_priors
from colmap_affrect.mappers.distortion import cameras_that_tell_distortion
from colmap_affrect.mappers.final_points import complete_points, extract_colors
from colmap_affrect.mappers.groups import with_places_mapped_again
from colmap_affrect.mappers.hypotheses import (
    HypothesisTest,
    joined_by_hand,
    restarted,
)
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.model_score import ModelScorer
from colmap_affrect.mappers.pair_graph import PairGraph, graph_of, has_rigs
from colmap_affrect.mappers.rigs import certain_models_of_rigs
from colmap_affrect.mappers.search import Search
from colmap_affrect.mappers.some_tracks import adjust_seldom, large_models
from colmap_affrect.mappers.thinning import OF_LARGE_SETS
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.options import within

# Option of pycolmap that users may give
FORWARD_MOTION = "mapper.init_max_forward_motion"
# Images from which on COLMAP's own pipeline maps: the search would take too long; resource
MIN_LARGE_SET = 100

logger = logging.getLogger(__name__)


class SparseOptions(PipelineOptions):
    """Incremental mapping with priors of the cameras, and bridges by single pairs."""

    name: Literal["sparse"] = "sparse"
    max_images_of_some_pairs: ClassVar[int] = MIN_LARGE_SET
    init_min_num_inliers: Annotated[int, within(1, 1_000_000)] = 40  # judged
    # COLMAP's 16, halved twice, as its pipeline does where no first pair is found
    init_min_tri_angle_deg: Annotated[float, within(0.0, 180.0)] = 4.0
    noise_px: Annotated[float, within(0.01, 100.0)] = NOISE_PX
    """Standard deviation of keypoints; larger errors count less and less."""
    num_seeds: Annotated[int, within(1, 1000)] = 6  # resource
    """Models from first pairs in a row that score no higher than those before, after which no
    others are grown. First pairs that make no model end the search as in COLMAP, after
    ``init_num_trials`` of them."""


class SparseMapper(IncrementalMapper):
    """Maps small sets as one estimate; large ones, and into a model, as COLMAP, and by bridges."""

    Options = SparseOptions
    options: SparseOptions

    def map(
        self,
        task: MappingTask,
        output_path: Path,
        random_seed: int,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Map once, as :class:`colmap_affrect.mappers.base.Mapper` says.

        Args:
            task: What to map.
            output_path: An empty folder that models may be written to.
            random_seed: For all that is left to chance.
            show: Is told how many images have been registered so far.

        Returns:
            The models; their last points come by ``add_last_points``.

        Raises:
            AffrectError: When COLMAP ends with an error.
            KeyboardInterrupt: After mapping has been stopped.
        """
        native = self.native(task, random_seed)
        graph = graph_of(task, native.min_num_matches).without(task.without_pairs)

        def show_or_stop(count: int) -> None:
            if task.cancellation and task.cancellation.is_cancelled:
                raise KeyboardInterrupt
            show(count)

        # Other limits of a hundred images say other things: how many a model has that
        # is looked at closely (focal_observability, direction_uncertainty), and how
        # many come between two snapshots.
        is_small = len(graph.keypoints) < MIN_LARGE_SET and not task.extend
        if is_small:
            if FORWARD_MOTION not in self.options.mapper_options:
                # The score decides on such pairs
                native.mapper.init_max_forward_motion = 1.0
            return self._map_small(task, graph, native, output_path, show_or_stop)
        search = self._search(task, graph, native, show_or_stop)
        search = replace(search, num_bridged_models=1)
        if task.previous_models:
            found = restarted(search, task.previous_models)
        else:
            thin = graph if task.extend else graph.thinned(OF_LARGE_SETS)
            by_colmap = partial(
                self.map_by,
                self._native_of_colmap(task, graph, random_seed),
                output_path=output_path,
                show=show,
            )
            found = large_models(task, search, thin, output_path, by_colmap)
            is_whole = found and not graph.unexplained_by(found[0].reconstruction)
            if is_whole and not task.tie_points:
                if thin is graph:  # then they have all points
                    return found
                return self._with_last_points(found, task, graph, native)
            found.sort(key=lambda mapped: search.best_score([mapped]), reverse=True)
        best = joined_by_hand(search, search.with_bridges(graph, found))
        if not task.extend:
            return self._with_last_points(best, task, graph, native)
        for mapped in best:
            task.extend.restore(mapped.reconstruction)
            extract_colors(mapped.reconstruction, task, native)
        return best

    def _native_of_colmap(
        self, task: MappingTask, graph: PairGraph, random_seed: int
    ) -> pycolmap.IncrementalPipelineOptions:
        """Return the options of COLMAP's pipeline, which adjusts large sets seldom."""
        native = self.native(task, random_seed)
        if len(graph.keypoints) >= MIN_LARGE_SET:
            adjust_seldom(native, self.options.mapper_options)
        return native

    def _map_small(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        output_path: Path,
        show: Callable[[int], None],
    ) -> list[MappedModel]:
        """Return the models with the highest scores.

        Images of one size share uncalibrated cameras at first. Cameras of their own are one more
        hypothesis, which scores higher where they differ, or some images are parts of others.
        """
        bare = replace(task, image_path=None, snapshot_path=None)
        seed = native.random_seed
        whole_by_colmap = partial(super().map, bare, output_path, seed, show)

        def map_some(some: PairGraph) -> list[MappedModel]:
            # COLMAP's own mapper, which would take all pairs, makes none.
            return self._tested(task, some, native, show, by_colmap=list)

        by_colmap = list if task.without_pairs else whole_by_colmap
        best = list[MappedModel]()
        if graph.has_rigs:
            search = self._search(task, graph, native, show)
            best = certain_models_of_rigs(search, bare, self.options, output_path)
        best = best or self._tested(task, graph, native, show, by_colmap)
        if not (task.tie_points or task.previous_models or graph.has_rigs):
            best = with_places_mapped_again(best, graph, map_some)
        for mapped in best:
            if not has_rigs(mapped.reconstruction):  # which tell the scale
                mapped.reconstruction.normalize()  # as COLMAP does
        return self._with_last_points(best, task, graph, native)

    def _tested(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
        by_colmap: Callable[[], list[MappedModel]],
    ) -> list[MappedModel]:
        """Return the models of the best hypothesis.

        Args:
            task: What to map.
            graph: The pairs that models are made from.
            native: Options.
            show: Called with the number of images of a model.
            by_colmap: Returns the models that COLMAP's own mapper makes.
        """
        per_image = self._search(task, graph, native, show)
        best = list[MappedModel]()
        cameras = with_shared_cameras(task.cameras) if task.may_share else task.cameras
        if len(cameras) < len(task.cameras):
            sharing = replace(task, cameras=cameras)
            shared = self._search(sharing, graph.with_cameras(cameras), native, show)
            best = HypothesisTest(task, shared, per_image, by_colmap).run()
        return best or HypothesisTest(task, per_image, None, by_colmap).run()

    def _with_last_points(
        self,
        models: Sequence[MappedModel],
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
    ) -> list[MappedModel]:
        """Have models get the points of all tracks, and colours, once their images are scored."""

        def add_last_points(model: pycolmap.Reconstruction) -> None:
            tie_points = tie_points_of(task, graph)
            complete_points(model, graph, native, self.options.noise_px, tie_points)
            extract_colors(model, task, native)

        return [replace(m, add_last_points=add_last_points) for m in models]

    def _search(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
        show: Callable[[int], None],
    ) -> Search:
        constant_frames = frozenset[int]()
        if task.extend:
            task.extend.constrain(native)
            if not task.extend.refine:
                constant_frames = frozenset(
                    image.frame_id for image in task.extend.images
                )
        priors = self._priors(task, graph, native)
        adjuster = Adjuster(
            priors=priors,
            noise_px=self.options.noise_px,
            refining=native.get_global_bundle_adjustment(),
            constant=self._constant_cameras(task, graph, native),
            constant_frames=constant_frames,
            tie_points=tie_points_of(task, graph),
        )
        return Search(
            adjuster=adjuster,
            scorer=ModelScorer(graph, priors),
            native=native,
            max_models_without_gain=self.options.num_seeds,
            show=show,
        )

    def _priors(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
    ) -> dict[int, CameraPrior]:
        """Return the priors of the focal lengths, by camera id."""
        if not native.ba_refine_focal_length:  # then they are those of the database
            constant = {}
            for camera in graph.cameras.values():
                focal_px = float(camera.mean_focal_length())
                constant[camera.camera_id] = CameraPrior(focal_px, sigma=0.0)
            return constant
        priors = camera_priors(graph.cameras.values(), task.cameras, task.lines)
        if not self.options.keep_given_intrinsics:
            for key, prior in priors.items():
                priors[key] = replace(prior, sigma=prior.sigma or EXIF_SIGMA)
        with_distortion = cameras_that_tell_distortion(graph)
        for key, prior in priors.items():
            has_distortion = key in with_distortion or prior.has_prior_focal_length
            priors[key] = replace(prior, has_distortion=has_distortion)
        return priors

    def _constant_cameras(
        self,
        task: MappingTask,
        graph: PairGraph,
        native: pycolmap.IncrementalPipelineOptions,
    ) -> frozenset[int]:
        """Return the ids of the cameras of which nothing is refined."""
        constant = set[int]()
        if self.options.keep_given_intrinsics:
            constant |= {
                key for key, record in task.cameras.items() if record.is_all_given
            }
        refines_others = (
            native.ba_refine_extra_params or native.ba_refine_principal_point
        )
        if not native.ba_refine_focal_length and not refines_others:
            constant |= {camera.camera_id for camera in graph.cameras.values()}
        if task.extend:
            constant |= native.constant_cameras
        return frozenset(constant)
