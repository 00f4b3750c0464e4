"""Rotations explain matches of turned and zoomed views, whatever is wrong beside; not of others."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_affrect.geometry.parallax import Size, rotation_share
from colmap_affrect.geometry.two_views import homogeneous

SIZES: tuple[Size, Size] = ((640, 480), (640, 480))
MATRIX = np.array([[880.0, 0, 320], [0, 880, 240], [0, 0, 1]])


def rotation(yaw_deg: float, pitch_deg: float) -> np.ndarray:
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    around_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    tilt = np.array([[np.cos(pitch), -np.sin(pitch)], [np.sin(pitch), np.cos(pitch)]])
    around_x = np.eye(3)
    around_x[1:, 1:] = tilt
    return around_x @ around_y


def strip_of_turned_view(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Matches in the strip that two views 34 degrees apart have in common."""
    rng = np.random.default_rng(4)
    points1 = rng.uniform((15.0, 40.0), (85.0, 440.0), (num, 2))
    turned = homogeneous(points1) @ (MATRIX @ rotation(34.0, -5.0) @ np.linalg.inv(MATRIX)).T
    return points1, turned[:, :2] / turned[:, 2:]


@pytest.mark.parametrize("share_wrong", [0.0, 0.25])
def test_turned_views_of_which_things_that_repeat_match_too(share_wrong: float) -> None:
    points1, points2 = strip_of_turned_view(400)
    num_wrong = int(share_wrong * 400)
    points1[:num_wrong] += (380.0, -25.0)
    points2[:num_wrong] = np.random.default_rng(1).uniform((40, 20), (600, 460), (num_wrong, 2))
    share = rotation_share(points1, points2, SIZES, 2.0)
    assert share == pytest.approx(1.0 - share_wrong, abs=0.05)


def test_moved_camera_is_no_turned_one() -> None:
    rng = np.random.default_rng(7)
    scene = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.2, 7.0), (300, 3))
    views = []
    for matrix, center in ((np.eye(3), (0.0, 0, 0)), (rotation(9.0, 2.0), (0.7, -0.2, 0.1))):
        seen = (scene - center) @ (MATRIX @ matrix).T
        views.append(seen[:, :2] / seen[:, 2:])
    assert rotation_share(views[0], views[1], SIZES, 2.0) < 0.3
