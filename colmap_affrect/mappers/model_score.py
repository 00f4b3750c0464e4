"""The score of a model: log-likelihood ratio of its inliers, plus the priors of its cameras.

A verified pair whose images are both in the model says how many of its inliers agree with their
poses. Pairs alone leave scales and focal lengths open, so a feature that is matched in two other
images says whether one point explains all three. The likelihood of such a count is a beta-binomial
distribution, one for right models and one for wrong ones. The score adds the logarithms of their
ratios, which allow for pairs that are wrong themselves, and subtracts the costs of focal lengths
and principal points.
More images that agree raise the score; images that agree with nothing do not.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import seen_points
from colmap_affrect.geometry.arrays import Floats, Indices
from colmap_affrect.mappers.camera_priors import CameraPrior
from colmap_affrect.mappers.pair_graph import (
    Ids,
    PairGraph,
    VerifiedPair,
    cameras_of,
    num_matched_images,
    poses_of,
    used_cameras,
)


@dataclass(frozen=True)
class Beta:
    """A beta distribution of the share of matches that agree."""

    alpha: float
    beta: float


# Judged on models of the benchmark scenes whose poses are known, right and wrong.
# Cells on a side of an image: features in one cell err together and count once
GRID = 8
# Inliers of a pair with right poses, 93 per cent on average; measured
RIGHT_PAIR = Beta(14.0, 1.0)
# Features of three images of a right model, 75 per cent; measured
RIGHT_TRACKS = Beta(6.0, 2.0)
CHANCE = Beta(2.0, 4.0)  # both of wrong models, a third; measured
WRONG_PAIR = 0.05  # probability that a verified pair is wrong; judged
# Log-likelihood ratio, twenty to one, by which a score is clearly higher; theory
MIN_SCORE_GAIN = 3.0


@dataclass(frozen=True)
class ModelScorer:
    """Scores models of one database."""

    graph: PairGraph
    priors: Mapping[int, CameraPrior]  # by camera id
    _num_cells: dict[Ids, int] = field(default_factory=dict, init=False, repr=False)

    def score(self, model: pycolmap.Reconstruction) -> float:
        """Return the score of a model, a log-likelihood ratio."""
        poses = poses_of(model)
        cameras = cameras_of(model)
        total = sum(self.track_log_ratios(model).values())
        for pair in self.graph.pairs_inside(poses):
            num = self.num_cells(pair)
            num_agreeing = self.graph.agreement(pair, poses, cameras) * num
            total += pair_log_ratio(num_agreeing, num)
        cost = 0.0
        for key, camera in used_cameras(model).items():
            cost += self.priors[key].cost_of(camera)
        return total - cost

    def is_confirmed(self, model: pycolmap.Reconstruction) -> bool:
        """Tell whether tracks of three images confirm each image of a model."""
        log_ratios = self.track_log_ratios(model).values()
        return min(log_ratios, default=MIN_SCORE_GAIN) >= MIN_SCORE_GAIN

    def track_log_ratios(
        self,
        model: pycolmap.Reconstruction,
        viewpoint_of: Mapping[int, int] | None = None,
    ) -> dict[int, float]:
        """Return the log-likelihood ratio of each image's features that two others match.

        What is counted are the cells of a grid on the image that hold such features. The share of
        them that counts as right is that of the features whose point three images see.

        Args:
            model: The model.
            viewpoint_of: Of images from the same viewpoint, which count as one, a common number
                by image id; others have none.

        Returns:
            The ratios, by image id.
        """
        viewpoint_of = viewpoint_of or {}
        num_partners = self._num_partners(model, viewpoint_of)
        points = {i: seen_points(model.images[i]) for i in num_partners}
        long_tracks = _seen_by_three(points, viewpoint_of)
        log_ratios = {}
        for image_id, number in num_partners.items():
            features = np.flatnonzero(number > 1)
            keypoints = self.graph.keypoints[image_id][features]
            num = num_occupied_cells(self.graph.cameras[image_id], keypoints)
            is_long = np.isin(points[image_id][features], long_tracks)
            share = is_long.mean() if num else 0.0
            log_ratios[image_id] = _log_ratio(float(share * num), num, RIGHT_TRACKS)
        return log_ratios

    def num_cells(self, pair: VerifiedPair) -> int:
        """Return how many cells hold inliers, in that image of a pair which has fewer."""
        if pair.ids not in self._num_cells:
            first, second = pair.ids
            points1, points2 = self.graph.points(pair)
            num_cells1 = num_occupied_cells(self.graph.cameras[first], points1)
            num_cells2 = num_occupied_cells(self.graph.cameras[second], points2)
            self._num_cells[pair.ids] = min(num_cells1, num_cells2)
        return self._num_cells[pair.ids]

    def _num_partners(
        self, model: pycolmap.Reconstruction, viewpoint_of: Mapping[int, int]
    ) -> dict[int, Indices]:
        """Return in how many other images of the model each feature is matched, by image id."""
        inside = sorted(self.graph.keypoints.keys() & set(model.reg_image_ids()))
        num_keypoints = {i: len(self.graph.keypoints[i]) for i in inside}
        pairs = self.graph.pairs_inside(inside)
        return num_matched_images(num_keypoints, pairs, viewpoint_of)


def grid_cells(camera: pycolmap.Camera, points: Floats) -> Indices:
    """Return the number of the cell of a grid over an image that holds each point, (N,).

    Args:
        camera: Of the image.
        points: (N, 2) px; those outside of the image are of the nearest cell.
    """
    cells = (points / [camera.width, camera.height] * GRID).astype(np.int64)
    return np.asarray(np.clip(cells, 0, GRID - 1) @ [1, GRID])


def num_occupied_cells(camera: pycolmap.Camera, points: Floats) -> int:
    """Return how many cells of a grid over an image hold points, (N, 2) px."""
    cells = grid_cells(camera, points)
    return int(np.count_nonzero(np.bincount(cells, minlength=GRID * GRID)))


def pair_log_ratio(num_agreeing: float, num: float) -> float:
    """Return the log-likelihood ratio of right poses against wrong ones, by one pair.

    >>> pair_log_ratio(30, 30) > pair_log_ratio(10, 10) > 0 > pair_log_ratio(5, 30) > -3.1
    True
    """
    if_sound = math.log(1.0 - WRONG_PAIR) + _log_ratio(num_agreeing, num, RIGHT_PAIR)
    if_wrong = math.log(WRONG_PAIR)
    return float(np.logaddexp(if_sound, if_wrong))


def _seen_by_three(
    points: Mapping[int, Indices], viewpoint_of: Mapping[int, int]
) -> Indices:
    """Return the ids of the points that images from three viewpoints or more see.

    Args:
        points: Ids of the points by keypoint, -1 of none, by image id.
        viewpoint_of: As :meth:`ModelScorer.track_log_ratios` takes it.
    """
    seen = list[Indices]()
    seen_from = defaultdict[int, list[Indices]](list)
    for image_id, ids in points.items():
        if image_id in viewpoint_of:
            seen_from[viewpoint_of[image_id]].append(ids)
        else:
            seen.append(np.unique(ids))  # a point may have two keypoints of an image
    for of_images in seen_from.values():
        seen.append(np.unique(np.concatenate(of_images)))
    none_seen = [-1]
    all_seen = np.concatenate([*seen, none_seen])
    ids, num_viewpoints = np.unique(all_seen, return_counts=True)
    is_point = ids >= 0
    return np.asarray(ids[is_point & (num_viewpoints > 2)])


def _log_ratio(num_agreeing: float, num: float, right: Beta) -> float:
    """Return the log-likelihood ratio of right models against wrong ones."""
    return beta_log_ratio(num_agreeing, num, right, CHANCE)


def beta_log_ratio(num_agreeing: float, num: float, right: Beta, wrong: Beta) -> float:
    """Return the log-likelihood ratio of two distributions of a count.

    Args:
        num_agreeing: The count.
        num: Of so many.
        right: Of shares, if right.
        wrong: Of shares, if wrong.
    """
    by_right = _log_beta_binomial(num_agreeing, num, right)
    return by_right - _log_beta_binomial(num_agreeing, num, wrong)


def _log_beta_binomial(num_agreeing: float, num: float, prior: Beta) -> float:
    """Return the log probability of a count, but for the binomial coefficient."""
    posterior = Beta(num_agreeing + prior.alpha, num - num_agreeing + prior.beta)
    return _log_beta(posterior) - _log_beta(prior)


def _log_beta(shape: Beta) -> float:
    """Return the logarithm of the beta function."""
    both = math.lgamma(shape.alpha) + math.lgamma(shape.beta)
    return both - math.lgamma(shape.alpha + shape.beta)
