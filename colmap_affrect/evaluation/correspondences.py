"""Epipolar geometry of matches, scored by correspondences that were marked by hand (WxBS)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_affrect.conventions import is_inside
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import PairScore
from colmap_affrect.extraction import extract_image
from colmap_affrect.imaging import read_gray
from colmap_affrect.matching.nearest import match_features, matchable
from colmap_affrect.recipes import load_recipe

Points = NDArray[np.float64]
FundamentalMatrix = NDArray[np.float64]

MIN_MATCHES = 8

WXBS_THRESHOLDS_PX = tuple(range(20))
"""The score of WxBS is the mean over these of the share of correspondences that agree."""

SHOWN_THRESHOLDS_PX = (1, 2, 3, 5, 10, 20)

CHECK_RECIPE = "unrectified-rootsift"
CHECK_NOISE_PX = 1.0
MIN_CONSENSUS = 40
MIN_CONSENSUS_FRAC = 0.5
"""Inliers that prove that the matches of the check are right."""
MAX_MEDIAN_PX = 10.0
"""Correspondences that disagree by more on average are doubted: they are a few px accurate."""


@dataclass(frozen=True)
class FundamentalEstimator:
    """OpenCV's USAC_MAGSAC.

    Attributes:
        threshold_px: largest noise.
        confidence: at which it may end.
        max_num_iterations: at most.
        num_estimates: of so many orders of the matches the one of median error counts.
    """

    threshold_px: float
    confidence: float
    max_num_iterations: int
    num_estimates: int

    def estimate(
        self, points1: NDArray[np.floating], points2: NDArray[np.floating], seed: int
    ) -> tuple[FundamentalMatrix | None, int]:
        """Estimate from (M, 2) matches, x2' F x1 = 0; also return the number of inliers.

        OpenCV draws the same samples every time, so the seed decides the order of the matches.
        """
        if len(points1) < MIN_MATCHES:
            return None, 0
        order = np.random.default_rng(seed).permutation(len(points1))
        matrix, inliers = cv2.findFundamentalMat(
            np.asarray(points1, dtype=np.float64)[order],
            np.asarray(points2, dtype=np.float64)[order],
            cv2.USAC_MAGSAC,
            self.threshold_px,
            self.confidence,
            self.max_num_iterations,
        )
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            return None, 0
        return np.asarray(matrix, dtype=np.float64), int(np.count_nonzero(inliers))


def score_correspondences(
    truth: Points,
    points1: Points,
    points2: Points,
    estimator: FundamentalEstimator,
    random_seed: int,
) -> PairScore:
    """Score (M, 2) and (M, 2) matches by (N, 4) true correspondences x1, y1, x2, y2.

    ``error`` is the median of their symmetric epipolar distances from the estimate. Details:
    ``wxbs_score``, and ``recall_Kpx``, the share of them within K px.
    """
    found = []
    for number in range(estimator.num_estimates):
        matrix, num_inliers = estimator.estimate(points1, points2, random_seed + number)
        distances = symmetric_epipolar_distances(matrix, truth)
        found.append((float(np.median(distances)), num_inliers, number, distances))
    error, num_inliers, _, distances = median_low(found)
    return PairScore(error, num_inliers, None, recalls(distances))


def recalls(distances_px: NDArray[np.float64]) -> dict[str, float]:
    """Return the score of WxBS, and shares of (N,) distances up to single thresholds."""
    return {
        "wxbs_score": float(np.mean([_share(distances_px, limit) for limit in WXBS_THRESHOLDS_PX])),
        **{f"recall_{limit}px": _share(distances_px, limit) for limit in SHOWN_THRESHOLDS_PX},
    }


def _share(distances_px: NDArray[np.float64], limit_px: float) -> float:
    return float((distances_px <= limit_px).mean())


def symmetric_epipolar_distances(
    matrix: FundamentalMatrix | None, correspondences: Points
) -> NDArray[np.float64]:
    """Return the (N,) distances of (N, 4) correspondences from a fundamental matrix, in px.

    The distance is sqrt(d1^2 + d2^2), of the points from their epipolar lines in images 1 and 2,
    as WxBS has it. Without a matrix, and where a line is not defined, it is infinite.
    """
    if matrix is None:
        return np.full(len(correspondences), np.inf)
    ones = np.ones((len(correspondences), 1))
    first = np.hstack([correspondences[:, :2], ones])
    second = np.hstack([correspondences[:, 2:], ones])
    lines2, lines1 = first @ matrix.T, second @ matrix
    algebraic = (second * lines2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_squares = sum(1.0 / (lines[:, :2] ** 2).sum(axis=1) for lines in (lines1, lines2))
        distances = np.abs(algebraic) * np.sqrt(inverse_squares)
    return np.asarray(np.nan_to_num(distances, nan=np.inf))


def checked_correspondences(values: ArrayLike, where: str) -> Points:
    """Return (N, 4) correspondences if they are some.

    Raises:
        EvaluationError: saying what is wrong.
    """
    try:
        points = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(f"{where}: correspondences are not rows x1, y1, x2, y2") from error
    if points.ndim != 2 or points.shape[1] != 4 or not len(points):
        raise EvaluationError(
            f"{where}: correspondences have shape {points.shape}, expected rows x1, y1, x2, y2"
        )
    if not np.isfinite(points).all():
        raise EvaluationError(f"{where}: correspondences have values that are not finite")
    return points


def correspondence_doubts(correspondences: Points, paths: Sequence[Path]) -> str:
    """Say what speaks against (N, 4) correspondences of two images; empty if nothing does.

    They must lie in the images. Where plain features match beyond doubt, they must agree with the
    epipolar geometry of these; pairs that are too hard for them cannot be checked.

    Raises:
        ImageError: when an image cannot be read.
    """
    images = [read_gray(path) for path in paths]
    sides = (correspondences[:, :2], correspondences[:, 2:])
    for number, (image, points) in enumerate(zip(images, sides, strict=True), 1):
        outside = int((~is_inside(points, (image.shape[1], image.shape[0]))).sum())
        if outside:
            return f"{outside} of {len(points)} lie outside of image {number}"
    recipe = load_recipe(CHECK_RECIPE)
    features = [extract_image(image, recipe.extraction) for image in images]
    first, second = (
        matchable(part.descriptors, part.keypoints, recipe.matching) for part in features
    )
    rows1, rows2 = match_features(first, second, recipe.matching).indices.T
    estimator = FundamentalEstimator(CHECK_NOISE_PX, 0.999, 10_000, 1)
    matrix, count = estimator.estimate(first.keypoints[rows1], second.keypoints[rows2], 0)
    if count < max(MIN_CONSENSUS, MIN_CONSENSUS_FRAC * len(rows1)):
        return ""
    mistakes = {
        "": correspondences,
        "; x and y are exchanged": correspondences[:, [1, 0, 3, 2]],
        "; the images are exchanged": correspondences[:, [2, 3, 0, 1]],
        **{f"; they are of images {1 / s:g} times as large": s * correspondences for s in (0.5, 2)},
    }
    medians = {
        what: float(np.median(symmetric_epipolar_distances(matrix, points)))
        for what, points in mistakes.items()
    }
    if medians[""] <= MAX_MEDIAN_PX:
        return ""
    best = min(medians, key=lambda what: medians[what])
    doubt = f"contradict the matches of plain features, by {medians['']:.0f} px in the median"
    return doubt + (best if medians[best] <= MAX_MEDIAN_PX else "")
