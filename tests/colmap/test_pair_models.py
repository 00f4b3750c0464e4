"""Geometries of pairs of two unlike cameras: matrices are not swapped, pixels begin at corners."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from strategies import Array
from unlike_cameras import LONG, POSE, WIDE

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import (
    decomposed_homography,
    pair_model,
    undistorted,
)
from colmap_affrect.geometry.two_views import essential_matrix


def points_of_a_scene() -> Array:
    """(N, 3) in the frame of the first camera."""
    return np.random.default_rng(4).uniform((-0.9, -0.8, 6.0), (0.6, 0.9, 9.0), (40, 3))


def points_of_a_plane() -> Array:
    """(N, 3) likewise, of a wall that is seen askew."""
    points = points_of_a_scene()
    points[:, 2] = 7.0 + 0.4 * points[:, 0] - 0.2 * points[:, 1]
    return points


def seen(points: Array, *, with_distortion: bool = True) -> tuple[Array, Array]:
    """(N, 2) px of points in both cameras."""
    moved = np.array([POSE * point for point in points])
    pixels = []
    for camera, own in ((WIDE, points), (LONG, moved)):
        if with_distortion:
            pixels.append(np.array([camera.img_from_cam(point) for point in own]))
        else:
            projected = own @ np.asarray(camera.calibration_matrix()).T
            pixels.append(projected[:, :2] / projected[:, 2:])
    return pixels[0], pixels[1]


@pytest.mark.parametrize(("camera", "number"), [(WIDE, 0), (LONG, 1)])
def test_pixels_without_distortion_are_those_of_the_calibration_matrix(
    camera: pycolmap.Camera, number: int
) -> None:
    points = points_of_a_scene()
    expected = seen(points, with_distortion=False)[number]
    found = undistorted(camera, seen(points)[number])
    assert_allclose(found, expected, atol=1e-6)


def test_matches_of_unlike_cameras_lie_on_their_epipolar_lines() -> None:
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
    geometry.E = essential_matrix(
        np.asarray(POSE.rotation.matrix()), np.asarray(POSE.translation)
    )
    model = pair_model(geometry, (WIDE, LONG), seen(points_of_a_scene()))
    assert model is not None
    rows = np.arange(40)
    assert model.errors(rows, rows).max() < 1e-6
    assert np.median(model.errors(rows, np.roll(rows, 1))) > 10.0


def test_a_homography_of_unlike_cameras_allows_their_pose() -> None:
    points = points_of_a_plane()
    normal = np.array([-0.4, 0.2, 1.0]) / 7.0  # normal @ point = 1 on the wall
    rotation = np.asarray(POSE.rotation.matrix())
    ours = rotation + np.outer(POSE.translation, normal)
    matrix1 = np.asarray(WIDE.calibration_matrix())
    matrix2 = np.asarray(LONG.calibration_matrix())
    homography = matrix2 @ ours @ np.linalg.inv(matrix1)
    first, second = seen(points, with_distortion=False)
    moved = np.hstack([first, np.ones((40, 1))]) @ homography.T
    assert_allclose(moved[:, :2] / moved[:, 2:], second, atol=1e-6)
    direction = POSE.translation / np.linalg.norm(POSE.translation)
    distances = []
    for turn, translation in decomposed_homography(homography, (WIDE, LONG)):
        distances.append(
            np.abs(turn - rotation).max() + np.abs(translation - direction).max()
        )
    assert min(distances) < 1e-6
