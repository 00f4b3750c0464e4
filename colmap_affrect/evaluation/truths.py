"""The three kinds of truth: scores of matches by them, and the columns of their tables.

A truth scores (M, 2) and (M, 2) matched points, pixel-centre px of the stored images; its repr has
all that it knows. Results of failed pairs have infinite errors.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from statistics import fmean, median_low
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

CONFIDENCE = 0.9999  # at which estimators may end before all iterations
NUM_ESTIMATES = 5  # orders of the matches, of which the one of median error counts
MIN_POSE_MATCHES = 6  # five leave several essential matrices, none of which another supports
MAX_EPIPOLAR_NOISE_PX = 1.0  # that USAC_MAGSAC assumes for fundamental matrices
CORRECT_PX = 3.0  # of correct matches: transfer error in image 2, or Sampson distance from a pose
GRID_STEP_PX = 4
MAX_ERROR_PX, MAX_ERROR_DEG = 5.0, 5.0  # homographies and rotations of solved pairs are better
HOMOGRAPHY_LIMITS_PX = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)  # the paper's table on EVD
MAX_AUC_ERROR_DEG = 10.0
NUM_WXBS_LIMITS = 20  # the score of WxBS is the mean share within 0, 1, ... 19 px


class ScoreOptions(Options):
    """How models are estimated from matches."""

    threshold_px: Annotated[float, within(0.01, 1000.0)] = 0.5
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
    num_correct: int | None = None  # matches that agree with the truth; None where it cannot say
    direction_error_deg: float = math.inf  # of poses, beside the error of the rotation
    solved: float = 0.0  # how far it counts as matched: 1 or 0 where there is a threshold
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
    level: str = ""  # of escalation, that decided: its rectifier, ``none`` if none was verified
    failure: str = ""  # why the pair counts as failed, with an infinite error


Results = Sequence[PairResult]


def estimate_matrix(
    find: Any, points: Sides, method: int, threshold_px: float, options: ScoreOptions
) -> tuple[Array | None, int]:
    """Estimate a (3, 3) homography or fundamental matrix, x2 ~ H x1, x2' F x1 = 0, and its inliers.

    ``find`` and ``method`` are OpenCV's; the seed is of the order of the matches, as OpenCV draws
    the same samples every time.
    """
    count = len(points[0])
    if count < (4 if find is cv2.findHomography else 8):
        return None, 0
    order = np.random.default_rng(options.random_seed).permutation(count)
    first, second = (np.asarray(side, dtype=np.float64)[order] for side in points)
    limits = dict(confidence=CONFIDENCE, maxIters=options.max_num_iterations)
    matrix, inliers = find(first, second, method, threshold_px, **limits)
    if matrix is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None, 0
    return np.asarray(matrix, dtype=np.float64), int(np.count_nonzero(inliers))


def estimate_pose(rays: Sides, threshold: float, options: ScoreOptions) -> tuple[Pose | None, int]:
    """Estimate camera2_from_camera1, |t| = 1, from five-point samples, and count its inliers.

    ``rays`` are (M, 2) x/z, y/z in front of each camera, the threshold in focal lengths; rays that
    are not finite are never inliers. For the seed see :func:`estimate_matrix`.
    """
    usable = np.flatnonzero(np.isfinite(np.hstack(rays)).all(axis=1))
    if len(usable) < MIN_POSE_MATCHES:
        return None, 0
    order = np.random.default_rng(options.random_seed).permutation(usable)
    first, second = (np.ascontiguousarray(side[order]) for side in rays)
    limits = CONFIDENCE, threshold, options.max_num_iterations
    essential, mask = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, *limits)
    if essential is None or essential.shape != (3, 3):
        return None, 0
    inliers = mask.ravel() != 0
    if inliers.sum() < MIN_POSE_MATCHES:
        return None, int(inliers.sum())
    _, turn, move, _ = cv2.recoverPose(essential, first[inliers], second[inliers], np.eye(3))
    return (np.asarray(turn, np.float64), np.ravel(move).astype(np.float64)), int(inliers.sum())


@dataclass(frozen=True, eq=False)
class TrueHomography:
    """The (3, 3) image2_from_image1 of pixel-centre px, > 0 where visible; sizes of images."""

    matrix: Array
    size1: Size
    size2: Size

    @classmethod
    def of(cls, matrix: Array, paths: Sequence[Path], what: str) -> "TrueHomography":
        """Return the truth of two image files, of a (3, 3) matrix of any scale and sign.

        ImageError when one cannot be read, AffrectError when image 2 shows no part of image 1.
        """
        size1, size2 = ((gray.shape[1], gray.shape[0]) for gray in map(read_gray, paths))
        both = [cls(sign * matrix, size1, size2) for sign in (1.0, -1.0)]
        found = max(both, key=lambda truth: len(truth.visible))
        if not len(found.visible):
            raise AffrectError(f"{what} shows no part of image 1 in image 2")
        return found

    @cached_property
    def visible(self) -> Points:
        """(N, 2) pixel centres of image 1 that image 2 shows, each ``GRID_STEP_PX`` in x and y."""
        columns, rows = (np.arange(0, extent, GRID_STEP_PX) for extent in self.size1)
        points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
        points = points[third_coordinates(self.matrix, points) > 0]
        return points[is_inside(project(self.matrix, points), self.size2)]

    def error_px(self, estimate: Array | None) -> float:
        """Return the mean distance in image 2 between truth and estimate, over the visible part.

        Infinite without an estimate, or when its horizon runs through that part.
        """
        if estimate is None:
            return math.inf
        signed = estimate * np.sign(third_coordinates(estimate, self.visible).sum())
        target = project(self.matrix, self.visible)
        return float(transfer_errors(signed, self.visible, target).mean())

    def score(self, points1: Points, points2: Points, options: ScoreOptions) -> PairScore:
        """Score by the paper's RANSAC, in px."""
        given = cv2.findHomography, (points1, points2), cv2.RANSAC, options.threshold_px
        matrix, num_inliers = estimate_matrix(*given, options)
        error = self.error_px(matrix)
        num_correct = int((transfer_errors(self.matrix, points1, points2) < CORRECT_PX).sum())
        solved = float(error < MAX_ERROR_PX)
        return PairScore(error, num_inliers, num_correct, solved=solved, kind="homographies")


