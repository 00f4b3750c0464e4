"""Joining models by their points: those of photographs that both have, and of pairs between them.

Bridges register one photograph by one pair, and of a flat scene no pair may tell its depths. Points
of two models tell their similarity all the same: a feature that both see is one point in each of
them. Whether the whole is right the score decides, by the pairs between both models.
"""

import copy
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import seen_points
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.growing import Grower
from colmap_affrect.mappers.model_score import (
    MIN_SCORE_GAIN,
    ModelScorer,
    pair_log_ratio,
)
from colmap_affrect.mappers.pair_graph import (
    MIN_NUM_MATCHES,
    MIN_SHARE,
    cameras_of,
    poses_of,
    used_cameras,
)
from colmap_affrect.mappers.search import Search
from colmap_affrect.mappers.tie_joining import moved_onto

BY_POINTS = "joined by points of two models"  # in the words of a report


def joined_by_points(
    search: Search, models: Sequence[MappedModel]
) -> list[MappedModel]:
    """Return models, of which those are joined whose points the score lets be one."""
    if len(models) < 2 or search.graph.has_rigs:
        return list(models)
    return PointJoiner(search.grower(search.graph), search.scorer).join(models)


@dataclass(frozen=True)
class PointJoiner:
    """Joins models whose points agree on one similarity."""

    grower: Grower
    scorer: ModelScorer

    def join(self, models: Sequence[MappedModel]) -> list[MappedModel]:
        """Return models of which those are joined that the score is for, in their order."""
        left = list(models)
        found = list[MappedModel]()
        while left:
            mapped = left.pop(0)
            index = 0
            while index < len(left):
                whole = self._joined(mapped, left[index])
                if whole is None:
                    index += 1
                else:
                    mapped = whole
                    left.pop(index)
                    index = 0  # what did not fit before may fit the whole
            found.append(mapped)
        return found

    def _joined(self, first: MappedModel, second: MappedModel) -> MappedModel | None:
        """Return a model of the images of two; None where the score is not for it.

        A model that has no image of its own is left as it is.
        """
        inside = set(first.reconstruction.reg_image_ids())
        if inside.issuperset(second.reconstruction.reg_image_ids()):
            return None
        aligned = self._aligned(first.reconstruction, second.reconstruction)
        if aligned is None:
            return None
        model = copy.deepcopy(first.reconstruction)
        self.grower.register_at(poses_of(aligned), cameras_of(aligned), model)
        self.grower.adjust_fully(model)
        has_all = set(model.reg_image_ids()).issuperset(aligned.reg_image_ids())
        if not has_all:
            return None
        if not self._is_better(model, first, second):
            return None
        hypotheses = dict.fromkeys((*first.hypotheses, BY_POINTS))
        return replace(
            first,
            reconstruction=model,
            bridges={**second.bridges, **first.bridges},
            hypotheses=tuple(hypotheses),
        )

    def _is_better(
        self, whole: pycolmap.Reconstruction, first: MappedModel, second: MappedModel
    ) -> bool:
        """Tell whether the score is for a model with the images of two.

        Pairs between models that have no image in common must speak for it clearly. Where
        they have one, its points tie them, and no pair may speak against it clearly.

        Args:
            whole: The model.
            first: One part.
            second: The other one. What is said of common images and cameras counts once.
        """
        score = self.scorer.score
        common = set(first.reconstruction.reg_image_ids())
        common.intersection_update(second.reconstruction.reg_image_ids())
        cameras = used_cameras(second.reconstruction)
        shared = cameras.keys() & used_cameras(first.reconstruction).keys()
        of_parts = score(first.reconstruction) + score(second.reconstruction)
        of_parts -= self._said_of(second.reconstruction, common)
        for key in sorted(shared):
            of_parts += self.scorer.priors[key].cost_of(cameras[key])
        least = -MIN_SCORE_GAIN if common else MIN_SCORE_GAIN
        return score(whole) - of_parts > least

    def _said_of(self, model: pycolmap.Reconstruction, image_ids: Set[int]) -> float:
        """Return what some images of a model, and pairs among them, add to its score."""
        ratios = self.scorer.track_log_ratios(model)
        total = sum(ratios[image_id] for image_id in image_ids & ratios.keys())
        graph = self.scorer.graph
        poses = poses_of(model)
        cameras = cameras_of(model)
        for pair in graph.pairs_inside(image_ids):
            num = self.scorer.num_cells(pair)
            num_agreeing = graph.agreement(pair, poses, cameras) * num
            total += pair_log_ratio(num_agreeing, num)
        return total

    def _aligned(
        self, first: pycolmap.Reconstruction, second: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction | None:
        """Return a copy of a model, moved to where its points are in another one.

        Args:
            first: The model to move it to.
            second: The model to move.

        Returns:
            The copy; None where too few points agree on a similarity.
        """
        common = self._common_points(first, second)
        if len(common) < MIN_NUM_MATCHES:
            return None
        return moved_onto(
            second,
            source=_positions(second, common[:, 1]),
            target=_positions(first, common[:, 0]),
            min_num_inliers=max(MIN_NUM_MATCHES, MIN_SHARE * len(common)),
            random_seed=self.grower.native.random_seed,
        )

    def _common_points(
        self, first: pycolmap.Reconstruction, second: pycolmap.Reconstruction
    ) -> Indices:
        """Return the ids of points of two models that are the same, (N, 2).

        A feature of a common image sees one point in each; a match of a pair between both models
        ties one of each.
        """
        of_first = {i: seen_points(first.images[i]) for i in first.reg_image_ids()}
        of_second = {i: seen_points(second.images[i]) for i in second.reg_image_ids()}
        both = list[Indices]()
        for image_id in sorted(of_first.keys() & of_second.keys()):
            seen = of_first[image_id], of_second[image_id]
            both.append(np.stack(seen, axis=1))
        for pair in self.scorer.graph.verified:
            one, two = pair.ids
            features1, features2 = pair.matches.T
            if one in of_first and two in of_second:
                ids = of_first[one][features1], of_second[two][features2]
                both.append(np.stack(ids, axis=1))
            if two in of_first and one in of_second:
                ids = of_first[two][features2], of_second[one][features1]
                both.append(np.stack(ids, axis=1))
        if not both:
            return np.zeros((0, 2), np.int64)
        together = np.concatenate(both)
        is_seen = (together >= 0).all(axis=1)
        return np.unique(together[is_seen], axis=0)


def _positions(model: pycolmap.Reconstruction, point_ids: Indices) -> Array:
    return np.array([model.points3D[int(i)].xyz for i in point_ids], np.float64)
