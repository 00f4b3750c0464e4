"""Homographies of image pairs: estimation, errors against the truth, and checks of that truth.

All homographies are (3, 3), image2_from_image1, of pixel-centre px, with a positive third
coordinate in the part of image 1 that image 2 shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from statistics import median_low
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_affrect.conventions import is_inside
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import PairResult, PairScore
from colmap_affrect.extraction import extract_image
from colmap_affrect.geometry.affine import project
from colmap_affrect.imaging import read_gray, warp
from colmap_affrect.matching.nearest import match_features, matchable
from colmap_affrect.recipes import load_recipe
from colmap_affrect.types import GrayImage, LocalFeatures, Rectification

Homography = NDArray[np.float64]
Size = tuple[int, int]
"""(width, height) in px."""

CORRECT_PX = 3.0
"""A match is correct if its transfer error in image 2 is smaller."""

THRESHOLDS_PX = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
"""Pairs are counted whose homography error is smaller (the paper's table on EVD)."""

GRID_STEP_PX = 4
MIN_MATCHES = 4

MIN_SUPPORT = 8
MIN_SUPPORT_FRAC = 0.25
"""Matches of the rectified pair that confirm a homography. On real pairs true ones have at least 30
and 44 % of all, wrong ones at most two."""
SUPPORT_PX = 5.0
CHECK_RECIPE = "unrectified-rootsift"
RESIZED = (0.5, 2.0)
"""Sizes of an image that a homography might be of, in the place of its own."""


@dataclass(frozen=True)
class HomographyEstimator:
    """Estimation as the paper does it, and as we recommend.

    Attributes:
        threshold_px: inliers of OpenCV's RANSAC (the paper: 0.5).
        confidence: of both.
        max_num_iterations: of both.
        magsac_threshold_px: largest noise that OpenCV's USAC_MAGSAC reckons with.
        num_magsac_estimates: of so many orders of the matches the one of median error counts.
    """

    threshold_px: float = 0.5
    confidence: float = 0.9999
    max_num_iterations: int = 100_000
    magsac_threshold_px: float = 5.0
    num_magsac_estimates: int = 5

    def ransac(
        self, points1: NDArray[np.floating], points2: NDArray[np.floating], seed: int
    ) -> tuple[Homography | None, int]:
        """Estimate from (M, 2) matches as the paper; also return the number of inliers."""
        return self._estimate(points1, points2, seed, cv2.RANSAC, self.threshold_px)

    def magsac(
        self, points1: NDArray[np.floating], points2: NDArray[np.floating], seed: int
    ) -> tuple[Homography | None, int]:
        """Estimate from (M, 2) matches by USAC_MAGSAC; also return the number of inliers."""
        return self._estimate(points1, points2, seed, cv2.USAC_MAGSAC, self.magsac_threshold_px)

    def _estimate(
        self,
        points1: NDArray[np.floating],
        points2: NDArray[np.floating],
        seed: int,
        method: int,
        threshold_px: float,
    ) -> tuple[Homography | None, int]:
        """OpenCV draws the same samples every time, so the seed decides the order of matches."""
        if len(points1) < MIN_MATCHES:
            return None, 0
        order = np.random.default_rng(seed).permutation(len(points1))
        estimate, inliers = cv2.findHomography(
            points1[order],
            points2[order],
            method,
            threshold_px,
            maxIters=self.max_num_iterations,
            confidence=self.confidence,
        )
        if estimate is None or not np.isfinite(estimate).all():
            return None, 0
        return np.asarray(estimate, dtype=np.float64), int(np.count_nonzero(inliers))

    def settings(self) -> dict[str, Any]:
        """Return everything that decides the errors, and what they are."""
        return {
            "error": "mean over the visible part of image 1, every 4th pixel in x and y, of the "
            "Euclidean distance in image 2 between truth and estimate, px",
            "visible_part": "the pixels of image 1 that the truth carries into image 2",
            "estimator": "OpenCV RANSAC",
            "correct_px": CORRECT_PX,
            **asdict(self),
        }


@dataclass(frozen=True)
class TrueHomography:
    """The truth of a pair.

    Attributes:
        matrix: (3, 3) image2_from_image1, with a positive third coordinate where it is visible.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.
    """

    matrix: Homography
    size1: Size
    size2: Size

    @cached_property
    def visible(self) -> NDArray[np.float64]:
        """(N, 2) points of image 1 that image 2 shows."""
        return visible_points(self.matrix, self.size1, self.size2)

    def error_px(self, estimate: Homography | None) -> float:
        """Return the mean Euclidean distance in image 2 between truth and estimate.

        The mean is over what image 2 shows of image 1. Without an estimate, or when its horizon
        runs through that part, the error is infinite.
        """
        if estimate is None or not len(self.visible):
            return float("inf")
        signed = estimate * np.sign(third_coordinates(estimate, self.visible).sum())
        target = project(self.matrix, self.visible)
        return float(transfer_errors(signed, self.visible, target).mean())


def score_homography(
    truth: TrueHomography,
    points1: NDArray[np.float64],
    points2: NDArray[np.float64],
    estimator: HomographyEstimator,
    random_seed: int,
) -> PairScore:
    """Estimate in both ways from (M, 2) matches; ``error`` is that of the paper's way."""
    estimate, num_inliers = estimator.ransac(points1, points2, random_seed)
    others = [
        estimator.magsac(points1, points2, random_seed + number)
        for number in range(estimator.num_magsac_estimates)
    ]
    return PairScore(
        truth.error_px(estimate),
        num_inliers,
        int((transfer_errors(truth.matrix, points1, points2) < CORRECT_PX).sum()),
        {
            "magsac_error": median_low(truth.error_px(other) for other, _ in others),
            "magsac_num_inliers": median_low(count for _, count in others),
        },
    )


def transfer_errors(
    homography: NDArray[np.floating], points1: NDArray[np.floating], points2: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the (N,) distances in image 2, in px, of (N, 2) points 1 carried over to points 2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.linalg.norm(project(homography, points1) - points2, axis=1)
    return np.where(third_coordinates(homography, points1) > 0, distances, np.inf)


def third_coordinates(
    homography: NDArray[np.floating], points: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the (N,) third coordinates of (N, 2) points carried over, before the division."""
    return np.asarray(points @ homography[2, :2] + homography[2, 2])


def visible_points(truth: NDArray[np.floating], size1: Size, size2: Size) -> NDArray[np.float64]:
    """Return the points of image 1 that image 2 shows.

    Args:
        truth: (3, 3) true homography.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.

    Returns:
        (N, 2) pixel centres, every ``GRID_STEP_PX``-th in x and y.
    """
    columns, rows = (np.arange(0, extent, GRID_STEP_PX) for extent in size1)
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    points = points[third_coordinates(truth, points) > 0]
    return points[is_inside(project(truth, points), size2)]


def true_homography(
    matrix: Homography, paths: tuple[Path, Path], *, check: bool
) -> tuple[TrueHomography, str]:
    """Return the truth of two images, and what speaks against it (:func:`doubts`).

    Args:
        matrix: (3, 3) image2_from_image1 of any scale and sign.
        paths: of the two images.
        check: look for doubts.

    Raises:
        ImageError: when an image cannot be read.
    """
    image1, image2 = (read_gray(path) for path in paths)
    size1, size2 = size_of(image1), size_of(image2)
    truth = TrueHomography(oriented(matrix, size1, size2), size1, size2)
    return truth, doubts(matrix, image1, image2) if check else ""


def size_of(image: GrayImage) -> Size:
    """Return (width, height) of an (H, W) image."""
    return image.shape[1], image.shape[0]


def oriented(matrix: Homography, size1: Size, size2: Size) -> Homography:
    """Give a homography of any scale a positive third coordinate in the part that is visible."""
    return max((matrix, -matrix), key=lambda signed: len(visible_points(signed, size1, size2)))


def doubts(matrix: Homography, image1: GrayImage, image2: GrayImage) -> str:
    """Say what speaks against a true homography; empty if the images confirm it.

    Image 1 is warped by it, so that even extreme views become easy to match: if it is right,
    features of the warp and of image 2 agree in their places. If they do not, the same is tried
    with what people confuse it with.

    Args:
        matrix: (3, 3) finite.
        image1: (H, W) uint8.
        image2: (H, W) uint8.
    """
    size1, size2 = size_of(image1), size_of(image2)
    features2 = _features(image2)
    if not len(visible_points(oriented(matrix, size1, size2), size1, size2)):
        doubt = "shows no part of image 1 in image 2"
    elif _support(matrix, image1, size2, features2):
        return ""
    else:
        doubt = "is not confirmed by features of the images"
    supports = {
        mistake: _support(suspect, image1, size2, features2)
        for mistake, suspect in _mistakes(matrix)
    }
    best = max(supports, key=lambda mistake: supports[mistake])
    return f"{doubt}; it is {best}" if supports[best] else doubt


def _mistakes(matrix: Homography) -> Iterator[tuple[str, Homography]]:
    """Yield what a wrong homography may be, with the right one."""
    if abs(np.linalg.det(matrix)) > 0.0:
        yield "inverted: from image 2 to image 1", np.asarray(np.linalg.inv(matrix))
    yield "transposed", matrix.T
    for scale in RESIZED:
        resize: Homography = np.diag([scale, scale, 1.0])
        shrink = np.diag([1 / scale, 1 / scale, 1.0])
        of_size = f"of images {1 / scale:g} times as large"
        yield of_size, resize @ matrix @ shrink
        yield f"{of_size}, in image 1", matrix @ shrink
        yield f"{of_size}, in image 2", resize @ matrix


def _features(image: GrayImage) -> LocalFeatures:
    return extract_image(image, load_recipe(CHECK_RECIPE).extraction)


def _support(matrix: Homography, image1: GrayImage, size2: Size, features2: LocalFeatures) -> int:
    """Count the features of image 1, warped by a homography, that image 2 has at their place.

    Returns:
        0 when they are too few to confirm it.
    """
    matrix = oriented(matrix, size_of(image1), size2)
    if not len(visible_points(matrix, size_of(image1), size2)):
        return 0
    options = load_recipe(CHECK_RECIPE).matching
    features = _features(warp(image1, Rectification(matrix, size2, None, 1.0, 0.0))), features2
    first, second = (matchable(part.descriptors, part.keypoints, options) for part in features)
    rows1, rows2 = match_features(first, second, options).indices.T
    distances_px = np.linalg.norm(first.keypoints[rows1] - second.keypoints[rows2], axis=1)
    count = int((distances_px < SUPPORT_PX).sum())
    return count if count >= max(MIN_SUPPORT, MIN_SUPPORT_FRAC * len(rows1)) else 0


def homography_counts(results: Sequence[PairResult], prefix: str = "") -> dict[str, float]:
    """Count the pairs whose error is below each of ``THRESHOLDS_PX``, for both estimators."""
    errors = {prefix: [result.score.error for result in results]}
    errors[f"{prefix}MAGSAC: "] = [
        result.score.details.get("magsac_error", float("inf")) for result in results
    ]
    return {
        f"{name}< {threshold:g} px": float(sum(error < threshold for error in values))
        for name, values in errors.items()
        for threshold in THRESHOLDS_PX
    }


def read_homography(path: Path) -> Homography:
    """Read a (3, 3) homography from text.

    Raises:
        EvaluationError: when it is not one.
    """
    try:
        matrix = np.loadtxt(path, dtype=np.float64)
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read as 3 x 3 numbers ({error})") from error
    return checked_homography(matrix, str(path))


def checked_homography(matrix: ArrayLike, where: str) -> Homography:
    """Return a (3, 3) homography if it is one.

    Raises:
        EvaluationError: saying what is wrong.
    """
    try:
        values = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise EvaluationError(f"{where}: homography is not 3 x 3 numbers") from error
    if values.shape != (3, 3):
        raise EvaluationError(f"{where}: homography has shape {values.shape}, not (3, 3)")
    if not np.isfinite(values).all():
        raise EvaluationError(f"{where}: homography has values that are not finite")
    if np.linalg.matrix_rank(values) < 3:
        raise EvaluationError(f"{where}: homography is singular")
    return values
