"""The search for the model with the highest score.

Models grow from several first pairs and, where a focal length is unknown, from several values of
it; bridges add images to them. One number decides: the score of a model
(:mod:`colmap_affrect.mappers.model_score`).
"""

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FINAL, MEDIUM, Adjuster
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import BridgeFinder
from colmap_affrect.mappers.camera_priors import CameraPrior
from colmap_affrect.mappers.distortion import straighten
from colmap_affrect.mappers.focal_observability import with_fewer_points
from colmap_affrect.mappers.growing import Grower, register_bridges
from colmap_affrect.mappers.model_score import MIN_SCORE_GAIN, ModelScorer
from colmap_affrect.mappers.pair_graph import (
    Ids,
    PairGraph,
    VerifiedPair,
    used_cameras,
)
from colmap_affrect.parallel.executor import available_cores, map_ordered

SHARED_SIGMA = 0.1
"""Deviation of the logarithm of a focal length that several images share, while models grow
(judged): two or three of these images do not tell it."""
SAME_FOCAL = 0.03
"""Largest difference of the logarithms of two focal lengths, of which bridges that were built with
one are right with the other (judged)."""
NUM_BRIDGED_MODELS = 3  # models from which bridges are built in turn (resource)


@dataclass(frozen=True)
class _Attempt:
    """Models that a search has made with some focal lengths."""

    models: list[MappedModel]  # best first
    score: float  # of the first
    focals_agree: (
        bool  # its unknown focal lengths ended near those that it was made with
    )


