"""The three kinds of ground truth: scores of matches by them, and the columns of their tables.

A truth scores (M, 2) and (M, 2) matched points, pixel-centre px of the images as they are stored.
Results of failed pairs have infinite errors. Protocols are those of V. Vávra, D. Mishkin and
J. Matas, *Matching with AffNet based rectifications*, 2022, called "the paper" here, and of
D. Mishkin et al., *WxBS: Wide Baseline Stereo Generalizations*, 2015.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose, pose_errors
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.conventions import colmap_from_pixel, is_inside
from colmap_affrect.geometry.epipolar import epipolar_lines, sampson_errors
from colmap_affrect.geometry.two_views import essential_matrix, homogeneous
from colmap_affrect.images.reading import read_gray
from colmap_affrect.options import Options, within

Points = Floats
Sides = tuple[Floats, Floats]  # points or rays of both images
Size = tuple[int, int]  # (width, height) in px

CONFIDENCE = 0.9999  # at which estimators may end before all iterations; paper
# With other orders of the matches; the one of median error counts; resource
NUM_ESTIMATES = 5
MIN_HOMOGRAPHY_MATCHES = 4  # determine a homography; theory
MIN_FUNDAMENTAL_MATCHES = 8  # determine a fundamental matrix linearly; theory
# Five determine several essential matrices, without support for any of them; theory
MIN_POSE_MATCHES = 6
MAX_EPIPOLAR_NOISE_PX = 1.0  # that USAC_MAGSAC assumes for fundamental matrices; judged
# Largest transfer error or Sampson distance of a correct match; same as
# VerificationOptions.max_error_px
CORRECT_PX = 3.0
# In x and y, of the pixels over which the error of a homography is a mean; resource
GRID_STEP_PX = 4
# Of the homography of a solved pair; a column of the paper's table on EVD
MAX_ERROR_PX = 5.0
MAX_ERROR_DEG = 5.0  # of the rotation of a solved pair: the paper's limit
HOMOGRAPHY_LIMITS_PX = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)  # the paper's table on EVD
# Of the area under the curve of recall; that of the IMC; paper
MAX_AUC_ERROR_DEG = 10.0
# The score of WxBS is the mean share within 0, 1, ... 19 px; paper
NUM_WXBS_LIMITS = 20


class ScoreOptions(Options):
    """How models are estimated from matches."""

    threshold_px: Annotated[float, within(0.01, 1000.0)] = 0.5  # paper
    """Largest error of an inlier of plain RANSAC, for homographies and poses."""
    max_num_iterations: Annotated[int, within(1, 1_000_000_000)] = 100_000
    """As the paper says; its numbers of poses are those of 1000."""
    random_seed: int = 0
    """Of the order in which matches are taken."""


@dataclass(frozen=True)
class PairScore:
    """How good the matches of one pair are."""

    error: float  # of the protocol, px or degrees; infinite where no model was found
    num_inliers: int  # of the model that was estimated
    # Matches that agree with the truth; None where it cannot tell
    num_correct: int | None = None
    direction_error_deg: float = math.inf  # of the translation of poses
    solved: float = 0.0  # from 0 to 1; 1 or 0 where the protocol has a threshold
    kind: str = ""  # of the truth, as tables name it; empty without one


@dataclass(frozen=True, kw_only=True)
class PairResult(PairScore):
    """The score of one pair by one recipe: what ``evaluation.json`` lists."""

    name: str
    category: str = ""
    num_matches: int = 0
    num_keypoints: tuple[int, int] = (0, 0)
    seconds: float = 0.0
    # ``extract`` (of images that no other pair had before), ``match``, ``estimate``
    seconds_by_step: Mapping[str, float] = field(default_factory=dict)
    # the rectifier of the level that was scored, ``none`` if no level was verified; empty for a
    # recipe of one level
    level: str = ""
    failure: str = ""  # why the pair counts as failed, with an infinite error


Results = Sequence[PairResult]


def estimate_matrix(
    find: Any, points: Sides, method: int, threshold_px: float, options: ScoreOptions
) -> tuple[Array | None, int]:
    """Estimate a homography, x2 ~ H x1, or a fundamental matrix, x2' F x1 = 0.

    Args:
        find: ``cv2.findHomography`` or ``cv2.findFundamentalMat``.
        points: (M, 2) px, by image.
        method: OpenCV's constant.
        threshold_px: of inliers.
        options: iterations, and the seed of the order of the matches: OpenCV draws the same
            samples every time.

    Returns:
        The (3, 3) matrix, None where there is none, and the number of its inliers.
    """
    count = len(points[0])
    is_homography = find is cv2.findHomography
    least = MIN_HOMOGRAPHY_MATCHES if is_homography else MIN_FUNDAMENTAL_MATCHES
    if count < least:
        return None, 0
    order = np.random.default_rng(options.random_seed).permutation(count)
    first = np.asarray(points[0], dtype=np.float64)[order]
    second = np.asarray(points[1], dtype=np.float64)[order]
    matrix, inliers = find(
        first,
        second,
        method,
        threshold_px,
        confidence=CONFIDENCE,
        maxIters=options.max_num_iterations,
    )
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None, 0
    return np.asarray(matrix, dtype=np.float64), int(np.count_nonzero(inliers))


def estimate_pose(
    rays: Sides, threshold: float, options: ScoreOptions
) -> tuple[Pose | None, int]:
    """Estimate a relative pose by RANSAC of five-point samples.

    Args:
        rays: (M, 2) x/z, y/z in front of each camera; those that are not finite are never inliers.
        threshold: of inliers, in focal lengths.
        options: iterations, and the seed as in :func:`estimate_matrix`.

    Returns:
        camera2_from_camera1 with |t| = 1, None where there is none, and the number of its inliers.
    """
    usable = np.flatnonzero(np.isfinite(np.hstack(rays)).all(axis=1))
    if len(usable) < MIN_POSE_MATCHES:
        return None, 0
    order = np.random.default_rng(options.random_seed).permutation(usable)
    first = np.ascontiguousarray(rays[0][order])
    second = np.ascontiguousarray(rays[1][order])
    essential, mask = cv2.findEssentialMat(
        first,
        second,
        np.eye(3),
        cv2.RANSAC,
        CONFIDENCE,
        threshold,
        options.max_num_iterations,
    )
    if essential is None or essential.shape != (3, 3):
        return None, 0
    is_inlier = mask.ravel() != 0
    num_inliers = int(is_inlier.sum())
    if num_inliers < MIN_POSE_MATCHES:
        return None, num_inliers
    _, rotation, translation, _ = cv2.recoverPose(
        essential, first[is_inlier], second[is_inlier], np.eye(3)
    )
    pose = (np.asarray(rotation, np.float64), np.ravel(translation).astype(np.float64))
    return pose, num_inliers


@dataclass(frozen=True, eq=False)
class TrueHomography:
    """The homography of a pair."""

    # (3, 3) image2_from_image1 of pixel-centre px; its third coordinates are > 0 where image 1 is
    # visible in image 2
    matrix: Array
    size1: Size  # of image 1
    size2: Size  # of image 2

    @classmethod
    def from_files(
        cls, matrix: Array, paths: Sequence[Path], what: str
    ) -> "TrueHomography":
        """Return the truth of two image files.

        Args:
            matrix: (3, 3) image2_from_image1 of pixel-centre px, of any scale and sign.
            paths: of both images, whose sizes are read.
            what: an error begins with it.

        Raises:
            ImageError: an image cannot be read.
            AffrectError: image 2 shows no part of image 1.
        """
        sizes = []
        for path in paths:
            height, width = read_gray(path).shape
            sizes.append((width, height))
        truth = cls(matrix, *sizes)
        opposite = cls(-1.0 * matrix, *sizes)
        if len(opposite.visible) > len(truth.visible):
            truth = opposite
        if not len(truth.visible):
            raise AffrectError(f"{what} shows no part of image 1 in image 2")
        return truth

    @cached_property
    def visible(self) -> Points:
        """(N, 2) pixel centres of image 1 that image 2 shows, each ``GRID_STEP_PX`` in x and y."""
        width, height = self.size1
        columns = np.arange(0, width, GRID_STEP_PX)
        rows = np.arange(0, height, GRID_STEP_PX)
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        points = grid.reshape(-1, 2).astype(np.float64)
        points = points[third_coordinates(self.matrix, points) > 0]
        return points[is_inside(project(self.matrix, points), self.size2)]

    def error_px(self, estimate: Array | None) -> float:
        """Return the mean distance in image 2 between truth and estimate, over the visible part.

        It is infinite without an estimate, or when its horizon runs through that part.
        """
        if estimate is None:
            return math.inf
        signed = estimate * np.sign(third_coordinates(estimate, self.visible).sum())
        target = project(self.matrix, self.visible)
        return float(transfer_errors(signed, self.visible, target).mean())

    def score(
        self, points1: Points, points2: Points, options: ScoreOptions
    ) -> PairScore:
        """Score matches by the paper's RANSAC.

        Args:
            points1: (M, 2) px in image 1.
            points2: (M, 2) px in image 2.
            options: of RANSAC.

        Returns:
            The score; its error is :meth:`error_px`.
        """
        matrix, num_inliers = estimate_matrix(
            find=cv2.findHomography,
            points=(points1, points2),
            method=cv2.RANSAC,
            threshold_px=options.threshold_px,
            options=options,
        )
        error = self.error_px(matrix)
        is_correct = transfer_errors(self.matrix, points1, points2) < CORRECT_PX
        return PairScore(
            error=error,
            num_inliers=num_inliers,
            num_correct=int(is_correct.sum()),
            solved=float(error < MAX_ERROR_PX),
            kind="homographies",
        )


def transfer_errors(matrix: Array, points1: Points, points2: Points) -> Array:
    """Return the distances in image 2 of points from where a homography has them.

    Args:
        matrix: (3, 3) image2_from_image1.
        points1: (N, 2) px in image 1.
        points2: (N, 2) px in image 2.

    Returns:
        (N,) px, infinite behind the horizon.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.linalg.norm(project(matrix, points1) - points2, axis=1)
    return np.where(third_coordinates(matrix, points1) > 0, distances, np.inf)


