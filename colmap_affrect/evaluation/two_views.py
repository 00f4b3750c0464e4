"""Geometry of two views: models from matches by OpenCV's random sampling, and distances to them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np

from colmap_affrect.colmap.poses import Pose
from colmap_affrect.geometry.arrays import Array, Bools, Floats
from colmap_affrect.geometry.epipolar import epipolar_lines, sampson_errors
from colmap_affrect.geometry.two_views import essential_matrix, homogeneous

Points = Floats
Matrix = Array

MIN_HOMOGRAPHY_MATCHES, MIN_FUNDAMENTAL_MATCHES, MIN_POSE_MATCHES = 4, 8, 6
"""Of poses six: five leave several essential matrices, none of which another match supports."""


@dataclass(frozen=True)
class Ransac:
    """How to look for a model of (M, 2) and (M, 2) matches."""

    method: int  # ``cv2.RANSAC``, ``cv2.USAC_MAGSAC`` or another of OpenCV's
    # of an inlier (MAGSAC: largest noise) in px; of relative poses in units of the focal
    # length
    threshold: float
    confidence: float  # at which to end before all iterations
    max_num_iterations: int
    # decides the order of the matches: OpenCV draws the same samples every time
    random_seed: int = 0

    def reseeded(self, count: int) -> list[Self]:
        """Return as many of the same with seeds that follow each other."""
        return [replace(self, random_seed=self.random_seed + number) for number in range(count)]

    def homography(self, points1: Points, points2: Points) -> tuple[Matrix | None, int]:
        """Estimate image2_from_image1; also return the number of inliers."""
        return self._matrix(cv2.findHomography, MIN_HOMOGRAPHY_MATCHES, points1, points2)

    def fundamental_matrix(self, points1: Points, points2: Points) -> tuple[Matrix | None, int]:
        """Estimate F with x2' F x1 = 0; also return the number of inliers."""
        return self._matrix(cv2.findFundamentalMat, MIN_FUNDAMENTAL_MATCHES, points1, points2)

    def _matrix(
        self, find: Callable[..., Any], min_num_matches: int, points1: Points, points2: Points
    ) -> tuple[Matrix | None, int]:
        if len(points1) < min_num_matches:
            return None, 0
        order = np.random.default_rng(self.random_seed).permutation(len(points1))
        matrix, inliers = find(
            np.asarray(points1, dtype=np.float64)[order],
            np.asarray(points2, dtype=np.float64)[order],
            self.method,
            self.threshold,
            confidence=self.confidence,
            maxIters=self.max_num_iterations,
        )
        if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            return None, 0
        return np.asarray(matrix, dtype=np.float64), int(np.count_nonzero(inliers))

    def relative_pose(self, rays1: Points, rays2: Points) -> tuple[Pose | None, Bools]:
        """Estimate camera2_from_camera1, |t| = 1 (None if there is none), and its (N,) inliers.

        From five-point samples of (N, 2) x/z, y/z in front of each camera; NaN are never inliers.
        """
        inliers = np.zeros(len(rays1), dtype=bool)
        usable = np.flatnonzero(np.isfinite(rays1).all(axis=1) & np.isfinite(rays2).all(axis=1))
        if len(usable) < MIN_POSE_MATCHES:
            return None, inliers
        order = np.random.default_rng(self.random_seed).permutation(usable)
        first, second = np.ascontiguousarray(rays1[order]), np.ascontiguousarray(rays2[order])
        essential, mask = cv2.findEssentialMat(
            first,
            second,
            np.eye(3),
            method=self.method,
            prob=self.confidence,
            threshold=self.threshold,
            maxIters=self.max_num_iterations,
        )
        if essential is None or essential.shape != (3, 3):
            return None, inliers
        inliers[order] = mask.ravel() != 0
        if inliers.sum() < MIN_POSE_MATCHES:
            return None, inliers
        _, rotation, translation, _ = cv2.recoverPose(
            essential, first[inliers[order]], second[inliers[order]], np.eye(3)
        )
        pose = np.asarray(rotation, np.float64), np.asarray(translation, np.float64).ravel()
        return pose, inliers


def symmetric_epipolar_distances(matrix: Matrix | None, points1: Points, points2: Points) -> Array:
    """Return (N,) sqrt(d1^2 + d2^2) of points from their epipolar lines, px, as WxBS has it.

    Infinite without a matrix, and where a line is not defined.
    """
    if matrix is None:
        return np.full(len(points1), np.inf)
    lines1, lines2 = epipolar_lines(matrix, points1, points2)
    residuals = (homogeneous(points2) * lines2).sum(axis=1)
    slopes1, slopes2 = (np.square(lines[:, :2]).sum(axis=1) for lines in (lines1, lines2))
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.abs(residuals) * np.sqrt(1.0 / slopes1 + 1.0 / slopes2)
    return np.asarray(np.nan_to_num(distances, nan=np.inf))


def sampson_distances(pose: Pose, rays1: Points, rays2: Points) -> Array:
    """Return (N,) first-order distances of (N, 2) x/z, y/z from a camera2_from_camera1.

    In units of the focal length; infinite where they are not defined, as without a baseline.
    """
    if not pose[1].any():
        return np.full(len(rays1), np.inf)
    return np.nan_to_num(sampson_errors(essential_matrix(*pose), rays1, rays2), nan=np.inf)
