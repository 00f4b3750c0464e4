"""The search for the model with most evidence.

Models grow from several first pairs and, where a focal length is not known, from several of these;
bridges add images to them. One number chooses: how much the verified pairs speak for a model
(:mod:`colmap_affrect.mappers.evidence`).
"""

import math
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import EXIF_SIGMA, MEDIUM, Adjuster, FocalPrior
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.bridging import Bridges
from colmap_affrect.mappers.evidence import MIN_GAIN, Evidence
from colmap_affrect.mappers.growing import Grower, join
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, VerifiedPair, cameras_of
from colmap_affrect.parallel.executor import available_cores, map_ordered

ZOOMS = 1.0, 1.4, 0.7, 2.0
"""Factors of the usual focal length near which unknown ones begin: all lenses from wide to long."""
SHARED_SIGMA = 0.1
"""Deviation of the logarithm of those that several images share, while models grow: two or three of
these images do not tell it."""
SAME_FOCAL = 0.03  # of the logarithm: bridges built with one are right with the other
NUM_STARTS = 3


@dataclass(frozen=True)
class Search:
    """Looks for the models with most evidence."""

    adjuster: Adjuster
    evidence: Evidence
    native: pycolmap.IncrementalPipelineOptions
    num_seeds: int
    show: Callable[[int], None]
    num_starts: int = NUM_STARTS
    """Models from which bridges are built in turn; with 0 there are none, and one try."""

    def grower(self, graph: PairGraph) -> Grower:
        """Return what grows models of a graph."""
        return Grower(graph, self.adjuster, self.native, self.show)

    def evidence_of(self, *models: MappedModel) -> float:
        """Return the evidence of the best of some models."""
        return max((self.evidence.of(model.reconstruction) for model in models), default=0.0)

    def best(self, graph: PairGraph) -> list[MappedModel]:
        """Return the best model, and then the best ones of images that none before has."""
        best, most, grower = list[MappedModel](), -math.inf, self.grower(graph)
        zooms = ZOOMS if self.num_starts else ZOOMS[:1]
        usual = [self._near(zoom) for zoom in zooms] if self._shared else [self]
        left = usual.copy()
        while left:
            near = left.pop(0)
            found = near.joined(graph, near._grown(graph, graph.pairs))
            if not found:
                continue
            model = found[0].reconstruction
            if self.unknown:
                grower.finish(model, MEDIUM)
            agrees = near._agrees(model)  # with other focal lengths, bridges are of wrong length
            evidence = self.evidence.of(model) + MIN_GAIN * agrees
            if evidence > most:
                most, best = evidence, found
                if near in usual and not agrees:
                    left.insert(0, self._as_found(model))
            if self.is_certain(model, graph, agrees=agrees):
                break
        for mapped in best:
            grower.finish(mapped.reconstruction)
        return best

    def beyond(self, graph: PairGraph, known: Sequence[MappedModel]) -> list[MappedModel]:
        """Do so when some are known already; focal lengths stay near those of the first.

        Bridges begin at these, too; others grow from pairs that the first does not explain.
        """
        again = pycolmap.Reconstruction(known[0].reconstruction)
        near = self._as_found(again)
        grower = near.grower(graph)
        grower.finish(again)
        grown = near._grown(graph, graph.unexplained_by(again))
        models = [replace(known[0], reconstruction=again), *known[1:], *grown]
        found = near.joined(graph, sorted(models, key=self.evidence_of, reverse=True))
        for model in found:
            grower.finish(model.reconstruction)
        return found

    def is_certain(
        self, model: pycolmap.Reconstruction, graph: PairGraph, *, agrees: bool = True
    ) -> bool:
        """Tell whether a model has all images that are connected, and pairs or points confirm it.

        That is, no pair contradicts it and its unknown focal lengths are those that it was made
        with, or features of three images confirm it.
        """
        if not graph.most_connected.issubset(model.reg_image_ids()):
            return False
        return (agrees and not graph.contradicted(model)) or self.evidence.is_confirmed(model)

    @cached_property
    def unknown(self) -> dict[int, FocalPrior]:
        """Priors of the cameras that nobody knows, by id."""
        priors = self.adjuster.priors
        return {key: prior for key, prior in priors.items() if prior.sigma > EXIF_SIGMA}

    @cached_property
    def _shared(self) -> set[int]:
        """Cameras that nobody knows and several images share."""
        counts = Counter(camera.camera_id for camera in self.evidence.graph.cameras.values())
        return {key for key in self.unknown if counts[key] > 1}

    def _near(self, zoom: float) -> Self:
        """Return what keeps unknown focal lengths near the usual one times a factor."""
        sigmas = {k: min(SHARED_SIGMA, self.unknown[k].sigma) for k in self._shared}
        near = {
            key: FocalPrior(zoom * prior.focal_px, sigmas.get(key, prior.sigma))
            for key, prior in self.unknown.items()
        }
        return self._with_priors(near)

    def _as_found(self, model: pycolmap.Reconstruction) -> Self:
        """Return what keeps unknown focal lengths near those of a model."""
        focals = self._unknown_focals(model).items()
        return self._with_priors({key: FocalPrior(px, SHARED_SIGMA) for key, px in focals})

    def _with_priors(self, priors: Mapping[int, FocalPrior]) -> Self:
        together = {**self.adjuster.priors, **priors}
        return replace(self, adjuster=replace(self.adjuster, priors=together))

    def _agrees(self, model: pycolmap.Reconstruction) -> bool:
        """Tell whether unknown focal lengths ended near those with which a model was made."""
        return all(
            abs(math.log(focal_px / self.adjuster.priors[key].focal_px)) <= SAME_FOCAL
            for key, focal_px in self._unknown_focals(model).items()
        )

    def _unknown_focals(self, model: pycolmap.Reconstruction) -> dict[int, float]:
        """Return the focal lengths of the used cameras that nobody knows, by id of the camera."""
        used = {camera.camera_id: camera for camera in cameras_of(model).values()}
        return {k: used[k].mean_focal_length() for k in used.keys() & self.unknown.keys()}

    def joined(self, graph: PairGraph, models: Sequence[MappedModel]) -> list[MappedModel]:
        """Return the best model that bridges make of one of some, and those left out of it."""
        if not (models and self.num_starts and graph.unexplained_by(models[0].reconstruction)):
            return list(models[:1])
        grower, bridges = self.grower(graph), Bridges(graph, self.native.random_seed)
        joined = [join(m, bridges, grower, self.evidence) for m in models[: self.num_starts]]
        return with_own_images([max(joined, key=self.evidence_of), *models])

    def _grown(self, graph: PairGraph, first: Sequence[VerifiedPair]) -> list[MappedModel]:
        """Return models of different images from first pairs, that with most evidence first."""
        models: dict[frozenset[int], tuple[float, pycolmap.Reconstruction]] = {}
        best, in_vain = 0.0, 0
        pairs = _as_first_pairs(first, graph)
        with closing(_in_order(self.grower(graph), [pair.ids for pair in pairs])) as grown:
            for model in grown:
                images, evidence = frozenset(model.reg_image_ids()), self.evidence.of(model)
                in_vain = 0 if evidence > best + MIN_GAIN else in_vain + 1
                best = max(best, evidence)
                if images not in models or evidence > models[images][0]:
                    models[images] = evidence, model
                is_complete = len(images) == len(graph.keypoints)
                if in_vain >= self.num_seeds or (is_complete and self.evidence.is_confirmed(model)):
                    break
        return [MappedModel(m) for _, m in sorted(models.values(), key=lambda found: -found[0])]


def _as_first_pairs(pairs: Iterable[VerifiedPair], graph: PairGraph) -> list[VerifiedPair]:
    """Return pairs in the order in which models begin with them.

    Those with most inliers come first, and those of two images that a rig took at once come last:
    cameras of a rig are near to each other, and their poses known beforehand.
    """
    frames = {key: image.frame_id for key, image in graph.cache.images.items()}

    def order(pair: VerifiedPair) -> tuple[bool, int]:
        first, second = pair.ids
        return frames[first] == frames[second], -len(pair.matches)

    return sorted(pairs, key=order)


def with_own_images(models: Iterable[MappedModel]) -> list[MappedModel]:
    """Leave out models with less than two images that none before has."""
    found, inside = list[MappedModel](), set[int]()
    for model in models:
        own = set(model.reconstruction.reg_image_ids())
        if len(own - inside) > 1:
            found.append(model)
            inside |= own
    return found


def _in_order(
    grower: Grower, pairs: Sequence[Ids]
) -> Generator[pycolmap.Reconstruction, None, None]:
    """Yield models that grow from pairs: in threads after the first, which often is enough."""
    yield from filter(None, map(grower.grow, pairs[:1]))
    yield from filter(None, map_ordered(grower.grow, pairs[1:], available_cores()))
