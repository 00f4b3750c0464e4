"""Relative poses from matches of calibrated cameras, and their errors.

Cameras are COLMAP's, of any of its models: their pixels have the origin in the corner, as those of
the datasets whose truth COLMAP made. Points of matches are pixel-centre, as everywhere else.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.metrics import Pose, area_under_curve, pose_errors, relative_pose
from colmap_affrect.conventions import colmap_from_pixel, pixel_from_colmap
from colmap_affrect.evaluation.protocol import (
    EvaluationImage,
    EvaluationPair,
    PairResult,
    PairScore,
)

Points = NDArray[np.float64]

PAPER_MAX_NUM_ITERATIONS = 100_000
"""What the paper says."""

PAPER_CODE_MAX_NUM_ITERATIONS = 1_000
"""What the paper's code did: the function of OpenCV that it called takes no number."""

MIN_NUM_MATCHES = 6
"""Five points leave several essential matrices, none of which another match supports."""

CORRECT_PX = 3.0
"""A match agrees with a pose up to this Sampson distance."""


ESTIMATORS = {"": "", "GC-RANSAC: ": "gc_"}
"""What the names of columns begin with, and those of details of scores, by estimator."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image with the truth about its camera.

    Attributes:
        image: the file.
        camera: intrinsics with distortion.
        pose: cam_from_world, (3, 3) rotation and (3,) translation.
    """

    image: EvaluationImage
    camera: pycolmap.Camera
    pose: Pose


def posed_image(name: str, path: Path, camera: pycolmap.Camera, pose: Pose) -> PosedImage:
    """Return an image whose plain intrinsics are those of its camera."""
    intrinsics = np.asarray(camera.calibration_matrix(), dtype=np.float64)
    intrinsics[:2, 2] = pixel_from_colmap(intrinsics[:2, 2])
    return PosedImage(EvaluationImage(name, path, intrinsics), camera, pose)


def posed_pair(first: PosedImage, second: PosedImage, category: str) -> EvaluationPair:
    """Return the pair of two images; its truth is both of them."""
    name = f"{first.image.name} {second.image.name}"
    return EvaluationPair(name, (first.image, second.image), category, (first, second))


def true_pose(pair: EvaluationPair) -> Pose:
    """Return the true camera2_from_camera1."""
    first, second = pair.truth
    return relative_pose(first.pose, second.pose)


def rotation_angle_deg(rotation: NDArray[np.float64]) -> float:
    """Return the angle of a (3, 3) rotation, from 0 to 180 degrees."""
    nothing = np.zeros(3)
    return pose_errors((rotation, nothing), (np.eye(3), nothing))[0]


