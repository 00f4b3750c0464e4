"""Relative poses from matches of calibrated cameras, and their errors.

Cameras are COLMAP's, of any of its models: their pixels have the origin in the corner, as those of
the datasets whose truth COLMAP made. Points of matches are pixel-centre, as everywhere else.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median_low
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.poses import Pose, area_under_curve, pose_errors, relative_pose
from colmap_affrect.conventions import colmap_from_pixel, pixel_from_colmap
from colmap_affrect.evaluation.protocol import (
    POSITIVE,
    EvaluationImage,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
)
from colmap_affrect.evaluation.two_views import Points, Ransac, sampson_distances
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.options import within

CORRECT_PX = 3.0  # a match agrees with a pose up to this Sampson distance
MAX_AUC_ERROR_DEG = 10.0

ESTIMATORS = {"": "", "GC-RANSAC: ": "gc_"}
"""What the names of columns begin with, and those of details of scores, by estimator."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image with the truth about its camera; the pose is cam_from_world."""

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


def rotation_angle_deg(rotation: Array) -> float:
    """Return the angle of a (3, 3) rotation, from 0 to 180 degrees."""
    nothing = np.zeros(3)
    return pose_errors((rotation, nothing), (np.eye(3), nothing))[0]


class RelativePoseProtocol(EvaluationProtocol):
    """Score of matches by the relative pose that they give, the intrinsics being known.

    Two estimators: the paper's, plain RANSAC, whose result is one sample of five matches, and a
    recommended one, OpenCV's GC-RANSAC (``USAC_ACCURATE``), which refines on all inliers. Distances
    of points from epipolar lines are in px by the mean focal length of the two cameras.
    """

    error_title: ClassVar[str] = "rotation error [deg]"

    use_distortion: bool = True
    """Whether the lenses are straightened out; the paper's code did not."""
    gc_threshold_px: Annotated[float, POSITIVE] = 3.0
    """Of an inlier of GC-RANSAC; as in verification by default."""
    num_gc_estimates: Annotated[int, within(1, 1_000_000_000)] = 5
    """Of so many orders of the matches the one of median error counts."""
    max_error_deg: Annotated[float, POSITIVE] = 5.0
    """Rotation error below which a pair counts."""

    def settings(self) -> dict[str, Any]:
        """See :class:`EvaluationProtocol`."""
        estimators = "OpenCV findEssentialMat, RANSAC and USAC_ACCURATE"
        return {"estimators": estimators, **super().settings()}

    def score(
        self, pair: EvaluationPair, points1: Points, points2: Points, random_seed: int
    ) -> PairScore:
        """Score by the paper's RANSAC: the error is that of the rotation, in degrees.

        Details: ``direction_error_deg``, the angle between the directions of the translations, and
        the same by GC-RANSAC, ``gc_...``. ``num_correct`` matches are within ``CORRECT_PX`` of the
        true epipolar lines, wrong ones by chance among them.
        """
        cameras, truth = [image.camera for image in pair.truth], true_pose(pair)
        rays1, rays2 = (
            rays(camera, points, use_distortion=self.use_distortion)
            for camera, points in zip(cameras, (points1, points2), strict=True)
        )
        focal_px = mean_focal_px(cameras)

        def estimate(ransac: Ransac) -> tuple[float, float, int]:
            pose, inliers = ransac.relative_pose(rays1, rays2)
            errors = (math.inf, math.inf) if pose is None else pose_errors(pose, truth)
            return *errors, int(inliers.sum())

        plain = self.ransac(cv2.RANSAC, self.threshold_px / focal_px, random_seed)
        gc = self.ransac(cv2.USAC_ACCURATE, self.gc_threshold_px / focal_px, random_seed)
        error, direction_error, num_inliers = estimate(plain)
        by_gc = median_low(map(estimate, gc.reseeded(self.num_gc_estimates)))
        num_correct = int((focal_px * sampson_distances(truth, rays1, rays2) < CORRECT_PX).sum())
        details = {"direction_error_deg": direction_error}
        details |= zip(("gc_error", "gc_direction_error_deg", "gc_num_inliers"), by_gc, strict=True)
        return PairScore(error, num_inliers, num_correct, details)

    def success(self, score: PairScore) -> float:
        """Return 1 if the rotation error is below the limit, else 0."""
        return float(score.error < self.max_error_deg)

    def summarize(self, results: Sequence[PairResult]) -> dict[str, float]:
        """Return shares of pairs with a rotation error below the limit, by category and of all.

        Also below 10 and 20 degrees, and the area under the curve of the larger of rotation and
        direction error up to 10 degrees; then the same by GC-RANSAC.
        """
        categories = {result.category for result in results}
        return self.columns(results, sorted(categories, key=category_start))

    def columns(self, results: Sequence[PairResult], categories: Iterable[str]) -> dict[str, float]:
        """Return the columns of :meth:`summarize`, of some categories and of all results."""
        shares = {name: [r for r in results if r.category == name] for name in categories}
        limits = {"all": self.max_error_deg, "all < 10°": 10.0, "all < 20°": 20.0}
        columns: dict[str, float] = {}
        for group, prefix in ESTIMATORS.items():
            for title, members in {**shares, **dict.fromkeys(limits, results)}.items():
                limit = limits.get(title, self.max_error_deg)
                below = [_errors(result, prefix)[0] < limit for result in members]
                columns[group + title] = sum(below) / max(1, len(below))
            errors = [max(_errors(result, prefix)) for result in results]
            area = area_under_curve(errors, len(errors), MAX_AUC_ERROR_DEG)
            columns[f"{group}pose AUC {MAX_AUC_ERROR_DEG:g}°"] = area
        return columns


def _errors(result: PairResult, prefix: str) -> tuple[float, float]:
    """Return the errors of rotation and direction by an estimator; infinite for failed pairs."""
    rotation = result.details.get(f"{prefix}error", math.inf) if prefix else result.error
    return rotation, result.details.get(f"{prefix}direction_error_deg", math.inf)


def category_start(category: str) -> float:
    """Return the number that a category begins with.

    >>> category_start("120°")
    120.0
    """
    return float(category.rstrip("°"))


def mean_focal_px(cameras: Sequence[pycolmap.Camera]) -> float:
    """Return the mean focal length of cameras, in px, as OpenCV scales its threshold."""
    return float(np.mean([camera.mean_focal_length() for camera in cameras]))


def rays(camera: pycolmap.Camera, points: Floats, *, use_distortion: bool = True) -> Points:
    """Turn (N, 2) pixel-centre points into (N, 2) x/z, y/z; NaN for what a lens cannot produce."""
    pixels = colmap_from_pixel(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    if use_distortion:
        return np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
    matrix = np.asarray(camera.calibration_matrix())
    return np.asarray((pixels - matrix[:2, 2]) / np.diag(matrix)[:2])
