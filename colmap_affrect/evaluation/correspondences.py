"""Epipolar geometry of matches, scored by correspondences that were marked by hand (WxBS)."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean, median_low
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.evaluation.protocol import (
    POSITIVE,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
)
from colmap_affrect.evaluation.two_views import Points, symmetric_epipolar_distances
from colmap_affrect.options import within

WXBS_THRESHOLDS_PX = tuple(range(20))
"""The score of WxBS is the mean over these of the share of correspondences that agree."""

SHOWN_THRESHOLDS_PX = (1, 2, 3, 5, 10, 20)


class CorrespondenceProtocol(EvaluationProtocol):
    """Score of matches by the fundamental matrix that they give by OpenCV's USAC_MAGSAC."""

    epipolar_threshold_px: Annotated[float, POSITIVE] = 1.0
    """Largest noise that USAC_MAGSAC reckons with for fundamental matrices."""
    num_magsac_estimates: Annotated[int, within(1, 1_000_000_000)] = 5
    """Of so many orders of the matches the one of median error counts."""

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score matches of a pair whose truth is (N, 4) correspondences x1, y1, x2, y2.

        ``error`` is the median of their symmetric epipolar distances in px. Details:
        ``wxbs_score``, and ``recall_Kpx``, the share of them within K px.
        """
        ransac = self.ransac(cv2.USAC_MAGSAC, self.epipolar_threshold_px, random_seed)
        found = []
        for number, reseeded in enumerate(ransac.reseeded(self.num_magsac_estimates)):
            matrix, num_inliers = reseeded.fundamental_matrix(points1, points2)
            distances = symmetric_epipolar_distances(matrix, *np.hsplit(pair.truth, 2))
            found.append((float(np.median(distances)), num_inliers, number, distances))
        error, num_inliers, _, distances = median_low(found)
        return PairScore(error, num_inliers, None, recalls(distances))

    def success(self, score: PairScore) -> float:
        """Return the score of WxBS."""
        return score.details["wxbs_score"]

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        return {
            "correspondences": "OpenCV USAC_MAGSAC fundamental matrix; error: median symmetric "
            "epipolar distance sqrt(d1^2 + d2^2), px; WxBS score: mean over thresholds 0, 1, ... "
            "19 px of the share of correspondences within",
            **super().settings(),
        }


def recalls(distances_px: NDArray[np.float64]) -> dict[str, float]:
    """Return the score of WxBS, and shares of (N,) distances up to single thresholds."""

    def share(limit_px: float) -> float:
        return float((distances_px <= limit_px).mean())

    return {
        "wxbs_score": float(np.mean([share(limit) for limit in WXBS_THRESHOLDS_PX])),
        **{f"recall_{limit}px": share(limit) for limit in SHOWN_THRESHOLDS_PX},
    }


def mean_recalls(results: Sequence[PairResult]) -> dict[str, float]:
    """Return the means of :func:`recalls` over results, at least one, under names for people."""
    keys = {"WxBS score": "wxbs_score"}
    keys |= {f"within {limit} px": f"recall_{limit}px" for limit in SHOWN_THRESHOLDS_PX}
    return {name: fmean(result.details[key] for result in results) for name, key in keys.items()}