@dataclass(frozen=True)
class RelativePoseProtocol:
    """Score of matches by the relative pose that they give, the intrinsics being known.

    Two estimators: the paper's, plain RANSAC, whose result is one sample of five matches, and a
    recommended one, OpenCV's GC-RANSAC (``USAC_ACCURATE``), which refines on all inliers.

    Attributes:
        threshold_px: of an inlier; the distance of points from epipolar lines, in units of the
            mean focal length of the two cameras.
        confidence: at which either may end.
        max_num_iterations: of either; ``PAPER_CODE_MAX_NUM_ITERATIONS`` is what gave the
            paper's numbers.
        use_distortion: whether the lenses are straightened out; the paper's code did not.
        gc_threshold_px: of an inlier of GC-RANSAC; as in verification by default.
        num_gc_estimates: of so many orders of the matches the one of median error counts.
        max_error_deg: rotation error below which a pair counts.
        check_truth: see whether the images confirm the poses.
    """

    threshold_px: float = 0.5
    confidence: float = 0.9999
    max_num_iterations: int = PAPER_MAX_NUM_ITERATIONS
    use_distortion: bool = True
    gc_threshold_px: float = 3.0
    num_gc_estimates: int = 5
    max_error_deg: float = 5.0
    check_truth: bool = True

    error_title = "rotation error [deg]"

    def settings(self) -> dict[str, Any]:
        """Return everything that decides scores."""
        deciding = {key: value for key, value in asdict(self).items() if key != "check_truth"}
        return {"estimators": "OpenCV findEssentialMat, RANSAC and USAC_ACCURATE", **deciding}

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score (M, 2) and (M, 2) matched points, pixel-centre px of the stored images.

        The error is that of the rotation by the paper's RANSAC, in degrees. Details:
        ``direction_error_deg``, the angle between the directions of the translations, and both
        errors and the number of inliers by GC-RANSAC, ``gc_...``. ``num_correct`` are the matches
        within ``CORRECT_PX`` of the true epipolar lines: wrong ones may be among them by chance.
        """
        cameras = (pair.truth[0].camera, pair.truth[1].camera)
        truth = true_pose(pair)
        rays1, rays2 = (
            rays(camera, points, use_distortion=self.use_distortion)
            for camera, points in zip(cameras, (points1, points2), strict=True)
        )
        scale = mean_focal_px(cameras)

        def estimate(threshold_px: float, seed: int, method: int) -> tuple[float, float, int]:
            """Return the errors of rotation and direction, and the number of inliers."""
            ransac = Ransac(
                threshold_px / scale, self.confidence, self.max_num_iterations, seed, method
            )
            pose, inliers = estimate_relative_pose(rays1, rays2, ransac)
            errors = (math.inf, math.inf) if pose is None else pose_errors(pose, truth)
            return *errors, int(inliers.sum())

        error, direction_error, num_inliers = estimate(self.threshold_px, random_seed, cv2.RANSAC)
        others = sorted(
            estimate(self.gc_threshold_px, random_seed + number, cv2.USAC_ACCURATE)
            for number in range(self.num_gc_estimates)
        )
        gc_error, gc_direction_error, gc_num_inliers = others[(len(others) - 1) // 2]
        return PairScore(
            error,
            num_inliers,
            int((scale * sampson_distances(truth, rays1, rays2) < CORRECT_PX).sum()),
            {
                "direction_error_deg": direction_error,
                "gc_error": gc_error,
                "gc_direction_error_deg": gc_direction_error,
                "gc_num_inliers": gc_num_inliers,
            },
        )

    def success(self, score: PairScore) -> float:
        """Return 1 if the rotation error is below the limit, else 0."""
        return float(score.error < self.max_error_deg)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return shares of pairs with a rotation error below the limit, by category and of all.

        Also shares under 10 and 20 degrees, and the area under the curve of the larger of
        rotation and direction error up to 10 degrees; then the same by GC-RANSAC.
        """
        by_category: dict[str, list[PairScore]] = {}
        for result in sorted(results, key=lambda result: category_start(result.category)):
            by_category.setdefault(result.category, []).append(result.score)
        everything = [result.score for result in results]
        columns: dict[str, float] = {}
        for group, prefix in ESTIMATORS.items():
            for category, scores in by_category.items():
                errors = [error for error, _ in _errors(scores, prefix)]
                columns[group + category] = _share_below(self.max_error_deg, errors)
            columns |= self._totals(everything, group, prefix)
        return columns

    def totals(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return the columns of :meth:`summarize` that are of all categories."""
        scores = [result.score for result in results]
        columns: dict[str, float] = {}
        for group, prefix in ESTIMATORS.items():
            columns |= self._totals(scores, group, prefix)
        return columns

    def _totals(self, scores: Sequence[PairScore], group: str, prefix: str) -> dict[str, float]:
        errors = _errors(scores, prefix)
        rotation_errors = [error for error, _ in errors]
        return {
            f"{group}all": _share_below(self.max_error_deg, rotation_errors),
            f"{group}all < 10°": _share_below(10.0, rotation_errors),
            f"{group}all < 20°": _share_below(20.0, rotation_errors),
            f"{group}pose AUC 10°": area_under_curve(map(max, errors), len(errors), 10.0),
        }


def _errors(scores: Sequence[PairScore], prefix: str) -> list[tuple[float, float]]:
    """Return the errors of rotation and direction by an estimator; infinite for failed pairs."""
    return [
        (
            score.details.get(f"{prefix}error", math.inf) if prefix else score.error,
            score.details.get(f"{prefix}direction_error_deg", math.inf),
        )
        for score in scores
    ]


def _share_below(limit: float, errors: Sequence[float]) -> float:
    return sum(error < limit for error in errors) / len(errors) if errors else 0.0


def category_start(category: str) -> float:
    """Return the number that a category begins with.

    >>> category_start("120°")
    120.0
    """
    return float(category.rstrip("°"))


def mean_focal_px(cameras: Sequence[pycolmap.Camera]) -> float:
    """Return the mean focal length of cameras, in px, as OpenCV scales its threshold."""
    return float(np.mean([camera.mean_focal_length() for camera in cameras]))


def rays(
    camera: pycolmap.Camera, points: NDArray[np.floating], *, use_distortion: bool = True
) -> Points:
    """Turn (N, 2) pixel-centre points into (N, 2) x/z, y/z in front of the camera.

    Points that a lens cannot have produced become NaN.
    """
    pixels = colmap_from_pixel(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    if use_distortion:
        return np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
    matrix = np.asarray(camera.calibration_matrix())
    return np.asarray((pixels - matrix[:2, 2]) / np.diag(matrix)[:2])


def sampson_distances(pose: Pose, rays1: Points, rays2: Points) -> NDArray[np.float64]:
    """Return the (N,) first-order distances of matches from a relative pose.

    Args:
        pose: camera2_from_camera1.
        rays1: (N, 2) of camera 1, see :func:`rays`.
        rays2: (N, 2) of camera 2.

    Returns:
        Distances in units of the focal length; infinite where they are not defined.
    """
    rotation, (x, y, z) = pose
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    ones = np.ones((len(rays1), 1))
    first, second = np.hstack([rays1, ones]), np.hstack([rays2, ones])
    lines2, lines1 = first @ essential.T, second @ essential
    slopes = np.square(lines2[:, :2]).sum(axis=1) + np.square(lines1[:, :2]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.abs((second * lines2).sum(axis=1)) / np.sqrt(slopes)
    return np.asarray(np.nan_to_num(distances, nan=np.inf))


@dataclass(frozen=True)
class Ransac:
    """How to look for an essential matrix.

    Attributes:
        threshold: of an inlier, in units of the focal length.
        confidence: at which to end before all iterations.
        max_num_iterations: at most.
        random_seed: decides the samples.
        method: ``cv2.RANSAC`` or another of OpenCV's.
    """

    threshold: float
    confidence: float
    max_num_iterations: int
    random_seed: int = 0
    method: int = cv2.RANSAC


def estimate_relative_pose(
    rays1: Points, rays2: Points, ransac: Ransac
) -> tuple[Pose | None, NDArray[np.bool_]]:
    """Estimate camera2_from_camera1 from five-point samples.

    OpenCV draws the same samples every time, so the seed decides the order of the matches.

    Args:
        rays1: (N, 2) of camera 1, see :func:`rays`; matches with NaN are never inliers.
        rays2: (N, 2) of camera 2.
        ransac: how.

    Returns:
        The pose, its translation of length 1, None if there is none; and the (N,) inliers.
    """
    inliers = np.zeros(len(rays1), dtype=bool)
    usable = np.flatnonzero(np.isfinite(rays1).all(axis=1) & np.isfinite(rays2).all(axis=1))
    if len(usable) < MIN_NUM_MATCHES:
        return None, inliers
    order = np.random.default_rng(ransac.random_seed).permutation(usable)
    first, second = np.ascontiguousarray(rays1[order]), np.ascontiguousarray(rays2[order])
    essential, mask = cv2.findEssentialMat(
        first,
        second,
        np.eye(3),
        method=ransac.method,
        prob=ransac.confidence,
        threshold=ransac.threshold,
        maxIters=ransac.max_num_iterations,
    )
    if essential is None or essential.shape != (3, 3):
        return None, inliers
    inliers[order] = mask.ravel() != 0
    if inliers.sum() < MIN_NUM_MATCHES:
        return None, inliers
    _, rotation, translation, _ = cv2.recoverPose(
        essential, first[inliers[order]], second[inliers[order]], np.eye(3)
    )
    pose = (
        np.asarray(rotation, dtype=np.float64),
        np.asarray(translation, dtype=np.float64).ravel(),
    )
    return pose, inliers
