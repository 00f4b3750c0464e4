"""Two-view geometries of a COLMAP database as plain arrays, and how significant they are.

All points are in COLMAP's pixels: (0, 0) is the corner of the image.
"""

import math
from typing import TypeGuard

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.epipolar import (
    EpipolarModel,
    HomographyModel,
    PairModel,
    common_sign,
)
from colmap_affrect.geometry.significance import (
    log10_bayes_factor,
    log10_false_alarms,
    random_matches,
)
from colmap_affrect.geometry.tilts import are_individual_shapes, of_unit_area

Cameras = tuple[pycolmap.Camera, pycolmap.Camera]  # of the two images
Keypoints = tuple[Floats, Floats]  # (N, 2, 4 or 6) of each image, as in the database

PLANAR = (  # pairs that a homography explains: their epipolar geometry is arbitrary
    pycolmap.TwoViewGeometryConfiguration.PLANAR,
    pycolmap.TwoViewGeometryConfiguration.PANORAMIC,
    pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC,
)

CALIBRATED = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
# Frames of right matches are off by 5 to 10 degrees; measured
MAX_FRAME_ANGLE_DEG = 20.0
# Of frames that are turned at random; theory
CHANCE_OF_AGREEMENT = MAX_FRAME_ANGLE_DEG / 180.0
# Frames that agree by chance nearly always, upright ones for one, say nothing; theory
MAX_CHANCE = 0.99
# Of elements of shapes of area one; below they have no direction; numeric
MIN_VARIETY = 0.05
# Of a decomposed homography, in units of the distance of its plane; numeric
MIN_TRANSLATION = 1e-9


def pair_model(
    geometry: pycolmap.TwoViewGeometry, cameras: Cameras, keypoints: Keypoints
) -> PairModel | None:
    """Return what the keypoints of a pair can be tested with.

    The epipolar geometry of calibrated pairs holds in pixels without distortion.

    Args:
        geometry: of the pair.
        cameras: of the two images.
        keypoints: (M, 2 or more) of each image, in COLMAP's px; those of a row match.

    Returns:
        The model; None of a watermark, and of a geometry without matrices.
    """
    points = _positions(keypoints)
    if geometry.config in PLANAR and geometry.H is not None:
        return HomographyModel(np.asarray(geometry.H, np.float64), points)
    if geometry.config == pycolmap.TwoViewGeometryConfiguration.WATERMARK:
        return None
    return _epipolar_model(geometry, cameras, points)


def _epipolar_model(
    geometry: pycolmap.TwoViewGeometry, cameras: Cameras, points: tuple[Array, Array]
) -> EpipolarModel | None:
    """Return the epipolar geometry of a pair, by its essential matrix where it is calibrated."""
    is_calibrated = (
        geometry.config != pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
    )
    essential = geometry.E
    fundamental = geometry.F
    if is_calibrated and _is_given(essential):
        matrix1 = cameras[0].calibration_matrix()
        matrix2 = cameras[1].calibration_matrix()
        fundamental = np.linalg.inv(matrix2).T @ essential @ np.linalg.inv(matrix1)
        points = (
            undistorted(cameras[0], points[0]),
            undistorted(cameras[1], points[1]),
        )
    if not _is_given(fundamental):
        return None
    sample_size = 5 if geometry.config == CALIBRATED else 7
    return EpipolarModel(np.asarray(fundamental, np.float64), points, sample_size)


def _is_given(matrix: Array | None) -> TypeGuard[Array]:
    """Tell whether a geometry has a matrix; one of zeros is none."""
    return matrix is not None and bool(np.any(matrix))


def _positions(keypoints: Keypoints) -> tuple[Array, Array]:
    """Return the (M, 2) positions of the keypoints of two images."""
    points1 = np.asarray(keypoints[0][:, :2], np.float64)
    points2 = np.asarray(keypoints[1][:, :2], np.float64)
    return points1, points2


def undistorted(camera: pycolmap.Camera, points: Array) -> Array:
    """Return (N, 2) pixels as a camera without distortion has them, NaN where it cannot be told."""
    if not len(points):
        return points
    matrix = np.asarray(camera.calibration_matrix(), np.float64)
    rays = np.asarray(camera.cam_from_img(points), np.float64)
    return np.asarray(rays @ matrix[:2, :2].T + matrix[:2, 2])