def third_coordinates(homography: Array, points: Points) -> Array:
    """Return the (N,) third coordinates of (N, 2) points that a (3, 3) homography maps."""
    return np.asarray(points @ homography[2, :2] + homography[2, 2])


@dataclass(frozen=True, eq=False)
class TruePose:
    """The cameras and the relative pose of a pair."""

    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    pose: Pose  # camera2_from_camera1

    def score(
        self, points1: Points, points2: Points, options: ScoreOptions
    ) -> PairScore:
        """Score matches by the paper's RANSAC.

        Matches within ``CORRECT_PX`` of the true epipolar lines count as correct, also wrong ones
        that are there by chance. Distances are in px by the mean focal length of the two cameras.

        Args:
            points1: (M, 2) px in image 1.
            points2: (M, 2) px in image 2.
            options: of RANSAC.

        Returns:
            The score. Its error is the angle of the rotations, ``direction_error_deg`` that of the
            directions of the translations, in degrees.
        """
        camera1, camera2 = self.cameras
        both = (rays(camera1, points1), rays(camera2, points2))
        focal_px = float(
            np.mean([camera1.mean_focal_length(), camera2.mean_focal_length()])
        )
        pose, num_inliers = estimate_pose(
            both, options.threshold_px / focal_px, options
        )
        rotation_deg = math.inf
        direction_deg = math.inf
        if pose is not None:
            rotation_deg, direction_deg = pose_errors(pose, self.pose)
        distances_px = focal_px * sampson_errors(essential_matrix(*self.pose), *both)
        _, translation = self.pose
        has_baseline = translation.any()  # else distances are not defined
        return PairScore(
            error=rotation_deg,
            num_inliers=num_inliers,
            num_correct=int((distances_px < CORRECT_PX).sum()) if has_baseline else 0,
            direction_error_deg=direction_deg,
            solved=float(rotation_deg < MAX_ERROR_DEG),
            kind="poses",
        )


