"""Which hypothesis a model of a small set is made under: that with the highest score.

Hypotheses say which pairs are used, whether images share cameras, where models begin, and whether
optical axes are in the middle.
"""

import logging
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.groups import with_other_groups
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN
from colmap_affrect.mappers.other_cameras import OtherCameras
from colmap_affrect.mappers.other_motions import share_moving_as_modelled
from colmap_affrect.mappers.own_cameras import (
    MAX_OPEN_IMAGES,
    OwnCameras,
    one_camera,
    own_cameras,
    trial_with_own_cameras,
    with_per_image_cameras,
)
from colmap_affrect.mappers.pair_graph import Ids, has_rigs
from colmap_affrect.mappers.point_joining import joined_by_points
from colmap_affrect.mappers.principal_points import (
    axis_turns_deg,
    freed_principal_point_cost,
    gains_of_freedom,
    with_free_principal_points,
    with_shifted_axes,
)
from colmap_affrect.mappers.rigs import COLMAP_MODEL
from colmap_affrect.mappers.search import Search, with_new_images
from colmap_affrect.mappers.some_tracks import model_of_some_tracks
from colmap_affrect.mappers.tie_joining import TieJoiner
from colmap_affrect.parallel.executor import (
    available_cores,
    begin_in_thread,
    map_ordered,
)

# What made a model, in the words of a report.
# Others also verify sides that look the same
MEASURED_PAIRS = "with the pairs of measured frames"
ALL_PAIRS = "with all pairs"
AGAIN = "after pairs were matched again"
PER_IMAGE_CAMERAS = "with a camera for each photograph"
SHIFTED_AXES = "with optical axes off the middle"

# Of COLMAP's models, the largest ones, that are gone on from; resource
NUM_COLMAP_MODELS = 2
# Images of a model with shared cameras that is also adjusted with an axis for each; resource
MAX_OWN_AXES = 12
logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Hypothesis:
    """Which pairs a model is made from."""

    name: str  # in the words of a report
    left_out: Collection[Ids]


