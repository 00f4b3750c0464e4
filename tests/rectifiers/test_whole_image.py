"""Whole-image warps: how many, which maps, and what the canvas shows."""

from __future__ import annotations

import numpy as np
import pytest
from contracts.contracts import photograph_of
from numpy.testing import assert_allclose
from planar_scenes import FixedShapes
from synthetic import texture

from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.tilts import (
    UNCOVERED_LABEL,
    asift_covering,
    metrics_from_tilts,
    near_optimal_covering,
    nearest_centers,
    tilts_from_metrics,
    unit_metrics,
)
from colmap_affrect.rectifiers.affine_warps import (
    AffNetShapes,
    AffNetShapesOptions,
    Asift,
    AsiftOptions,
    plan_whole_image,
)
from colmap_affrect.rectifiers.base import RectifierInputs

SIZE = (163, 117)


def fixed_shapes(classes: list[tuple[float, float]], counts: list[int]) -> FixedShapes:
    """Shapes of given classes (tilt, angle), so many of each."""
    rows = np.repeat([(5.0, 5.0, *of_class) for of_class in classes], counts, axis=0)
    return FixedShapes(rows)


def test_asift_has_the_61_maps_of_the_paper_and_their_area() -> None:
    centers = asift_covering()
    assert len(centers) + 1 == 61
    tilts, counts = np.unique(centers[:, 0], return_counts=True)
    assert_allclose(tilts, 2.0 ** (np.arange(1, 7) / 2))
    assert counts.tolist() == [4, 5, 7, 10, 14, 20]
    assert_allclose(1 + (1 / centers[:, 0]).sum(), 16.28, atol=0.01)


def test_near_optimal_covering_leaves_no_tilt_below_its_bound_uncovered() -> None:
    centers = near_optimal_covering()
    assert len(centers) + 1 == 25
    assert_allclose(1 + (1 / centers[:, 0]).sum(), 7.144, atol=0.001)
    tilts, angles = np.meshgrid(np.geomspace(1, 5.8, 150), np.linspace(0, np.pi, 500))
    labels = nearest_centers(
        metrics_from_tilts(tilts.ravel(), angles.ravel()), centers, 1.7
    )
    assert (labels != UNCOVERED_LABEL).all()
    beyond = nearest_centers(metrics_from_tilts([9.5], [0.3]), centers, 1.7)
    assert (beyond == UNCOVERED_LABEL).all()


@pytest.mark.parametrize("covering", ["asift", "near-optimal"])
@pytest.mark.parametrize("area_preserving", [True, False])
def test_every_warp_shows_the_whole_image_at_its_tilt(
    covering, area_preserving
) -> None:
    options = AsiftOptions(covering=covering, area_preserving=area_preserving)
    plan = Asift(options, RectifierInputs()).plan(photograph_of(texture(SIZE, 1)))
    assert len(plan.items) == {"asift": 60, "near-optimal": 24}[covering]
    corners = np.array([[0, 0], [162, 0], [0, 116], [162, 116]], dtype=float)
    for item in plan.items:
        mapped = project(item.rectified_from_image, corners)
        assert_allclose(mapped.min(axis=0), 0.0, atol=1e-9)
        assert (np.ceil(mapped.max(axis=0) - 1e-9) + 1 == item.canvas_size).all()
        linear = item.rectified_from_image[:2, :2]
        tilt, angle = tilts_from_metrics(unit_metrics(linear))
        assert_allclose([tilt, angle], [item.tilt, item.tilt_angle_rad], atol=1e-9)
        determinant = 1.0 if area_preserving else 1.0 / item.tilt
        assert_allclose(np.linalg.det(linear), determinant)
        assert item.region is None


def test_affnet_shapes_warps_by_the_classes_that_are_there() -> None:
    shapes = fixed_shapes(
        [(1.0, 0.0), (2.5, 0.7), (4.9, 2.2), (7.0, 1.0)], [50, 30, 15, 5]
    )
    options = AffNetShapesOptions(covered_frac=1.0)
    plan = AffNetShapes(options, RectifierInputs(shapes)).plan(
        photograph_of(texture(SIZE, 1))
    )
    classes = [(item.tilt, item.tilt_angle_rad) for item in plan.items]
    labels = nearest_centers(
        metrics_from_tilts([2.5, 4.9, 7.0], [0.7, 2.2, 1.0]), np.array(classes), 1.7
    )
    assert labels.tolist() == [0, 1, UNCOVERED_LABEL]
    assert len(classes) == 2


def test_a_warp_of_the_whole_image_is_stretched_along_the_direction_of_its_class() -> (
    None
):
    """An angle turns upwards from the right; y of pixels goes down."""
    tilt = 3.0
    angle = 0.6
    centers = np.array([[tilt, angle]])
    plan = plan_whole_image(SIZE, centers, AsiftOptions(area_preserving=False))
    linear = plan.items[0].rectified_from_image[:2, :2]
    along = np.array([np.cos(angle), -np.sin(angle)])
    across = np.array([np.sin(angle), np.cos(angle)])
    assert_allclose(linear @ along, [1.0, 0.0], atol=1e-12)
    assert_allclose(linear @ across, [0.0, 1.0 / tilt], atol=1e-12)