def rays(camera: pycolmap.Camera, points: Points) -> Points:
    """Return (N, 2) x/z, y/z of (N, 2) pixel-centre points; NaN for what a lens cannot produce."""
    pixels = colmap_from_pixel(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    return np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Points of a pair that a person has marked."""

    points: Points  # (N, 4) x1, y1, x2, y2 in pixel-centre px

    def score(
        self, points1: Points, points2: Points, options: ScoreOptions
    ) -> PairScore:
        """Score matches by the fundamental matrix of OpenCV's USAC_MAGSAC, as WxBS does.

        Args:
            points1: (M, 2) px in image 1.
            points2: (M, 2) px in image 2.
            options: of the estimates; the one of median error is scored.

        Returns:
            The score. Its error is the median of the symmetric epipolar distances of the
            correspondences in px, and the pair is solved as far as :func:`wxbs_score` says.
        """
        estimates = list[_Estimate]()
        for seed in range(options.random_seed, options.random_seed + NUM_ESTIMATES):
            matrix, num_inliers = estimate_matrix(
                find=cv2.findFundamentalMat,
                points=(points1, points2),
                method=cv2.USAC_MAGSAC,
                threshold_px=MAX_EPIPOLAR_NOISE_PX,
                options=options.changed(random_seed=seed),
            )
            distances = symmetric_epipolar_distances(matrix, *np.hsplit(self.points, 2))
            estimates.append(_Estimate(distances, num_inliers))
        # Sorting keeps the order of seeds where all else is equal.
        estimates.sort(key=lambda estimate: (estimate.error_px, estimate.num_inliers))
        median = estimates[(len(estimates) - 1) // 2]
        return PairScore(
            error=median.error_px,
            num_inliers=median.num_inliers,
            solved=wxbs_score(median.distances_px),
            kind="correspondences",
        )


@dataclass(frozen=True)
class _Estimate:
    """A fundamental matrix by some order of the matches."""

    distances_px: Array  # (N,) of correspondences
    num_inliers: int

    @property
    def error_px(self) -> float:
        """The median of the distances."""
        return float(np.median(self.distances_px))


def symmetric_epipolar_distances(
    matrix: Array | None, points1: Points, points2: Points
) -> Array:
    """Return sqrt(d1^2 + d2^2) of the distances of points from epipolar lines.

    Args:
        matrix: (3, 3) fundamental matrix, x2' F x1 = 0, or None.
        points1: (N, 2) px in image 1.
        points2: (N, 2) px in image 2.

    Returns:
        (N,) px, infinite where they are not defined.
    """
    if matrix is None:
        return np.full(len(points1), np.inf)
    lines1, lines2 = epipolar_lines(matrix, points1, points2)
    residuals = (homogeneous(points2) * lines2).sum(axis=1)
    slopes1 = np.square(lines1[:, :2]).sum(axis=1)
    slopes2 = np.square(lines2[:, :2]).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.abs(residuals) * np.sqrt(1.0 / slopes1 + 1.0 / slopes2)
    return np.asarray(np.nan_to_num(distances, nan=np.inf))


def wxbs_score(distances_px: Array) -> float:
    """Return the mean share of (N,) distances within 0, 1, ... 19 px, as WxBS has it."""
    return float(
        np.mean([(distances_px <= limit).mean() for limit in range(NUM_WXBS_LIMITS)])
    )


def columns(results: Results) -> dict[str, dict[str, float]]:
    """Return the columns of a table for each kind of truth; results without a truth are in none."""
    makers = {
        "homographies": homography_columns,
        "correspondences": correspondence_columns,
        "poses": pose_columns,
    }
    columns = {}
    for kind, make in makers.items():
        of_kind = [result for result in results if result.kind == kind]
        if of_kind:
            columns[kind] = make(of_kind)
    return columns


def homography_columns(results: Results) -> dict[str, float]:
    """Return the number of pairs whose error is below each limit."""
    errors_px = np.array([result.error for result in results])
    columns = {}
    for limit_px in HOMOGRAPHY_LIMITS_PX:
        columns[f"< {limit_px:g} px"] = float(np.count_nonzero(errors_px < limit_px))
    return columns


def correspondence_columns(results: Results) -> dict[str, float]:
    """Return the mean score of WxBS."""
    return {"WxBS score": fmean(result.solved for result in results)}


def pose_columns(results: Results) -> dict[str, float]:
    """Return how many rotations are right, and how exact poses are.

    Returns:
        The shares of pairs whose rotation error is below ``MAX_ERROR_DEG``, by category and of
        all. Then the area under the curve of recall over the larger of rotation and direction
        error, up to ``MAX_AUC_ERROR_DEG``, as a share of 1.
    """
    by_title: dict[str, list[bool]] = {}
    areas = []
    for result in results:
        if result.category:
            by_title.setdefault(result.category, []).append(
                result.error < MAX_ERROR_DEG
            )
        error_deg = max(result.error, result.direction_error_deg)
        areas.append(max(0.0, 1.0 - error_deg / MAX_AUC_ERROR_DEG))
    by_title["all"] = [result.error < MAX_ERROR_DEG for result in results]
    shares = {title: fmean(is_right) for title, is_right in by_title.items()}
    return {**shares, f"pose AUC {MAX_AUC_ERROR_DEG:g}°": fmean(areas)}