def transfer_errors(matrix: Array, points1: Points, points2: Points) -> Array:
    """Return the (N,) distances in image 2, in px, of (N, 2) points 1 carried over to points 2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.linalg.norm(project(matrix, points1) - points2, axis=1)
    return np.where(third_coordinates(matrix, points1) > 0, distances, np.inf)


def third_coordinates(homography: Array, points: Points) -> Array:
    """Return the (N,) third coordinates of (N, 2) points carried over, before the division."""
    return np.asarray(points @ homography[2, :2] + homography[2, 2])


@dataclass(frozen=True, eq=False)
class TruePose:
    """The cameras of a pair, which are COLMAP's, and its true camera2_from_camera1."""

    cameras: tuple[pycolmap.Camera, pycolmap.Camera]
    pose: Pose

    def score(self, points1: Points, points2: Points, options: ScoreOptions) -> PairScore:
        """Score by the paper's RANSAC: the error is that of the rotation, in degrees.

        ``direction_error_deg`` is the angle between the directions of the translations. Matches
        within ``CORRECT_PX`` of the true epipolar lines are correct, wrong ones by chance among
        them. Distances are in px by the mean focal length of the two cameras.
        """
        both = rays(self.cameras[0], points1), rays(self.cameras[1], points2)
        focal_px = float(np.mean([camera.mean_focal_length() for camera in self.cameras]))
        pose, num_inliers = estimate_pose(both, options.threshold_px / focal_px, options)
        error, direction = (math.inf, math.inf) if pose is None else pose_errors(pose, self.pose)
        distances_px = focal_px * sampson_errors(essential_matrix(*self.pose), *both)
        has_baseline = self.pose[1].any()  # without, distances are not defined
        num_correct = int((distances_px < CORRECT_PX).sum()) if has_baseline else 0
        solved = float(error < MAX_ERROR_DEG)
        return PairScore(error, num_inliers, num_correct, direction, solved, "poses")


