"""The sparse mapper: mapping as one estimate, for small sets with few matches."""

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import with_shared_cameras
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers.adjustment import NOISE_PX, Adjuster
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.camera_priors import EXIF_SIGMA, CameraPrior, camera_priors
from colmap_affrect.mappers.distortion import cameras_that_tell_distortion
from colmap_affrect.mappers.final_points import complete_points, extract_colors
from colmap_affrect.mappers.groups import with_other_groups, with_places_mapped_again
from colmap_affrect.mappers.incremental import IncrementalMapper, PipelineOptions
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN, ModelScorer
from colmap_affrect.mappers.other_motions import share_of_motion
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, graph_of, has_rigs
from colmap_affrect.mappers.point_joining import joined_by_points
from colmap_affrect.mappers.principal_points import (
    axis_turns_deg,
    freed_principal_point_cost,
    gains_of_freedom,
    with_free_principal_points,
    with_shifted_axes,
)
from colmap_affrect.mappers.search import Search, with_new_images
from colmap_affrect.mappers.some_tracks import (
    large_models,
    model_of_some_tracks,
)
from colmap_affrect.mappers.tie_joining import TieJoiner
from colmap_affrect.mappers.tie_points import tie_points_of
from colmap_affrect.options import within

# What made a model, in the words of a report.
# Others also verify sides that look the same
MEASURED_PAIRS = "with the pairs of measured frames"
ALL_PAIRS = "with all pairs"
AGAIN = "after pairs were matched again"
PER_IMAGE_CAMERAS = "with a camera for each photograph"
COLMAP_MODEL = "from COLMAP's model"
SHIFTED_AXES = "with optical axes off the middle"

# Of COLMAP's models, the largest ones, that are gone on from; resource
NUM_COLMAP_MODELS = 2
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
            found = _restarted(search, task.previous_models)
        else:
            by_colmap = partial(
                super().map,
                output_path=output_path,
                random_seed=random_seed,
                show=show,
            )
            thin = graph if task.extend else graph.thinned()
            found = large_models(task, search, thin, output_path, by_colmap)
            is_whole = found and not graph.unexplained_by(found[0].reconstruction)
            if is_whole and not task.tie_points:
                if thin is graph:  # then they have all points
                    return found
                return self._with_last_points(found, task, graph, native)
            found.sort(key=lambda mapped: search.best_score([mapped]), reverse=True)
        best = _joined_by_tie_points(search, search.with_bridges(graph, found))
        if not task.extend:
            return self._with_last_points(best, task, graph, native)
        for mapped in best:
            task.extend.restore(mapped.reconstruction)
            extract_colors(mapped.reconstruction, task, native)
        return best

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
        best = self._tested(task, graph, native, show, by_colmap)
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
            best = _HypothesisTest(task, shared, per_image, by_colmap).run()
        return best or _HypothesisTest(task, per_image, None, by_colmap).run()

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


@dataclass(frozen=True)
class _Hypothesis:
    """Which pairs a model is made from."""

    name: str  # in the words of a report
    left_out: Collection[Ids]


