"""How significant a geometry is where none of the random matches of a pair ever fit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from strategies import Array

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import significance
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.significance import log10_bayes_factor, log10_false_alarms

NUM = 14  # matches
NUM_RANDOM = NUM * (NUM - 1)  # matches of each feature with all others
ALL_UNLIKE_DEG = 25.0 * np.arange(NUM)
CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)


def keypoints_of_a_wall(turns_deg: Array) -> Array:
    """(N, 6) keypoints 40 px apart, which both images have at the same places."""
    numbers = np.arange(NUM)
    points = np.stack([40.0 * numbers + 20.0, 30.0 * (numbers % 4) + 60.0], axis=1)
    shapes = rotation(np.deg2rad(turns_deg)) @ np.diag([3.0, 1.5])
    return np.concatenate([points, shapes.reshape(-1, 4)], axis=1)


def significance_of(keypoints: Array) -> float:
    """Return the significance of the homography that leaves all points where they are."""
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = pycolmap.TwoViewGeometryConfiguration.PLANAR
    geometry.H = np.eye(3)
    return significance(geometry, (CAMERA, CAMERA), (keypoints, keypoints), 3.0)


def test_where_no_random_match_fits_chance_is_one_of_their_number() -> None:
    positions = keypoints_of_a_wall(ALL_UNLIKE_DEG)[:, :2]
    expected = -log10_false_alarms(NUM, NUM, 4, 1.0 / NUM_RANDOM)
    assert significance_of(positions) == pytest.approx(expected)


def test_where_no_random_frames_agree_chance_is_that_of_frames_turned_at_random() -> (
    None
):
    keypoints = keypoints_of_a_wall(ALL_UNLIKE_DEG)
    by_positions = significance_of(keypoints[:, :2])
    by_frames = log10_bayes_factor(NUM, NUM, 20.0 / 180.0)
    assert by_frames > math.log10(1000.0)
    assert significance_of(keypoints) == pytest.approx(by_positions + by_frames)


def test_frames_that_often_agree_by_chance_say_less() -> None:
    """Half of the frames are turned by a right angle, so that 84 of 182 random ones agree."""
    turns_deg = 90.0 * (np.arange(NUM) % 2) + 0.5 * np.arange(NUM)
    keypoints = keypoints_of_a_wall(turns_deg)
    by_positions = significance_of(keypoints[:, :2])
    by_frames = log10_bayes_factor(NUM, NUM, 84.0 / NUM_RANDOM)
    assert significance_of(keypoints) == pytest.approx(by_positions + by_frames)
