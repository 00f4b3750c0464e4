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

    Attributes:
        threshold_px: of an inlier; the distance of points from epipolar lines, in units of the
            mean focal length of the two cameras.
        confidence: at which RANSAC may end.
        max_num_iterations: of RANSAC; ``PAPER_CODE_MAX_NUM_ITERATIONS`` is what gave the
            paper's numbers.
        use_distortion: whether the lenses are straightened out; the paper's code did not.
        max_error_deg: rotation error below which a pair counts.
        check_truth: see whether the images confirm the poses.
    """

    threshold_px: float = 0.5
    confidence: float = 0.9999
    max_num_iterations: int = PAPER_MAX_NUM_ITERATIONS
    use_distortion: bool = True
    max_error_deg: float = 5.0
    check_truth: bool = True

    error_title = "rotation error [deg]"

    def settings(self) -> dict[str, Any]:
        """Return everything that decides scores."""
        deciding = {key: value for key, value in asdict(self).items() if key != "check_truth"}
        return {"estimator": "OpenCV findEssentialMat, RANSAC", **deciding}

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score (M, 2) and (M, 2) matched points, pixel-centre px of the stored images.

        The error is that of the rotation in degrees. Details: ``direction_error_deg``, the angle
        between the directions of the translations. ``num_correct`` are the matches within
        ``CORRECT_PX`` of the true epipolar lines: wrong ones may be among them by chance.
        """
        cameras = (pair.truth[0].camera, pair.truth[1].camera)
        truth = true_pose(pair)
        rays1, rays2 = (
            rays(camera, points, use_distortion=self.use_distortion)
            for camera, points in zip(cameras, (points1, points2), strict=True)
        )
        scale = mean_focal_px(cameras)
        num_correct = int((scale * sampson_distances(truth, rays1, rays2) < CORRECT_PX).sum())
        estimate, inliers = estimate_relative_pose(
            rays1,
            rays2,
            self.threshold_px / scale,
            self.confidence,
            self.max_num_iterations,
            random_seed,
        )
        num_inliers = int(inliers.sum())
        if estimate is None:
            return PairScore(math.inf, num_inliers, num_correct, {"direction_error_deg": math.inf})
        rotation_error, direction_error = pose_errors(estimate, truth)
        details = {"direction_error_deg": direction_error}
        return PairScore(rotation_error, num_inliers, num_correct, details)

    def success(self, score: PairScore) -> float:
        """Return 1 if the rotation error is below the limit, else 0."""
        return float(score.error < self.max_error_deg)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return shares of pairs with a rotation error below the limit, by category and of all.

        Also shares under 10 and 20 degrees, and the area under the curve of the larger of
        rotation and direction error up to 10 degrees.
        """
        by_category: dict[str, list[float]] = {}
        for result in sorted(results, key=lambda result: category_start(result.category)):
            by_category.setdefault(result.category, []).append(self.success(result.score))
        return {
            **{name: _mean(values) for name, values in by_category.items()},
            **self.totals(results),
        }

    def totals(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return the columns of :meth:`summarize` that are of all categories."""
        errors = [result.score.error for result in results]
        both = [
            max(result.score.error, result.score.details.get("direction_error_deg", math.inf))
            for result in results
        ]
        return {
            "all": _mean([self.success(result.score) for result in results]),
            "all < 10°": _mean([float(error < 10.0) for error in errors]),
            "all < 20°": _mean([float(error < 20.0) for error in errors]),
            "pose AUC 10°": area_under_curve(both, len(both), 10.0),
        }


def category_start(category: str) -> float:
    """Return the number that a category begins with.

    >>> category_start("120°")
    120.0
    """
    return float(category.rstrip("°"))


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if values else 0.0


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


def estimate_relative_pose(
    rays1: Points,
    rays2: Points,
    threshold: float,
    confidence: float,
    max_num_iterations: int,
    random_seed: int,
) -> tuple[Pose | None, NDArray[np.bool_]]:
    """Estimate camera2_from_camera1 with OpenCV's five-point RANSAC.

    OpenCV draws the same samples every time, so the seed decides the order of the matches.

    Args:
        rays1: (N, 2) of camera 1, see :func:`rays`; matches with NaN are never inliers.
        rays2: (N, 2) of camera 2.
        threshold: of an inlier, in units of the focal length.
        confidence: at which RANSAC may end before all iterations.
        max_num_iterations: at most.
        random_seed: decides the samples.

    Returns:
        The pose, its translation of length 1, None if there is none; and the (N,) inliers.
    """
    inliers = np.zeros(len(rays1), dtype=bool)
    usable = np.flatnonzero(np.isfinite(rays1).all(axis=1) & np.isfinite(rays2).all(axis=1))
    if len(usable) < MIN_NUM_MATCHES:
        return None, inliers
    order = np.random.default_rng(random_seed).permutation(usable)
    first, second = np.ascontiguousarray(rays1[order]), np.ascontiguousarray(rays2[order])
    essential, mask = cv2.findEssentialMat(
        first,
        second,
        np.eye(3),
        method=cv2.RANSAC,
        prob=confidence,
        threshold=threshold,
        maxIters=max_num_iterations,
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