def rays(camera: pycolmap.Camera, points: Points) -> Points:
    """Turn (N, 2) pixel-centre points into (N, 2) x/z, y/z; NaN for what a lens cannot produce."""
    pixels = colmap_from_pixel(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    return np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """(N, 4) points that correspond, x1, y1, x2, y2 in pixel-centre px."""

    points: Points

    def score(self, points1: Points, points2: Points, options: ScoreOptions) -> PairScore:
        """Score by the fundamental matrix of OpenCV's USAC_MAGSAC, as WxBS does.

        ``error`` is the median of the symmetric epipolar distances of the correspondences, in px.
        The pair is solved as far as :func:`wxbs_score` says.
        """
        given = cv2.findFundamentalMat, (points1, points2), cv2.USAC_MAGSAC, MAX_EPIPOLAR_NOISE_PX
        found = []
        for seed in range(options.random_seed, options.random_seed + NUM_ESTIMATES):
            matrix, count = estimate_matrix(*given, options.changed(random_seed=seed))
            distances = symmetric_epipolar_distances(matrix, *np.hsplit(self.points, 2))
            found.append((float(np.median(distances)), count, seed, distances))
        error, count, _, distances = median_low(found)
        return PairScore(error, count, solved=wxbs_score(distances), kind="correspondences")


def symmetric_epipolar_distances(matrix: Array | None, points1: Points, points2: Points) -> Array:
    """Return (N,) sqrt(d1^2 + d2^2) from epipolar lines, px; infinite if undefined."""
    if matrix is None:
        return np.full(len(points1), np.inf)
    lines1, lines2 = epipolar_lines(matrix, points1, points2)
    residuals = (homogeneous(points2) * lines2).sum(axis=1)
    slopes1, slopes2 = (np.square(lines[:, :2]).sum(axis=1) for lines in (lines1, lines2))
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.abs(residuals) * np.sqrt(1.0 / slopes1 + 1.0 / slopes2)
    return np.asarray(np.nan_to_num(distances, nan=np.inf))


def wxbs_score(distances_px: Array) -> float:
    """Return the mean share of (N,) distances within 0, 1, ... 19 px, as WxBS has it."""
    return float(np.mean([(distances_px <= limit).mean() for limit in range(NUM_WXBS_LIMITS)]))


def columns(results: Results) -> dict[str, dict[str, float]]:
    """Return the columns of a table for each kind of truth; results without a truth are in none."""
    makers = {
        "homographies": homography_columns,
        "correspondences": lambda own: {"WxBS score": fmean(result.solved for result in own)},
        "poses": pose_columns,
    }
    by_kind = {kind: [result for result in results if result.kind == kind] for kind in makers}
    return {kind: makers[kind](own) for kind, own in by_kind.items() if own}


def homography_columns(results: Results) -> dict[str, float]:
    """Count the pairs whose error is below each limit."""
    return {
        f"< {limit:g} px": float(sum(result.error < limit for result in results))
        for limit in HOMOGRAPHY_LIMITS_PX
    }


def pose_columns(results: Results) -> dict[str, float]:
    """Return shares of pairs with a rotation error below 5 degrees, by category and of all.

    And the area under the curve of recall over the larger of rotation and direction error, up to
    10 degrees, as a share of 1.
    """
    titles = dict.fromkeys([*(result.category for result in results if result.category), "all"])
    shares = {
        title: fmean(one.error < MAX_ERROR_DEG for one in results if title in ("all", one.category))
        for title in titles
    }
    largest = [max(result.error, result.direction_error_deg) for result in results]
    area = fmean(max(0.0, 1.0 - error / MAX_AUC_ERROR_DEG) for error in largest)
    return {**shares, f"pose AUC {MAX_AUC_ERROR_DEG:g}°": area}
