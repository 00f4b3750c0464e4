"""How much the verified pairs and what is known of the cameras speak for a model, in nats.

A pair whose images are both in the model says how many of its inliers agree with their poses. The
likelihood of that count is a beta-binomial distribution, one for right poses and one for wrong
ones; their ratio, and the chance that the pair itself is wrong, make its evidence. A pair that is
not in the model adds nothing: more images that agree are more evidence.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.adjustment import FocalPrior
from colmap_affrect.mappers.pair_graph import PairGraph, VerifiedPair, cameras_of, poses_of

GRID = 8  # cells on a side of an image: inliers in one cell err together and count once
RIGHT, CHANCE = (14.0, 1.0), (2.0, 4.0)
"""Beta distributions of the share of inliers that agree with right poses (93 per cent on average)
and with wrong ones (a third)."""
WRONG_PAIR = 0.05  # chance that a verified pair is wrong
MIN_GAIN = 3.0  # nats, twenty to one: what a model must have more to be taken


@dataclass(frozen=True)
class Evidence:
    """Measures models of one database."""

    graph: PairGraph
    priors: Mapping[int, FocalPrior]  # by camera id

    def of(self, model: pycolmap.Reconstruction) -> float:
        """Return the evidence of a model."""
        poses, cameras = poses_of(model), cameras_of(model)
        total = 0.0
        for pair in self.graph.pairs_inside(poses):
            num = self.num_cells(pair)
            total += pair_evidence(self.graph.agreement(pair, poses, cameras) * num, num)
        used = {camera.camera_id: camera for camera in cameras.values()}
        costs = (self.priors[key].cost(camera.mean_focal_length()) for key, camera in used.items())
        return total - sum(costs)

    def of_best(self, models: Iterable[pycolmap.Reconstruction]) -> float:
        """Return the evidence of the best of some models, 0 without any."""
        return max(map(self.of, models), default=0.0)

    def num_cells(self, pair: VerifiedPair) -> int:
        """Return how many cells of a grid over an image hold inliers, in that which has fewer."""
        counts = []
        for image_id, points in zip(pair.ids, self.graph.points(pair), strict=True):
            camera = self.graph.cameras[image_id]
            cells = (points / [camera.width, camera.height] * GRID).astype(int)
            counts.append(len(np.unique(np.clip(cells, 0, GRID - 1) @ [1, GRID])))
        return min(counts)


def pair_evidence(num_agreeing: float, num: float) -> float:
    """Return the log-likelihood ratio of right poses against wrong ones, by one pair.

    >>> pair_evidence(30, 30) > pair_evidence(10, 10) > 0 > pair_evidence(5, 30) > -3.1
    True
    """
    ratio = _log_beta_binomial(num_agreeing, num, RIGHT)
    ratio -= _log_beta_binomial(num_agreeing, num, CHANCE)
    return float(np.logaddexp(math.log(1.0 - WRONG_PAIR) + ratio, math.log(WRONG_PAIR)))


def _log_beta_binomial(count: float, total: float, shape: tuple[float, float]) -> float:
    """Return the log probability of a count, but for the binomial coefficient."""
    return _log_beta(count + shape[0], total - count + shape[1]) - _log_beta(*shape)


def _log_beta(first: float, second: float) -> float:
    return math.lgamma(first) + math.lgamma(second) - math.lgamma(first + second)
