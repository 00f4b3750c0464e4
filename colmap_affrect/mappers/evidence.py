"""How much the verified pairs and what is known of the cameras speak for a model, in nats.

A pair whose images are both in the model says how many of its inliers agree with their poses. Pairs
alone leave scales and focal lengths open; so a feature that is matched in two other images says
whether one point explains all three. The likelihood of such a count is a beta-binomial
distribution, one for right models and one for wrong ones; their ratio, and the chance that the
pair itself is wrong, make the evidence. More images that agree are more evidence; others, none.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import seen_points
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.mappers.adjustment import FocalPrior
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, VerifiedPair, cameras_of, poses_of

GRID = 8  # cells on a side of an image: features in one cell err together and count once
RIGHT, RIGHT_OF_THREE, CHANCE = (14.0, 1.0), (6.0, 2.0), (2.0, 4.0)
"""Beta distributions of the share that agrees with right models, of the inliers of pairs (93 per
cent on average) and of the features of three images (75), and with wrong ones (a third)."""
WRONG_PAIR = 0.05  # chance that a verified pair is wrong
MIN_GAIN = 3.0  # nats, twenty to one: what a model must have more to be taken


@dataclass(frozen=True)
class Evidence:
    """Measures models of one database."""

    graph: PairGraph
    priors: Mapping[int, FocalPrior]  # by camera id
    _num_cells: dict[Ids, int] = field(default_factory=dict, init=False, repr=False)

    def of(self, model: pycolmap.Reconstruction) -> float:
        """Return the evidence of a model."""
        poses, cameras = poses_of(model), cameras_of(model)
        total = sum(self.three_view_ratios(model).values())
        for pair in self.graph.pairs_inside(poses):
            num = self.num_cells(pair)
            total += pair_evidence(self.graph.agreement(pair, poses, cameras) * num, num)
        used = {camera.camera_id: camera for camera in cameras.values()}
        costs = (self.priors[key].cost(camera.mean_focal_length()) for key, camera in used.items())
        return total - sum(costs)

    def is_confirmed(self, model: pycolmap.Reconstruction) -> bool:
        """Tell whether features of three images confirm each image of a model."""
        return min(self.three_view_ratios(model).values(), default=MIN_GAIN) >= MIN_GAIN

    def three_view_ratios(self, model: pycolmap.Reconstruction) -> dict[int, float]:
        """Return the log-likelihood ratio of each image's features that two others match.

        Cells of the image that hold such features count as often as is the share of these that are
        in a point which three images see.
        """
        inside = self.graph.keypoints.keys() & set(model.reg_image_ids())
        partners = {i: np.zeros(len(self.graph.keypoints[i]), np.int64) for i in sorted(inside)}
        for pair in self.graph.pairs_inside(partners):
            for image_id, features in zip(pair.ids, pair.matches.T, strict=True):
                partners[image_id][np.unique(features)] += 1
        points = {image_id: seen_points(model.images[image_id]) for image_id in partners}
        ids, lengths = np.unique(np.concatenate([*points.values(), [-1]]), return_counts=True)
        long = ids[(lengths > 2) & (ids >= 0)]
        ratios = {}
        for image_id, number in partners.items():
            features = np.flatnonzero(number > 1)
            num = cells(self.graph.cameras[image_id], self.graph.keypoints[image_id][features])
            share = np.isin(points[image_id][features], long).mean() if num else 0.0
            ratios[image_id] = _log_ratio(float(share * num), num, RIGHT_OF_THREE)
        return ratios

    def num_cells(self, pair: VerifiedPair) -> int:
        """Return how many cells hold inliers, in that image of a pair which has fewer."""
        if pair.ids not in self._num_cells:
            both = zip(pair.ids, self.graph.points(pair), strict=True)
            counts = [cells(self.graph.cameras[image_id], points) for image_id, points in both]
            self._num_cells[pair.ids] = min(counts)
        return self._num_cells[pair.ids]


def cells(camera: pycolmap.Camera, points: Floats) -> int:
    """Return how many cells of a grid over an image hold points, (N, 2) px."""
    numbers = (points / [camera.width, camera.height] * GRID).astype(int)
    return len(np.unique(np.clip(numbers, 0, GRID - 1) @ [1, GRID]))


def pair_evidence(num_agreeing: float, num: float) -> float:
    """Return the log-likelihood ratio of right poses against wrong ones, by one pair.

    >>> pair_evidence(30, 30) > pair_evidence(10, 10) > 0 > pair_evidence(5, 30) > -3.1
    True
    """
    ratio = _log_ratio(num_agreeing, num, RIGHT)
    return float(np.logaddexp(math.log(1.0 - WRONG_PAIR) + ratio, math.log(WRONG_PAIR)))


def _log_ratio(count: float, total: float, right: tuple[float, float]) -> float:
    """Return the log-likelihood ratio of a share of right models against one by chance."""
    return _log_beta_binomial(count, total, right) - _log_beta_binomial(count, total, CHANCE)


def _log_beta_binomial(count: float, total: float, shape: tuple[float, float]) -> float:
    """Return the log probability of a count, but for the binomial coefficient."""
    return _log_beta(count + shape[0], total - count + shape[1]) - _log_beta(*shape)


def _log_beta(first: float, second: float) -> float:
    return math.lgamma(first) + math.lgamma(second) - math.lgamma(first + second)
