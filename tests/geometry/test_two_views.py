"""Depths of two views, scales between depths at neighbouring places, and turned views."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from colmap_affrect.geometry.epipolar import sampson_errors
from colmap_affrect.geometry.parallax import Size, pure_rotation_ratio
from colmap_affrect.geometry.two_views import (
    essential_matrix,
    homogeneous,
    scale_between,
    scale_by_planes,
    triangulated_depths,
)

ANGLE = np.deg2rad(20.0)
ROTATION = np.array(
    [[np.cos(ANGLE), 0, np.sin(ANGLE)], [0, 1, 0], [-np.sin(ANGLE), 0, np.cos(ANGLE)]]
)
TRANSLATION = np.array([-2.0, 0.3, 0.5])
SCALE = 3.7


def depth_at(points: np.ndarray) -> np.ndarray:
    """A slanted plane: inverse depth is affine in the image."""
    return np.asarray(1.0 / (0.1 + 4e-5 * points[:, 0] - 2e-5 * points[:, 1]))


def test_depths_are_those_of_the_points_in_both_cameras() -> None:
    points = np.random.default_rng(1).uniform((-2, -1, 4), (3, 1, 9), (50, 3))
    moved = points @ ROTATION.T + TRANSLATION
    rays1 = points[:, :2] / points[:, 2:]
    rays2 = moved[:, :2] / moved[:, 2:]
    depths = triangulated_depths(ROTATION, TRANSLATION, rays1, rays2)
    np.testing.assert_allclose(depths.first, points[:, 2], rtol=1e-9)
    np.testing.assert_allclose(depths.second, moved[:, 2], rtol=1e-9)
    center = -ROTATION.T @ TRANSLATION
    cosines = (points * (points - center)).sum(axis=1)
    cosines /= np.linalg.norm(points, axis=1) * np.linalg.norm(points - center, axis=1)
    np.testing.assert_allclose(
        depths.angles_deg, np.degrees(np.arccos(cosines)), atol=1e-6
    )
    assert (
        sampson_errors(essential_matrix(ROTATION, TRANSLATION), rays1, rays2).max()
        < 1e-9
    )
    turned = triangulated_depths(ROTATION, -TRANSLATION, rays1, rays2)
    assert not turned.in_front.any()
    assert depths.in_front.all()


@pytest.mark.parametrize("share_wrong", [0.0, 0.4])
def test_scale_is_found_between_features_that_lie_beside_each_other(
    share_wrong: float,
) -> None:
    random = np.random.default_rng(2)
    known = random.uniform(0, 1000, (600, 2))
    places = random.uniform(0, 1000, (200, 2))
    depths = depth_at(places) / SCALE
    wrong = random.random(len(places)) < share_wrong
    depths[wrong] *= np.exp(random.uniform(-2, 2, wrong.sum()))
    found = scale_between((known, depth_at(known)), (places, depths), 30.0)
    assert found is not None
    assert found.scale == pytest.approx(SCALE, rel=0.01)
    assert 100 < found.num_ratios <= 200
    assert found.share == pytest.approx(1.0 - share_wrong, abs=0.12)
    assert found.error_frac < 0.01


def test_plane_carries_depths_to_where_nothing_is_known_and_only_a_plane_does() -> None:
    random = np.random.default_rng(3)
    known = random.uniform((0, 0), (400, 1000), (400, 2))
    places = random.uniform((440, 100), (520, 900), (60, 2))
    given = places, depth_at(places) / SCALE
    assert scale_between((known, depth_at(known)), given, 30.0) is None
    found = scale_by_planes((known, depth_at(known)), given, 160.0)
    assert found is not None
    assert found.scale == pytest.approx(SCALE, rel=1e-6)
    assert found.num_agreeing == found.num_ratios > 30
    rough = depth_at(known) * np.exp(random.normal(0, 0.3, len(known)))
    assert scale_by_planes((known, rough), given, 160.0) is None


def test_errors_of_poses_are_shared_by_all_depths_beyond_ten() -> None:
    random = np.random.default_rng(2)
    known = random.uniform(0, 1000, (600, 2))
    places = random.uniform(0, 1000, (400, 2))
    depths = depth_at(places) / SCALE * np.exp(random.normal(0, 0.03, 400))
    found = scale_between((known, depth_at(known)), (places, depths), 30.0)
    assert found is not None
    assert 0.03 / np.sqrt(20) < found.error_frac < 0.03 / np.sqrt(5)


@pytest.mark.parametrize("estimate", [scale_between, scale_by_planes])
def test_without_known_depths_or_places_there_is_no_scale(
    estimate: Callable[..., object],
) -> None:
    nothing = (np.zeros((0, 2)), np.zeros(0))
    something = (np.zeros((20, 2)), np.ones(20))
    assert estimate(nothing, something, 10.0) is None
    assert estimate(something, nothing, 10.0) is None


SIZES: tuple[Size, Size] = ((640, 480), (640, 480))
MATRIX = np.array([[880.0, 0, 320], [0, 880, 240], [0, 0, 1]])


def rotation(yaw_deg: float, pitch_deg: float) -> np.ndarray:
    yaw, pitch = np.deg2rad([yaw_deg, pitch_deg])
    around_y = np.array(
        [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    )
    tilt = np.array([[np.cos(pitch), -np.sin(pitch)], [np.sin(pitch), np.cos(pitch)]])
    around_x = np.eye(3)
    around_x[1:, 1:] = tilt
    return around_x @ around_y


def strip_of_turned_view(num: int) -> tuple[np.ndarray, np.ndarray]:
    """Matches in the strip that two views 34 degrees apart have in common."""
    rng = np.random.default_rng(4)
    points1 = rng.uniform((15.0, 40.0), (85.0, 440.0), (num, 2))
    turned = (
        homogeneous(points1) @ (MATRIX @ rotation(34.0, -5.0) @ np.linalg.inv(MATRIX)).T
    )
    return points1, turned[:, :2] / turned[:, 2:]


@pytest.mark.parametrize("share_wrong", [0.0, 0.25])
def test_turned_views_of_which_things_that_repeat_match_too(share_wrong: float) -> None:
    points1, points2 = strip_of_turned_view(400)
    num_wrong = int(share_wrong * 400)
    points1[:num_wrong] += (380.0, -25.0)
    points2[:num_wrong] = np.random.default_rng(1).uniform(
        (40, 20), (600, 460), (num_wrong, 2)
    )
    share = pure_rotation_ratio(points1, points2, SIZES, 2.0)
    assert share == pytest.approx(1.0 - share_wrong, abs=0.05)


def test_moved_camera_is_no_turned_one() -> None:
    rng = np.random.default_rng(7)
    scene = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.2, 7.0), (300, 3))
    views = []
    for matrix, center in (
        (np.eye(3), (0.0, 0, 0)),
        (rotation(9.0, 2.0), (0.7, -0.2, 0.1)),
    ):
        seen = (scene - center) @ (MATRIX @ matrix).T
        views.append(seen[:, :2] / seen[:, 2:])
    assert pure_rotation_ratio(views[0], views[1], SIZES, 2.0) < 0.3


def test_depth_that_is_wrong_beside_a_position_does_not_hide_the_others_there() -> None:
    """A position agrees where one of the five known depths next to it does."""
    random = np.random.default_rng(5)
    known = random.uniform(0, 1000, (2000, 2))
    known_depths = depth_at(known)
    is_wrong = random.random(len(known)) < 0.5
    known_depths[is_wrong] *= np.exp(random.uniform(-2, 2, is_wrong.sum()))
    places = random.uniform(100, 900, (300, 2))
    found = scale_between((known, known_depths), (places, depth_at(places)), 60.0)
    assert found is not None
    assert found.scale == pytest.approx(1.0, rel=0.03)
    assert found.share > 0.9


def test_depths_beyond_the_nearest_do_not_make_a_scale_by_chance() -> None:
    """Each of many depths that have nothing in common agrees with any scale now and then."""
    random = np.random.default_rng(6)
    known = random.uniform(0, 1000, (4000, 2))
    places = random.uniform(100, 900, (300, 2))
    known_depths = np.exp(random.uniform(-2, 2, len(known)))
    found = scale_between((known, known_depths), (places, np.ones(300)), 100.0)
    assert found is not None
    assert found.share < 0.4


def test_depths_beside_a_feature_count_more_than_those_at_the_end_of_the_radius() -> (
    None
):
    """Two known depths are beside it, and three others nine tenths of the radius away."""
    feature = np.array([[500.0, 400.0]])
    offsets = np.array([[1.0, 0.0], [0.0, 1.0], [27.0, 0.0], [-27.0, 0.0], [0.0, 27.0]])
    known = feature + offsets, np.array([2.0, 2.0, 3.0, 3.0, 3.0])
    found = scale_between(known, (feature, np.ones(1)), 30.0)
    assert found is not None
    assert found.scale == pytest.approx(2.0)


@pytest.mark.parametrize(("error_frac", "is_plane"), [(0.01, True), (0.08, False)])
def test_rough_surfaces_are_no_planes_although_their_middle_is_certain(
    error_frac: float, *, is_plane: bool
) -> None:
    """Twelve depths around a feature are a little too large and too small in turn."""
    angles = np.deg2rad(30.0 * np.arange(12))
    around = 20.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1) + (500.0, 400.0)
    in_turn = np.array([1.0, -1.0, 1.0, 1.0, -1.0, -1.0] * 2)
    known = around, 5.0 / (1.0 + error_frac * in_turn)
    found = scale_by_planes(known, (np.array([[500.0, 400.0]]), np.ones(1)), 30.0)
    assert (found is not None) == is_plane