class _HypothesisTest:
    """Makes models under several hypotheses and keeps those with the highest score."""

    def __init__(
        self,
        task: MappingTask,
        search: Search,
        per_image: Search | None,
        by_colmap: Callable[[], list[MappedModel]],
    ) -> None:
        """Begin with the previous models of a task.

        Args:
            task: What to map.
            search: Makes and scores models, with the cameras that images have at first.
            per_image: The same with a camera for each image; None if they have these at first.
            by_colmap: Returns the models that COLMAP's own mapper makes.
        """
        self.task = task
        self.by_colmap = by_colmap
        self.search = search
        self.per_image = per_image
        self._begin_with_cameras_of(task.previous_models)
        self.best = _restarted(self.search, task.previous_models)
        self.score = self.search.best_score(self.best)

    def run(self) -> list[MappedModel]:
        """Return the best models."""
        for hypothesis in self._hypotheses():
            if self._is_certain():
                break
            models = self._built(hypothesis)
            score = self.search.best_score(models)
            if models and (not self.best or score > self.score):
                self._take(models, score)
                self._try_per_image_cameras(hypothesis)
        if not self._is_certain():
            self._try_colmap()
        self._try_straight_lens()
        self._try_shifted_axes()
        self.best = with_other_groups(self.search, self.best)
        self.best = joined_by_points(self.search, self.best)
        return _joined_by_tie_points(self.search, self.best)

    def _hypotheses(self) -> list[_Hypothesis]:
        """Return the hypotheses, the one with the fewest pairs first."""
        ids = {name: image_id for image_id, name in self.search.graph.names.items()}
        unmeasured = set[Ids]()
        for first, second in self.task.unmeasured_pairs:
            unmeasured.add((min(ids[first], ids[second]), max(ids[first], ids[second])))
        found = [_Hypothesis(ALL_PAIRS, ())]
        if unmeasured:
            found.insert(0, _Hypothesis(MEASURED_PAIRS, unmeasured))
        return found

    def _is_certain(self) -> bool:
        if not self.best:
            return False
        return self.search.is_certain(self.best[0].reconstruction, self.search.graph)

    def _built(self, hypothesis: _Hypothesis) -> list[MappedModel]:
        """Return the models of a hypothesis, none where it explains no more than the best ones.

        Models that were known before are adjusted with its pairs, too, so that all of them have
        its name, each after the hypotheses that made it before.
        """
        graph = self.search.graph.without(hypothesis.left_out)
        if not self.best:
            models = model_of_some_tracks(self.search, graph)
            models = models or self.search.best(graph)
            return [mapped.first_by(hypothesis.name) for mapped in models]
        if not graph.unexplained_by(self.best[0].reconstruction):
            return []
        models = self.search.extend_models(graph, self.best)
        return [mapped.also_by(hypothesis.name) for mapped in models]

    def _take(self, models: Sequence[MappedModel], score: float) -> None:
        self.best = list(models)
        self.score = score

    def _try_colmap(self) -> None:
        """Take over the poses of COLMAP's own model where the model of these scores higher.

        COLMAP refines an unknown focal length from its one default on as a model grows, and may
        end elsewhere than the values that the search begins with. Where all are known, it begins
        at the same values as the search, and a second mapping would cost time for nothing else.
        """
        search = self.search
        if not search.unknown or search.graph.has_rigs or self.task.previous_models:
            return
        try:
            models = self.by_colmap()
        except AffrectError as error:  # ours stays
            logger.info("%s", error)
            return
        models.sort(key=lambda mapped: -mapped.reconstruction.num_reg_images())
        grower = search.grower(search.graph)
        found = list[MappedModel]()
        for mapped in models[:NUM_COLMAP_MODELS]:
            found.append(MappedModel(grower.remake(mapped.reconstruction)))
        found.sort(key=lambda mapped: search.best_score([mapped]), reverse=True)
        found = search.with_bridges(search.graph, found)
        score = search.best_score(found)
        if found and score > self.score + MIN_SCORE_GAIN:
            self._take([mapped.first_by(COLMAP_MODEL) for mapped in found], score)

    def _begin_with_cameras_of(self, models: Sequence[MappedModel]) -> None:
        """Go on with the cameras, and the optical axes, that models had."""
        told = set[str]()
        for mapped in models:
            told.update(mapped.hypotheses)
        if self.per_image and not told.isdisjoint({PER_IMAGE_CAMERAS, SHIFTED_AXES}):
            self.search = self.per_image
            self.per_image = None
        if SHIFTED_AXES in told:
            free = with_free_principal_points(self.search, self.task.cameras)
            self.search = free or self.search

    def _try_straight_lens(self) -> None:
        """Adjust the best model from a straight lens where that leads to a better optimum."""
        if not self.best or not self.search.unknown:
            return
        model = self.search.from_straight_lens(self.best[0].reconstruction)
        self.best = [replace(self.best[0], reconstruction=model), *self.best[1:]]
        self.score = self.search.best_score(self.best)

    def _try_shifted_axes(self) -> None:
        """Free the principal points of the best model where its points ask for it.

        Where the points leave that open, how far rotations turn with free ones says how sure they
        are.
        """
        search = self.search
        if not self.best or search.graph.has_rigs:
            return
        free = with_free_principal_points(search, self.task.cameras)
        model = self.best[0].reconstruction
        if free is None:
            return
        gains = gains_of_freedom(model, search, free)
        if gains.contradict_constant and self._take_shifted_axes(free):
            return
        if gains.leave_constant_open:
            turns_deg = axis_turns_deg(model, free, search.graph)
            self.best = [
                replace(self.best[0], axis_turns_deg=turns_deg),
                *self.best[1:],
            ]

    def _take_shifted_axes(self, free: Search) -> bool:
        """Take the best model with free principal points where it scores higher; tell whether."""
        search = self.search
        model = self.best[0].reconstruction
        changed = with_shifted_axes(model, free, search.graph)
        share = self._motion_share(self.best[0])
        first = replace(self.best[0], reconstruction=changed, motion_share=share)
        found = free.with_bridges(search.graph, [first.also_by(SHIFTED_AXES)])
        found = with_new_images([*found, *self.best[1:]])
        score = free.best_score(found[:1])
        # That the points ask for it has paid for the principal points.
        paid = freed_principal_point_cost(found[0].reconstruction, search, free)
        if score + paid > self.score + MIN_SCORE_GAIN:
            self.search = free
            self._take(found, score)
            return True
        return False

    def _try_per_image_cameras(self, hypothesis: _Hypothesis) -> None:
        """Give each image of the best model a camera of its own where that scores higher."""
        if self.per_image is None:
            return
        first = self.best[0]
        graph = self.per_image.graph.without(hypothesis.left_out)
        model = _with_per_image_cameras(
            self.per_image, graph, self.search, first.reconstruction
        )
        if model is None:
            return
        score = self.per_image.scorer.score(model)
        if score <= self.score + MIN_SCORE_GAIN:
            return
        share = self._motion_share(first)
        changed = replace(first, reconstruction=model, motion_share=share)
        # The others, too: what is shared and what is not do not fit into one graph.
        others = [_remade(self.per_image, mapped) for mapped in self.best[1:]]
        self.best = with_new_images([changed.also_by(PER_IMAGE_CAMERAS), *others])
        self.search = self.per_image
        self.per_image = None
        self.score = self.search.best_score(self.best)

    def _motion_share(self, mapped: MappedModel) -> float:
        """Return the share of what moves as a model says: other cameras may hide the rest."""
        found = share_of_motion(mapped.reconstruction, self.search.graph)
        return min(found, mapped.motion_share)


