"""Epipolar directions that frames carry over, on planes seen by two asymmetric cameras."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_affrect.geometry.epipolar import (
    EpipolarModel,
    common_sign,
    epipolar_lines,
    rotation_cosines,
    sampson_errors,
)

K1 = np.array([[700.0, 0.0, 310.0], [0.0, 720.0, 255.0], [0.0, 0.0, 1.0]])
K2 = np.array([[900.0, 0.0, 400.0], [0.0, 880.0, 290.0], [0.0, 0.0, 1.0]])


def rotation(degrees: tuple[float, float, float]) -> NDArray[np.float64]:
    x, y, z = np.deg2rad(degrees)
    about_x = [[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]]
    about_y = [[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]]
    about_z = [[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]]
    return np.array(about_z) @ np.array(about_y) @ np.array(about_x)


@pytest.fixture(scope="module")
def plane() -> dict[str, NDArray[np.float64]]:
    """Points of a slanted plane in both images, with the true local affine maps."""
    R = rotation((4.0, -25.0, 11.0))
    t = np.array([1.3, -0.2, 0.4])
    normal = np.array([0.3, -0.2, -1.0])
    homography = K2 @ (R - np.outer(t, normal) / 6.0) @ np.linalg.inv(K1)
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    fundamental = np.linalg.inv(K2).T @ skew @ R @ np.linalg.inv(K1)

    def warp(points: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = np.c_[points, np.ones(len(points))] @ homography.T
        return np.asarray(moved[:, :2] / moved[:, 2:])

    points1 = np.random.default_rng(3).uniform((40, 30), (600, 450), (60, 2))
    step = 1e-4
    maps = np.stack(
        [
            (warp(points1 + step * e) - warp(points1 - step * e)) / (2 * step)
            for e in np.eye(2)
        ],
        axis=2,
    )
    return {
        "F": fundamental,
        "points1": points1,
        "points2": warp(points1),
        "maps": maps,
    }


def test_matches_lie_on_their_epipolar_lines_and_others_as_far_as_they_were_moved(
    plane: dict[str, NDArray[np.float64]],
) -> None:
    F = plane["F"]
    points1 = plane["points1"]
    points2 = plane["points2"]
    assert sampson_errors(F, points1, points2).max() < 1e-6
    lines1, lines2 = epipolar_lines(F, points1, points2)
    for lines, points in ((lines1, points1), (lines2, points2)):
        along = (lines[:, :2] * points).sum(axis=1) + lines[:, 2]
        assert np.abs(along / np.linalg.norm(lines[:, :2], axis=1)).max() < 1e-6
    normals = lines2[:, :2] / np.linalg.norm(lines2[:, :2], axis=1, keepdims=True)
    errors = sampson_errors(F, points1, points2 + normals)
    shares = np.linalg.norm(lines2[:, :2], axis=1) / np.sqrt(
        (lines1[:, :2] ** 2).sum(axis=1) + (lines2[:, :2] ** 2).sum(axis=1)
    )
    np.testing.assert_allclose(errors, shares, rtol=2e-2)


def test_true_frames_carry_the_epipolar_direction_of_image_1_to_that_of_image_2(
    plane: dict[str, NDArray[np.float64]],
) -> None:
    F, points1, points2, maps = (
        plane[key] for key in ("F", "points1", "points2", "maps")
    )
    shapes1 = rotation((0, 0, 37.0))[:2, :2] @ np.diag([5.0, 2.0]) + np.zeros(
        (len(points1), 1, 1)
    )
    rows = np.arange(len(points1))

    def cosines_of(F: NDArray, points: tuple, shapes: tuple) -> NDArray:
        return EpipolarModel(F, points).cosines(rows, rows, shapes)

    points = (points1, points2)
    shapes = (shapes1, maps @ shapes1)
    cosines = cosines_of(F, points, shapes)
    sign = common_sign(cosines)
    np.testing.assert_allclose(cosines * sign, 1.0, atol=1e-6)
    assert common_sign(cosines_of(-F, points, shapes)) == sign
    assert common_sign(-cosines) == -sign
    turned = maps @ rotation((0, 0, 30.0))[:2, :2] @ shapes1
    wrong = cosines_of(F, points, (shapes1, turned))
    assert np.degrees(np.arccos(np.clip(wrong * sign, -1, 1))).min() > 10.0
    swapped = cosines_of(F.T, points[::-1], shapes[::-1])
    np.testing.assert_allclose(np.abs(swapped), 1.0, atol=1e-6)


def test_frames_that_are_mirrored_alike_are_turned_as_others_are() -> None:
    turn = rotation((0.0, 0.0, 30.0))[:2, :2]
    frames = np.array([[[2.0, 0.3], [0.1, 1.5]], [[2.0, 0.3], [-0.1, -1.5]]])
    cosines = rotation_cosines(frames, turn @ frames)
    assert cosines == pytest.approx([np.cos(np.deg2rad(30.0))] * 2)
    assert rotation_cosines(frames, frames[::-1]).tolist() == [-1.0, -1.0]
