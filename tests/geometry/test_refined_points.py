"""Points moved to where their errors are smallest: noise, outliers, what cannot be refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.refined_points import Observations, refined_points

FOCAL_PX = 800.0
NOISE_PX = 0.5
NUM_VIEWS = 4


def truth(count: int) -> Array:
    return np.random.default_rng(1).uniform((-2, -2, 6), (2, 2, 9), (count, 3))


def observed(points: Array, noise_px: float = 0.0) -> Observations:
    """Views along a line that look ahead and see all points."""
    random = np.random.default_rng(2)
    rows = np.repeat(np.arange(len(points)), NUM_VIEWS)
    translations = np.tile([[0.5 * k, 0.1 * k, 0.0] for k in range(NUM_VIEWS)], (len(points), 1))
    inside = points[rows] + translations
    rays = inside[:, :2] / inside[:, 2:]
    rays += random.normal(0.0, noise_px / FOCAL_PX, rays.shape)
    rotations = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
    px_per_ray = np.broadcast_to(FOCAL_PX * np.eye(2), (len(rows), 2, 2))
    return Observations(rows, rotations, translations, rays, px_per_ray)


def rms_px(points: Array, seen: Observations) -> float:
    errors = seen.errors(seen.in_views(points))
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def test_points_without_noise_are_found_exactly() -> None:
    points = truth(50)
    start = points * np.random.default_rng(3).uniform(0.9, 1.1, (50, 1))
    found = refined_points(start, observed(points), NOISE_PX)
    np.testing.assert_allclose(found, points, atol=1e-4)


def test_no_place_nearby_has_smaller_errors() -> None:
    points = truth(50)
    seen = observed(points, NOISE_PX)
    found = refined_points(points, seen, noise_px=100.0)  # so wide a loss is that of squares
    least = rms_px(found, seen)
    assert least < rms_px(points, seen)
    for step in 0.01 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert rms_px(found + step, seen) > least


def test_one_wrong_observation_hardly_moves_a_point() -> None:
    points = truth(30)
    seen = observed(points)
    rays = seen.rays.copy()
    rays[::NUM_VIEWS] += 30.0 / FOCAL_PX
    found = refined_points(points * 1.01, replace(seen, rays=rays), NOISE_PX)
    assert np.linalg.norm(found - points, axis=1).max() < 0.02


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_not_finite_leaves_its_point_alone(wrong: float) -> None:
    points = truth(5)
    seen = observed(points)
    rays = seen.rays.copy()
    rays[2 * NUM_VIEWS] = wrong
    start = points * 1.02
    found = refined_points(start, replace(seen, rays=rays), NOISE_PX)
    np.testing.assert_array_equal(found[2], start[2])
    np.testing.assert_allclose(np.delete(found, 2, 0), np.delete(points, 2, 0), atol=1e-4)


def test_point_behind_a_view_and_point_on_parallel_rays_do_no_harm() -> None:
    points = np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 5.0], [0.1, 0.2, 7.0]])
    seen = observed(points)
    translations = seen.translations.copy()
    translations[NUM_VIEWS : 2 * NUM_VIEWS] = 0.0  # one view of the second point, on its axis
    rays = seen.rays.copy()
    rays[NUM_VIEWS : 2 * NUM_VIEWS] = 0.0
    seen = replace(seen, translations=translations, rays=rays)
    found = refined_points(points * [1, 1, 1.01], seen, NOISE_PX)
    np.testing.assert_array_equal(found[0], [0.0, 0.0, -5.05])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[2], points[2], atol=1e-4)