def _joined_by_tie_points(
    search: Search, models: Sequence[MappedModel]
) -> list[MappedModel]:
    grower = search.grower(search.graph)
    return TieJoiner(search.adjuster.tie_points, grower, search.scorer).join(models)


def _restarted(search: Search, previous: Sequence[MappedModel]) -> list[MappedModel]:
    """Return models with the poses of previous ones, and all that their tracks now register."""
    return with_new_images(_remade(search, one).also_by(AGAIN) for one in previous)


def _remade(search: Search, mapped: MappedModel) -> MappedModel:
    """Return a model with its poses, adjusted with the cameras and pairs of a search."""
    model = search.grower(search.graph).remake(mapped.reconstruction)
    return replace(mapped, reconstruction=model)


def _with_per_image_cameras(
    per_image: Search, graph: PairGraph, shared: Search, model: pycolmap.Reconstruction
) -> pycolmap.Reconstruction | None:
    """Return a model with a camera for each image.

    Args:
        per_image: Makes the model.
        graph: Its pairs.
        shared: Scores the model with shared cameras.
        model: The model with shared cameras.

    Returns:
        The model; None where it scores no higher with some of the tracks.
    """
    thin = graph.thinned()
    if thin is not graph:
        trial = per_image.comparing().grower(thin).restart_from(model)
        per_image_score = replace(per_image.scorer, graph=thin).score(trial)
        shared_score = replace(shared.scorer, graph=thin).score(model)
        if per_image_score <= shared_score + MIN_SCORE_GAIN:
            return None
    return per_image.grower(graph).remake(model)