class HypothesisTest:
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
        # The model whose images shared cameras, and by what it scored lower
        self.replaced: tuple[pycolmap.Reconstruction, float] | None = None
        # A trial with own cameras that has begun, of the model that is being made
        self.begun: Future[pycolmap.Reconstruction] | None = None
        # The last model that was tried with own cameras, and what these make of it
        self.tried: tuple[pycolmap.Reconstruction, OwnCameras] | None = None
        self._begin_with_cameras_of(task.previous_models)
        self.best = restarted(self.search, task.previous_models)
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
        self._try_own_shifted_axes()
        self._look_at_other_cameras()
        self.best = with_other_groups(self.search, self.best)
        self.best = joined_by_points(self.search, self.best)
        return joined_by_hand(self.search, self.best)

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
            begin_trial = partial(self._begin_trial_with_own_cameras, hypothesis)
            models = model_of_some_tracks(self.search, graph, begin_trial)
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
        if (
            not search.unknown_priors
            or search.graph.has_rigs
            or self.task.previous_models
        ):
            return
        try:
            models = self.by_colmap()
        except AffrectError as error:  # ours stays
            logger.info("%s", error)
            return
        models.sort(key=lambda mapped: -mapped.reconstruction.num_reg_images())
        grower = search.grower(search.graph)
        given = [mapped.reconstruction for mapped in models[:NUM_COLMAP_MODELS]]
        remade = map_ordered(grower.remake, given, available_cores())
        found = [MappedModel(model) for model in remade]
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
        if not self.best or not self.search.unknown_priors:
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

    def _try_own_shifted_axes(self) -> None:
        """Free the principal points of images that seem to share cameras.

        Prints of one size that were cut from photographs in different places share no camera: with
        axes in the middle own ones bring little, and shared ones have no axis to free.
        """
        own = self.per_image
        if own is None or not self.best or own.graph.has_rigs:
            return
        model = self.best[0].reconstruction
        free = with_free_principal_points(own, self.task.cameras)
        if free is None or model.num_reg_images() > MAX_OWN_AXES:
            return
        trial = self._trial_with_own_cameras(own, model)
        if not gains_of_freedom(trial, own, free).contradict_constant:
            return
        apart = own.grower(own.graph).remake(model)
        shared = self.search, self.best
        self.search = own
        first = replace(self.best[0], reconstruction=apart, axis_turns_deg={})
        others = [_remade(own, mapped) for mapped in self.best[1:]]
        self.best = [first.also_by(PER_IMAGE_CAMERAS), *others]
        if self._take_shifted_axes(free):
            self.per_image = None
        else:
            self.search, self.best = shared

    def _trial_with_own_cameras(
        self, own: Search, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Return a model with a camera for each image, made from some of the tracks at least."""
        if self.tried and self.tried[0] is model:
            return self.tried[1].trial
        return trial_with_own_cameras(own, own.graph.thinned(), model)

    def _begin_trial_with_own_cameras(
        self, hypothesis: _Hypothesis, model: pycolmap.Reconstruction
    ) -> None:
        """Try a model with a camera for each image, in a thread, while it gets all points."""
        if self.per_image:
            graph = self.per_image.graph.without(hypothesis.left_out)
            thin = graph.thinned()
            copied = pycolmap.Reconstruction(model)
            self.begun = begin_in_thread(
                partial(trial_with_own_cameras, self.per_image, thin, copied)
            )

    def _take_shifted_axes(self, free: Search) -> bool:
        """Take the best model with free principal points where it scores higher; tell whether."""
        search = self.search
        model = self.best[0].reconstruction
        changed = with_shifted_axes(model, free, search.graph)
        share = self._share_as_modelled(self.best[0])
        first = replace(self.best[0], reconstruction=changed, share_as_modelled=share)
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
        own = with_per_image_cameras(
            per_image=self.per_image,
            graph=graph,
            shared=self.search,
            model=first.reconstruction,
            known=self.begun.result() if self.begun else None,
        )
        self.begun = None
        self.tried = first.reconstruction, own
        model = own.whole
        if model is None:
            return
        score = self.per_image.scorer.score(model)
        if score <= self.score + MIN_SCORE_GAIN:
            return
        self.replaced = first.reconstruction, score - self.score
        share = self._share_as_modelled(first)
        changed = replace(first, reconstruction=model, share_as_modelled=share)
        # The others, too: what is shared and what is not do not fit into one graph.
        others = [_remade(self.per_image, mapped) for mapped in self.best[1:]]
        self.best = with_new_images([changed.also_by(PER_IMAGE_CAMERAS), *others])
        self.search = self.per_image
        self.per_image = None
        self.score = self.search.best_score(self.best)

    def _look_at_other_cameras(self) -> None:
        """Keep of models with shared cameras what own ones make of them, or the reverse."""
        found = list[MappedModel]()
        for mapped in self.best:
            other = self._with_own_cameras(mapped.reconstruction)
            if other is None and self.replaced and not found:
                other = one_camera(mapped.reconstruction, *self.replaced)
            if other is None:
                other = mapped.other_cameras  # of a model that was gone on from
                other = other if other and other.are_shared else None
            found.append(replace(mapped, other_cameras=other))
        self.best = found

    def _with_own_cameras(self, model: pycolmap.Reconstruction) -> OtherCameras | None:
        """Return what own cameras make of a model that shares some; None if it is not tried."""
        if self.per_image is None:
            return None
        if self.tried and self.tried[0] is model and self.tried[1].other:
            return self.tried[1].other
        is_small = model.num_reg_images() <= MAX_OPEN_IMAGES
        if not is_small or has_rigs(model):
            return None
        return own_cameras(model, self.search, self.per_image)

    def _share_as_modelled(self, mapped: MappedModel) -> float:
        """Return the share of what moves as a model says: other cameras may hide the rest."""
        found = share_moving_as_modelled(mapped.reconstruction, self.search.graph)
        return min(found, mapped.share_as_modelled)


def joined_by_hand(search: Search, models: Sequence[MappedModel]) -> list[MappedModel]:
    """Return models with what tie points that were marked by hand join."""
    grower = search.grower(search.graph)
    return TieJoiner(search.adjuster.tie_points, grower, search.scorer).join(models)


def restarted(search: Search, previous: Sequence[MappedModel]) -> list[MappedModel]:
    """Return models with the poses of previous ones, and all that their tracks now register."""
    return with_new_images(_remade(search, one).also_by(AGAIN) for one in previous)


def _remade(search: Search, mapped: MappedModel) -> MappedModel:
    """Return a model with its poses, adjusted with the cameras and pairs of a search."""
    model = search.grower(search.graph).remake(mapped.reconstruction)
    return replace(mapped, reconstruction=model)