@dataclass(frozen=True)
class Search:
    """Looks for the models with the highest scores."""

    # Its priors may be those of one trial, which holds unknown focal lengths near a value
    adjuster: Adjuster
    # Its priors are what is known of the cameras, the same in all trials, so that scores compare
    scorer: ModelScorer
    native: pycolmap.IncrementalPipelineOptions
    max_models_without_gain: int  # in a row, after which no others are grown
    show: Callable[[int], None]  # is told how many images a model has
    num_bridged_models: int = NUM_BRIDGED_MODELS  # from which bridges are built in turn
    # otherwise images that tracks do not register are left out
    builds_bridges: bool = True
    # otherwise models begin with the likeliest focal lengths alone
    tries_focals: bool = True

    @property
    def graph(self) -> PairGraph:
        """All pairs, by which models are scored."""
        return self.scorer.graph

    def grower(self, graph: PairGraph) -> Grower:
        """Return what grows models of a graph."""
        return Grower(graph, self.adjuster, self.native, self.show)

    def best_score(self, models: Iterable[MappedModel]) -> float:
        """Return the score of the best of some models, 0 where there are none.

        Chance explains the pairs of a model that scores 0 as well as its poses do. So a model
        that another mapper made must score more where the search has found none.
        """
        scores = [self.scorer.score(mapped.reconstruction) for mapped in models]
        return max(scores, default=0.0)

    def best(self, graph: PairGraph) -> list[MappedModel]:
        """Return the best model, then the best ones of images that none before has."""
        best = _Attempt([], -math.inf, focals_agree=False)
        initial = self._with_initial_focals()
        pending = list(initial)
        while pending:
            search = pending.pop(0)
            attempt = self._attempt(search, graph)
            if not attempt.models:
                continue
            model = attempt.models[0].reconstruction
            if attempt.score > best.score:
                best = attempt
                lacks_bridges = self._lacks_bridges(search, graph, model)
                if search in initial and (lacks_bridges or not attempt.focals_agree):
                    pending.insert(0, self._with_focals_of(model))
            if self.is_certain(model, graph, focals_agree=attempt.focals_agree):
                break
        _adjust_fully(self.grower(graph), best.models)
        return best.models

    def _lacks_bridges(
        self, search: Self, graph: PairGraph, model: pycolmap.Reconstruction
    ) -> bool:
        """Tell whether bridges may improve a model that another search made without them."""
        if search.builds_bridges or not self.builds_bridges:
            return False
        return bool(graph.unexplained_by(model))

    def extend_models(
        self, graph: PairGraph, known: Sequence[MappedModel]
    ) -> list[MappedModel]:
        """Return the best models of a graph of which some models are known already.

        Focal lengths stay near those of the first one. Bridges begin at the known models, too;
        other models grow from pairs that the first one does not explain.

        Args:
            graph: The pairs.
            known: The known models, best first; they stay as they are.
        """
        first = pycolmap.Reconstruction(known[0].reconstruction)
        search = self._with_focals_of(first)
        grower = search.grower(graph)
        grower.adjust_fully(first)
        grown = search._grown(graph, graph.unexplained_by(first))
        models = [replace(known[0], reconstruction=first)]
        for mapped in known[1:]:
            copied = pycolmap.Reconstruction(mapped.reconstruction)
            models.append(replace(mapped, reconstruction=copied))
        models += grown
        models.sort(key=self._score, reverse=True)
        found = search.with_bridges(graph, models)
        _adjust_fully(grower, found)
        return found

    def with_bridges(
        self, graph: PairGraph, models: Sequence[MappedModel]
    ) -> list[MappedModel]:
        """Register images by bridges from the best models.

        Args:
            graph: Pairs that bridges are built by.
            models: The models, best first; they stay as they are.

        Returns:
            The model with the highest score, and those models that have other images.
        """
        if not models:
            return []
        if not graph.unexplained_by(models[0].reconstruction):
            return [models[0]]
        if not self.builds_bridges:
            return with_new_images(models)
        grower = self.grower(graph)

        def with_own_bridges(mapped: MappedModel) -> MappedModel:
            # What a finder keeps is of the cameras that asked first
            bridges = BridgeFinder(graph, self.adjuster, self.native.random_seed)
            return register_bridges(mapped, bridges, grower, self.scorer)

        first_models = models[: self.num_bridged_models]
        joined = map_ordered(with_own_bridges, first_models, available_cores())
        return with_new_images([max(joined, key=self._score), *models])

    def is_certain(
        self,
        model: pycolmap.Reconstruction,
        graph: PairGraph,
        *,
        focals_agree: bool = True,
    ) -> bool:
        """Tell whether a model has all connected images, and pairs or tracks confirm it.

        Args:
            model: The model in question.
            graph: Pairs that it should explain.
            focals_agree: Whether its unknown focal lengths are those that it was made with.

        Returns:
            Whether no pair contradicts it and its focal lengths agree, or tracks of three images
            confirm each image.
        """
        inside = set(model.reg_image_ids())
        has_all = inside.issuperset(graph.keypoints)
        if not has_all and not inside.issuperset(graph.largest_component):
            return False
        return (
            focals_agree and not graph.contradicted(model)
        ) or self.scorer.is_confirmed(model)

    def from_straight_lens(
        self, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        """Return a model, adjusted from a straight lens where its distortion is a trap.

        While a model has few images, distortion makes up for what is wrong of focal lengths and
        poses, and adjustments do not find back: of four of five models of Sacre Coeur costs are 45
        to 110 nats lower from a straight lens, and poses off by 0.9 degrees instead of 1.3 to 3.
        Where the cost of the same points is lower and the score not, that is the better optimum.

        Args:
            model: It stays as it is.
        """
        as_it_is, straight = self.costs_of_starts(model)
        if straight >= as_it_is - MIN_SCORE_GAIN:
            return model
        changed = pycolmap.Reconstruction(model)
        straighten(changed, self.adjuster.priors)
        self.grower(self.graph).adjust_fully(changed)
        gain = self.scorer.score(changed) - self.scorer.score(model)
        return changed if gain > -MIN_SCORE_GAIN else model

    def costs_of_starts(self, model: pycolmap.Reconstruction) -> tuple[float, float]:
        """Return the costs of a model that is adjusted as it is, and from a straight lens.

        Args:
            model: It stays as it is; some of its points are adjusted.
        """
        as_it_is = with_fewer_points(model)
        straight = pycolmap.Reconstruction(as_it_is)
        was_bent = straighten(straight, self.adjuster.priors)
        adjuster = self.comparing().adjuster
        models = [as_it_is, straight] if was_bent else [as_it_is]
        adjusted = map_ordered(
            lambda one: adjuster.adjust(one, FINAL), models, available_cores()
        )
        costs = list(adjusted)
        return costs[0], costs[-1]

    def comparing(self) -> Self:
        """Return a search for models that are only compared: adjustments end earlier."""
        return replace(self, adjuster=replace(self.adjuster, compares_only=True))

    @cached_property
    def unknown_priors(self) -> dict[int, CameraPrior]:
        """Priors of the unknown focal lengths, by camera id."""
        priors = self.adjuster.priors
        return {
            key: prior
            for key, prior in priors.items()
            if not prior.has_prior_focal_length
        }

    @cached_property
    def _shared(self) -> set[int]:
        """Cameras with an unknown focal length that several images share."""
        counts = Counter(camera.camera_id for camera in self.graph.cameras.values())
        return {key for key in self.unknown_priors if counts[key] > 1}

    def _score(self, mapped: MappedModel) -> float:
        return self.scorer.score(mapped.reconstruction)

    def _with_initial_focals(self) -> list[Self]:
        """Return searches with several values of unknown focal lengths, the likeliest first.

        Where no images share a camera, only the first one builds bridges, to save time; another
        one that wins is repeated with bridges.
        """
        numbers = [len(prior.starts_px) for prior in self.unknown_priors.values()]
        searches = [self._with_start(0)]
        if self.tries_focals:
            for number in range(1, max(numbers, default=1)):
                search = self._with_start(number)
                if not self._shared:
                    search = replace(search, builds_bridges=False)
                searches.append(search)
        return searches

    def _with_start(self, number: int) -> Self:
        """Return a search whose unknown focal lengths begin at one of their starts, or the last."""
        priors = {}
        for key, prior in self.unknown_priors.items():
            sigma = (
                min(SHARED_SIGMA, prior.sigma) if key in self._shared else prior.sigma
            )
            priors[key] = replace(
                prior,
                focal_px=prior.starts_px[min(number, len(prior.starts_px) - 1)],
                sigma=sigma,
            )
        return self._adjusting_with(priors)

    def _with_focals_of(self, model: pycolmap.Reconstruction) -> Self:
        """Return a search that keeps unknown focal lengths near those of a model."""
        priors = {}
        for key, focal_px in self._unknown_focals(model).items():
            priors[key] = replace(
                self.unknown_priors[key], focal_px=focal_px, sigma=SHARED_SIGMA
            )
        return self._adjusting_with(priors)

    def _adjusting_with(self, priors: Mapping[int, CameraPrior]) -> Self:
        """Return a search that adjusts with other priors of some cameras, and scores as before."""
        together = {**self.adjuster.priors, **priors}
        return replace(self, adjuster=replace(self.adjuster, priors=together))

    def _attempt(self, search: Self, graph: PairGraph) -> _Attempt:
        """Grow models with the focal lengths of another search; then these may change."""
        found = search.with_bridges(graph, search._grown(graph, graph.pairs))
        if not found:
            return _Attempt([], -math.inf, focals_agree=False)
        model = found[0].reconstruction
        if self.unknown_priors:
            self.grower(graph).adjust_fully(model, MEDIUM)
        focals_agree = search._focals_agree(model)
        score = self.scorer.score(model)
        if focals_agree:  # with other focal lengths, bridges have a wrong length
            score += MIN_SCORE_GAIN
        return _Attempt(models=found, score=score, focals_agree=focals_agree)

    def _focals_agree(self, model: pycolmap.Reconstruction) -> bool:
        """Tell whether unknown focal lengths ended near those with which a model was made."""
        for key, focal_px in self._unknown_focals(model).items():
            change = math.log(focal_px / self.adjuster.priors[key].focal_px)
            if abs(change) > SAME_FOCAL:
                return False
        return True

    def _unknown_focals(self, model: pycolmap.Reconstruction) -> dict[int, float]:
        """Return the focal lengths of the used cameras whose prior is unknown, by camera id."""
        used = used_cameras(model)
        return {
            k: used[k].mean_focal_length()
            for k in used.keys() & self.unknown_priors.keys()
        }

    def _grown(
        self, graph: PairGraph, first: Sequence[VerifiedPair]
    ) -> list[MappedModel]:
        """Return models of different images from first pairs, the highest score first."""
        best = _BestModels(self.scorer)
        pairs = [pair.ids for pair in first_pairs(first, graph)]
        num_failed = 0
        with closing(_grow_in_order(self.grower(graph), pairs)) as grown:
            for model in grown:
                if model is None:
                    num_failed += 1
                    if num_failed >= self.native.init_num_trials:
                        break
                    continue
                num_failed = 0
                best.add(model)
                if best.num_without_gain >= self.max_models_without_gain:
                    break
                is_complete = model.num_reg_images() == len(graph.keypoints)
                if is_complete and self.scorer.is_confirmed(model):
                    break
        return best.ranked()


def _adjust_fully(grower: Grower, models: Iterable[MappedModel]) -> None:
    """Adjust models in threads until they converge."""
    reconstructions = [mapped.reconstruction for mapped in models]
    for _ in map_ordered(grower.adjust_fully, reconstructions, available_cores()):
        pass


class _BestModels:
    """The model with the highest score of each set of images that models have."""

    def __init__(self, scorer: ModelScorer) -> None:
        self.scorer = scorer
        # Models in a row that scored no higher than all before
        self.num_without_gain = 0
        self._best_score = 0.0
        self._models: dict[frozenset[int], pycolmap.Reconstruction] = {}
        self._scores: dict[frozenset[int], float] = {}

    def add(self, model: pycolmap.Reconstruction) -> None:
        """Take a model, in the place of one of the same images that scores lower."""
        score = self.scorer.score(model)
        if score > self._best_score + MIN_SCORE_GAIN:
            self.num_without_gain = 0
        else:
            self.num_without_gain += 1
        self._best_score = max(self._best_score, score)
        images = frozenset(model.reg_image_ids())
        if images not in self._models or score > self._scores[images]:
            self._models[images] = model
            self._scores[images] = score

    def ranked(self) -> list[MappedModel]:
        """Return the models, the highest score first."""
        ranked = sorted(self._models, key=lambda images: -self._scores[images])
        return [MappedModel(self._models[images]) for images in ranked]


def first_pairs(pairs: Iterable[VerifiedPair], graph: PairGraph) -> list[VerifiedPair]:
    """Return pairs in the order in which models begin with them.

    Those with most inliers come first, and those of two images that a rig took at once come last:
    cameras of a rig are near to each other, and their poses known beforehand.
    """
    frames = {key: image.frame_id for key, image in graph.cache.images.items()}

    def order(pair: VerifiedPair) -> tuple[bool, int]:
        first, second = pair.ids
        return frames[first] == frames[second], -len(pair.matches)

    return sorted(pairs, key=order)


def with_new_images(models: Iterable[MappedModel]) -> list[MappedModel]:
    """Leave out models with less than two images that none before has."""
    found = list[MappedModel]()
    inside = set[int]()
    for model in models:
        own = set(model.reconstruction.reg_image_ids())
        if len(own - inside) > 1:
            found.append(model)
            inside |= own
    return found


def _grow_in_order(
    grower: Grower, pairs: Sequence[Ids]
) -> Generator[pycolmap.Reconstruction | None, None, None]:
    """Yield models that grow from pairs, None of one that makes none.

    They grow in threads after the first model, which often is enough. Those that nobody asks for
    any more end unfinished.
    """
    num_tried = 0
    model = None
    while model is None and num_tried < len(pairs):
        model = grower.grow(pairs[num_tried])
        num_tried += 1
        yield model
    others = map_ordered(grower.grow, pairs[num_tried:], available_cores())
    try:
        for model in others:  # `yield from` would wait for them before it stops them
            yield model
    finally:
        grower.stop()
        others.close()
