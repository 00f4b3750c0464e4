"""Homographies of image pairs: their errors against the truth, and scores.

All homographies are (3, 3), image2_from_image1, of pixel-centre px, with a positive third
coordinate in the part of image 1 that image 2 shows.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median_low
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np

from colmap_affrect.conventions import is_inside
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import (
    POSITIVE,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
    finite_numbers,
)
from colmap_affrect.evaluation.two_views import Points
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.reading import read_gray
from colmap_affrect.options import within

Homography = Array
Size = tuple[int, int]  # (width, height) in px
CORRECT_PX = 3.0  # a match is correct if its transfer error in image 2 is smaller
THRESHOLDS_PX = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
"""Pairs are counted whose homography error is smaller (the paper's table on EVD)."""

GRID_STEP_PX = 4


@dataclass(frozen=True)
class TrueHomography:
    """The truth of a pair."""

    matrix: Homography
    size1: Size
    size2: Size

    @cached_property
    def visible(self) -> Points:
        """(N, 2) points of image 1 that image 2 shows."""
        return visible_points(self.matrix, self.size1, self.size2)

    def error_px(self, estimate: Homography | None) -> float:
        """Return the mean distance in image 2 between truth and estimate, over the visible part.

        It is infinite without an estimate, or when its horizon runs through that part.
        """
        if estimate is None or not len(self.visible):
            return math.inf
        signed = estimate * np.sign(third_coordinates(estimate, self.visible).sum())
        target = project(self.matrix, self.visible)
        return float(transfer_errors(signed, self.visible, target).mean())


class HomographyProtocol(EvaluationProtocol):
    """Score of matches by the homography that they give, as the paper and as we recommend."""

    error_title: ClassVar[str] = "mean reprojection error of the visible part (px)"

    magsac_threshold_px: Annotated[float, POSITIVE] = 5.0
    """Largest noise that OpenCV's USAC_MAGSAC reckons with."""
    num_magsac_estimates: Annotated[int, within(1, 1_000_000_000)] = 5
    """Of so many orders of the matches the one of median error counts."""
    max_error_px: Annotated[float, POSITIVE] = 5.0
    """A homography counts below this error."""

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score by the paper's RANSAC; the details are those of USAC_MAGSAC."""
        truth: TrueHomography = pair.truth
        plain = self.ransac(cv2.RANSAC, self.threshold_px, random_seed)
        magsac = self.ransac(cv2.USAC_MAGSAC, self.magsac_threshold_px, random_seed)
        estimate, num_inliers = plain.homography(points1, points2)
        reseeded = magsac.reseeded(self.num_magsac_estimates)
        others = [ransac.homography(points1, points2) for ransac in reseeded]
        return PairScore(
            truth.error_px(estimate),
            num_inliers,
            int((transfer_errors(truth.matrix, points1, points2) < CORRECT_PX).sum()),
            {
                "magsac_error": median_low(truth.error_px(other) for other, _ in others),
                "magsac_num_inliers": median_low(count for _, count in others),
            },
        )

    def success(self, score: PairScore) -> float:
        """1 if the error is below the limit."""
        return float(score.error < self.max_error_px)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Count the pairs whose error is below each of ``THRESHOLDS_PX``, for both estimators."""
        errors = {
            "": [result.error for result in results],
            "MAGSAC: ": [result.details.get("magsac_error", math.inf) for result in results],
        }
        return {
            f"{name}< {threshold:g} px": float(sum(error < threshold for error in values))
            for name, values in errors.items()
            for threshold in THRESHOLDS_PX
        }

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        return {
            "homography_error": "mean over the visible part of image 1, every 4th pixel in x and "
            "y, of the Euclidean distance in image 2 between truth and estimate, px",
            "visible_part": "the pixels of image 1 that the truth carries into image 2",
            "homography_estimator": "OpenCV RANSAC",
            "correct_px": CORRECT_PX,
            **super().settings(),
        }


def transfer_errors(matrix: Homography, points1: Points, points2: Points) -> Array:
    """Return the (N,) distances in image 2, in px, of (N, 2) points 1 carried over to points 2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.linalg.norm(project(matrix, points1) - points2, axis=1)
    return np.where(third_coordinates(matrix, points1) > 0, distances, np.inf)


def third_coordinates(homography: Homography, points: Points) -> Array:
    """Return the (N,) third coordinates of (N, 2) points carried over, before the division."""
    return np.asarray(points @ homography[2, :2] + homography[2, 2])


def visible_points(truth: Homography, size1: Size, size2: Size) -> Points:
    """Return the (N, 2) points of image 1 that image 2 shows by a true homography.

    They are every ``GRID_STEP_PX``-th pixel centre in x and y; sizes are (width, height) in px.
    """
    columns, rows = (np.arange(0, extent, GRID_STEP_PX) for extent in size1)
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    points = points[third_coordinates(truth, points) > 0]
    return points[is_inside(project(truth, points), size2)]


def oriented(matrix: Homography, size1: Size, size2: Size) -> Homography:
    """Give a homography of any scale a positive third coordinate in the part that is visible."""
    return max((matrix, -matrix), key=lambda signed: len(visible_points(signed, size1, size2)))


def true_homography(matrix: Homography, paths: Sequence[Path]) -> TrueHomography:
    """Return the truth of two images; ``matrix`` is (3, 3) image2_from_image1 of any scale.

    Raises ImageError when an image cannot be read, EvaluationError when image 2 shows no part of
    image 1.
    """
    size1, size2 = ((image.shape[1], image.shape[0]) for image in map(read_gray, paths))
    truth = TrueHomography(oriented(matrix, size1, size2), size1, size2)
    if not len(truth.visible):
        raise EvaluationError("the homography shows no part of image 1 in image 2")
    return truth


def checked_homography(given: Any, what: str) -> Homography:
    """Return a (3, 3) homography; EvaluationError says why it is none."""
    matrix = finite_numbers(given, (3, 3), what)
    if np.linalg.matrix_rank(matrix) < 3:
        raise EvaluationError(f"{what} is singular")
    return matrix
