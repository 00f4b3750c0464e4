"""Canvases of rectifying warps hold their region and are the smallest that do."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import Array, classes

from colmap_affrect.geometry.affine import fit_canvas, project, rectifying_affine
from colmap_affrect.geometry.tilts import metrics_from_tilts, unit_metrics

ROUNDING = 1e-8
"""The canvas forgives 1e-9 px so that rounding cannot add a column."""

points_in_image = st.lists(
    st.tuples(st.integers(0, 400), st.integers(0, 250)), min_size=1, max_size=20
).map(lambda points: np.array(points, dtype=float))


@given(classes())
def test_rectifying_affine_has_unit_area_and_the_class_asked_for(cls: tuple[float, float]) -> None:
    matrix = rectifying_affine(*cls)
    assert_allclose(np.linalg.det(matrix), 1.0)
    assert_allclose(unit_metrics(matrix), metrics_from_tilts(*cls), atol=1e-12)


def test_rectifying_affine_stretches_the_direction_of_minus_phi() -> None:
    # R(phi) turns the direction -phi to the x axis, which is then stretched by sqrt(t).
    direction = np.array([np.cos(-0.4), np.sin(-0.4)])
    assert_allclose(rectifying_affine(4.0, 0.4) @ direction, [2.0, 0.0], atol=1e-12)


@given(classes(), points_in_image, st.sampled_from([0.0, 2.5, 16.0]))
def test_fit_canvas_holds_all_points_with_margin_and_no_smaller_canvas_does(
    cls: tuple[float, float], points: Array, margin_px: float
) -> None:
    linear = rectifying_affine(*cls)
    matrix, (width, height) = fit_canvas(linear, points, margin_px)
    assert_allclose(matrix[:2, :2], linear)
    assert_allclose(matrix[2], [0.0, 0.0, 1.0])
    mapped = project(matrix, points)
    assert_allclose(mapped.min(axis=0), margin_px, atol=ROUNDING)
    reach = mapped.max(axis=0) + margin_px
    last = np.array([width, height]) - 1
    assert (reach <= last + ROUNDING).all()
    assert (reach > last - 1 - ROUNDING).all()
