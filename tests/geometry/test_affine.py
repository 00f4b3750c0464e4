"""Properties of affine maps, of local affine frames, and of the canvases of rectifying warps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import Array, affine_shapes, classes, frames, homographies, turns

from colmap_affrect.geometry.affine import (
    ellipse_extents,
    fit_canvas,
    homography_errors,
    lafs_from_keypoints,
    project,
    rectifying_affine,
    rotation,
    transform_lafs,
)
from colmap_affrect.geometry.tilts import metrics_from_tilts, unit_metrics

ROUNDING = 1e-9
"""Some hundred float64 operations on numbers of order 100."""

CANVAS_ROUNDING = 1e-8
"""The canvas forgives 1e-9 px so that rounding cannot add a column."""

JACOBIAN_ERROR = 1e-5
"""Central differences with a step of 1e-3 px: curvature of the homography and rounding."""


def test_homography_errors_are_distances_from_the_nearest_true_match() -> None:
    # 6 px off along the stretched axis of image 2 are 2 px in image 1: nearly that is to be moved.
    stretched = np.array([[3.0, 0.0, 10.0], [0.0, 1.0, -5.0], [0.0, 0.0, 1.0]])
    points = np.array([[20.0, 30.0], [40.0, -7.0]])
    offsets = np.array([[6.0, 0.0], [0.0, 6.0]])
    expected = [6.0 / np.sqrt(10.0), 6.0 / np.sqrt(2.0)]
    assert_allclose(
        homography_errors(stretched, points, project(stretched, points) + offsets),
        expected,
    )
    tilted = np.array([[0.6, -0.3, 40.0], [0.2, 1.3, -9.0], [1e-3, -4e-4, 1.0]])
    others = project(tilted, points) + offsets / 6
    there = homography_errors(tilted, points, others)
    back = homography_errors(np.linalg.inv(tilted), others, points)
    assert_allclose(there, back, rtol=0.02)
    assert (there < np.linalg.norm(offsets / 6, axis=1)).all()


def test_transform_lafs_maps_lafs_of_a_warp_to_the_image_by_the_inverse_on_the_left() -> (
    None
):
    rectified_from_image = np.array(
        [[2.0, 1.0, 3.0], [0.0, 1.0, -5.0], [0.0, 0.0, 1.0]]
    )
    warp_lafs = np.array([[[1.0, 4.0, 7.0], [0.0, 2.0, 1.0]]])
    # A^-1 = [[1/2, -1/2], [0, 1]]; the other order, L A^-1, would be [[1/2, 7/2], [0, 2]].
    # Centre: y = 1 + 5 = 6, x = (7 - 3 - 6) / 2 = -1.
    expected = [[[0.5, 1.0, -1.0], [0.0, 2.0, 6.0]]]
    actual = transform_lafs(np.linalg.inv(rectified_from_image), warp_lafs)
    assert_allclose(actual, expected, atol=ROUNDING)


@given(homographies(), frames())
def test_transform_lafs_by_homography_has_the_jacobian_of_finite_differences(
    homography: Array, lafs: Array
) -> None:
    step = 1e-3
    mapped = transform_lafs(homography, lafs)
    centers = lafs[:, :, 2]
    assert_allclose(mapped[:, :, 2], project(homography, centers), atol=ROUNDING)
    for column in range(2):
        move = step * lafs[:, :, column]
        ahead = project(homography, centers + move)
        behind = project(homography, centers - move)
        derivative = (ahead - behind) / (2 * step)
        assert_allclose(
            mapped[:, :, column], derivative, rtol=1e-4, atol=JACOBIAN_ERROR
        )


def test_lafs_from_keypoints_point_their_first_column_along_the_orientation() -> None:
    points = np.array([[3.0, 5.0], [8.0, 1.0]])
    lafs = lafs_from_keypoints(points, np.array([2.0, 4.0]), np.deg2rad([90.0, 30.0]))
    assert_allclose(lafs[:, :, 2], points)
    assert_allclose(
        lafs[:, :, 0], [[0.0, 2.0], [2.0 * np.sqrt(3.0), 2.0]], atol=ROUNDING
    )
    assert_allclose(np.linalg.det(lafs[:, :, :2]), [4.0, 16.0])


@given(affine_shapes(), turns)
def test_ellipse_extents_bound_the_ellipse_whatever_its_orientation(
    shape: Array, turn: float
) -> None:
    circle = np.linspace(0.0, 2 * np.pi, 721)
    outline = shape @ np.stack([np.cos(circle), np.sin(circle)])
    extents = ellipse_extents((shape @ rotation(turn))[None])[0]
    # The largest of 720 samples misses the extreme by at most 1 - cos(0.25 deg).
    assert_allclose(np.abs(outline).max(axis=1), extents, rtol=2e-5)


points_in_image = st.lists(
    st.tuples(st.integers(0, 400), st.integers(0, 250)), min_size=1, max_size=20
).map(lambda points: np.array(points, dtype=float))


@given(classes())
def test_rectifying_affine_has_unit_area_and_the_class_asked_for(
    cls: tuple[float, float],
) -> None:
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
    assert_allclose(mapped.min(axis=0), margin_px, atol=CANVAS_ROUNDING)
    reach = mapped.max(axis=0) + margin_px
    last = np.array([width, height]) - 1
    assert (reach <= last + CANVAS_ROUNDING).all()
    assert (reach > last - 1 - CANVAS_ROUNDING).all()