def decomposed_homography(homography: Array, cameras: Cameras) -> list[Pose]:
    """Return the relative poses, |t| = 1, that a homography of px allows; none of a rotation."""
    matrix1 = np.asarray(cameras[0].calibration_matrix(), np.float64)
    matrix2 = np.asarray(cameras[1].calibration_matrix(), np.float64)
    normalized = np.linalg.inv(matrix2) @ homography @ matrix1
    _, rotations, translations, _ = cv2.decomposeHomographyMat(normalized, np.eye(3))
    poses = []
    for turn, translation in zip(rotations, translations, strict=True):
        length = float(np.linalg.norm(translation))
        if length > MIN_TRANSLATION:
            direction = np.asarray(translation, np.float64).ravel() / length
            poses.append((np.asarray(turn, np.float64), direction))
    return poses


def homography_matrix(geometry: pycolmap.TwoViewGeometry) -> Array | None:
    """Return the (3, 3) homography of a geometry, None where there is none."""
    return np.asarray(geometry.H, np.float64) if _is_given(geometry.H) else None


def significance(
    geometry: pycolmap.TwoViewGeometry,
    cameras: Cameras,
    keypoints: Keypoints,
    max_error_px: float,
) -> float:
    """Return the decimal logarithm of how many pairs chance needs to have one that looks as good.

    Args:
        geometry: of the pair.
        cameras: of the two images.
        keypoints: of the raw matches, (M, 2, 4 or 6) of each image as in the database; those of a
            row match. Of 2 columns positions count alone.
        max_error_px: largest error of an inlier.

    Returns:
        The logarithm; infinite for a watermark, which cannot be tested.
    """
    # Points that a camera cannot undistort are no inliers
    with np.errstate(all="ignore"):
        model = pair_model(geometry, cameras, keypoints)
        if model is None:
            return math.inf
        rows = np.arange(len(keypoints[0]))
        inliers = rows[model.errors(rows, rows) <= max_error_px]
        hits = model.errors(*random_matches(len(rows))) <= max_error_px
        chance = max(float(hits.mean()), 1.0 / len(hits))
        alarms = log10_false_alarms(
            num_matches=len(rows),
            num_inliers=len(inliers),
            sample_size=model.sample_size,
            chance=chance,
        )
        first = telling_shapes(keypoints[0])
        second = telling_shapes(keypoints[1])
        if math.isinf(alarms) or first is None or second is None:
            return -alarms
        return _frame_evidence(model, inliers, (first, second)) - alarms


def telling_shapes(keypoints: Floats) -> Array | None:
    """Return the (N, 2, 2) shapes of keypoints of 4 or 6 columns, up to a factor.

    None without any, if all are alike, or only views differ.
    """
    parts: Array = np.asarray(keypoints[:, 2:], np.float64)
    if not parts.size:
        return None
    shapes: Array = parts.reshape(len(parts), -1, 2)
    if parts.shape[1] == 2:
        shapes = parts[:, 0, None, None] * rotation(parts[:, 1])
    alike = np.ptp(of_unit_area(shapes), axis=0).max() < MIN_VARIETY
    return None if alike or not are_individual_shapes(shapes) else shapes


def _frame_evidence(
    model: PairModel, inliers: Indices, shapes: tuple[Array, Array]
) -> float:
    """Return the Bayes factor of the agreement of frames, as a decimal logarithm."""
    limit = math.cos(math.radians(MAX_FRAME_ANGLE_DEG))
    signs = (1.0, -1.0) if model.has_sign else (1.0,)
    first, second = random_matches(len(inliers))
    by_chance = model.cosines(inliers[first], inliers[second], shapes)
    larger = max([float((by_chance * sign >= limit).mean()) for sign in signs])
    chance = min(max(larger, CHANCE_OF_AGREEMENT), MAX_CHANCE)
    cosines = model.cosines(inliers, inliers, shapes)
    sign = common_sign(cosines) if model.has_sign else 1.0
    num_agreeing = int(np.count_nonzero(cosines * sign >= limit))
    # The better of two signs: chance has two tries.
    return log10_bayes_factor(len(inliers), num_agreeing, chance) - math.log10(
        len(signs)
    )
