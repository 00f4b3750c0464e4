"""Coordinate conventions: half pixels, resizing, angles, and those of OpenCV and pycolmap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from synthetic import blobs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import project, transform_lafs
from colmap_affrect.geometry.conventions import (
    colmap_from_pixel,
    grid_origin,
    is_inside,
    pixel_from_colmap,
    resized_from_original,
)

sizes = st.tuples(st.integers(1, 4000), st.integers(1, 4000))

UPSCALE_BIAS_PX = 0.05
"""Without precise upscaling OpenCV's SIFT is off by 0.25 px in x and in y."""


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_colmap_counts_from_the_corner_half_a_pixel_further_in_x_and_y(
    dtype: type,
) -> None:
    points = np.array([[0.0, 7.0]], dtype=dtype)
    colmap = colmap_from_pixel(points)
    pixel = pixel_from_colmap(points)
    assert (colmap.dtype, colmap.tolist()) == (dtype, [[0.5, 7.5]])
    assert (pixel.dtype, pixel.tolist()) == (dtype, [[-0.5, 6.5]])
    assert points.tolist() == [[0.0, 7.0]], "the argument stays"


@given(sizes, sizes)
def test_resized_from_original_maps_image_corners_to_image_corners(
    original: tuple[int, int], resized: tuple[int, int]
) -> None:
    matrix = resized_from_original(original, resized)
    corners = np.array([[0.0, 0.0], [original[0], original[1]]]) - 0.5
    expected = np.array([[0.0, 0.0], [resized[0], resized[1]]]) - 0.5
    assert_allclose(project(matrix, corners), expected, atol=1e-9)


def test_resized_from_original_scales_affine_shapes_by_rows() -> None:
    laf = np.array([[[1.0, 2.0, 0.0], [3.0, 4.0, 0.0]]])
    resized = transform_lafs(resized_from_original((8, 8), (8, 4)), laf)
    assert_allclose(resized[0, :, :2], [[1.0, 2.0], [1.5, 2.0]])


@pytest.mark.parametrize("step_px", [1, 4, 5])
def test_grid_origin_is_the_mean_of_the_pixels_of_the_first_cell(step_px: int) -> None:
    assert_allclose(grid_origin(step_px), np.arange(step_px).mean())


def test_is_inside_accepts_whole_pixels_up_to_their_outer_edge() -> None:
    points = np.array(
        [[-0.5, 2.5], [4.5, -0.5], [-0.51, 0], [0, 2.51], [4.51, 0], [3, 2], [2, 3]]
    )
    assert is_inside(points, (5, 3)).tolist() == [
        True,
        True,
        False,
        False,
        False,
        True,
        False,
    ]


def test_points_keep_a_margin_of_their_own_in_x_and_y() -> None:
    points = np.array([[1.0, 1.0]] * 4 + [[3.0, 1.0]] * 4)
    margins = np.array([[1.4, 1.4], [1.6, 1.4], [1.4, 1.6], [0.0, 0.0]] * 2)
    expected = [True, False, False, True]
    assert is_inside(points, (5, 3), margins).tolist() == expected * 2


@pytest.mark.parametrize(
    ("direction", "angle_deg"),
    [((1, 0), 0.0), ((0, 1), 90.0), ((-1, 0), 180.0), ((0, -1), -90.0)],
)
def test_convention_sift_frame_points_towards_rising_gray_values(
    direction: tuple[int, int], angle_deg: float
) -> None:
    # A blob with a fainter one beside it: gray values rise from the blob's foot towards both,
    # and the half with the slope of the wide blob behind it dominates the histogram.
    center = np.array([60.0, 50.0])
    image = blobs(
        (121, 101),
        [center, center + 9.0 * np.array(direction)],
        [4.0 * np.eye(2), 9.0 * np.eye(2)],
        amplitude=70.0,
    )
    features = RootSift(SiftOptions()).detect((image, None))
    near = np.linalg.norm(features.keypoints - center, axis=1) < 6.0
    assert near.any()
    x, y = features.lafs[
        near, :, 0
    ].T  # the first column of each frame is its direction
    differences = np.rad2deg(np.arctan2(y, x)) - angle_deg
    assert np.abs((differences + 180.0) % 360.0 - 180.0).min() < 10.0


def test_convention_sift_with_precise_upscale_has_no_bias() -> None:
    rng = np.random.default_rng(5)
    errors = []
    for sigma_px in (2.0, 3.0, 4.5, 7.0):
        places = np.array([[50.0, 60.0], [130.0, 50.0], [70.0, 140.0]])
        places = places + rng.uniform(-0.5, 0.5, places.shape)
        image = blobs((190, 200), places, sigma_px * np.eye(2))
        keypoints = RootSift(SiftOptions()).detect((image, None)).keypoints
        distances = np.linalg.norm(keypoints[:, None] - places[None], axis=2)
        assert distances.min(axis=0).max() < 0.5
        errors.append(keypoints[distances.argmin(axis=0)] - places)
    bias = np.concatenate(errors).mean(axis=0)
    assert np.abs(bias).max() < UPSCALE_BIAS_PX


def test_convention_pycolmap_sift_reports_corner_origin() -> None:
    image = blobs((81, 61), [[40.0, 30.0]], 5.0 * np.eye(2))
    extractor = pycolmap.FeatureExtractor.create(
        pycolmap.FeatureExtractionOptions(use_gpu=False)
    )
    keypoints, _ = extractor.extract(pycolmap.Bitmap.from_array(image))
    places = np.array([[keypoint.x, keypoint.y] for keypoint in keypoints])
    assert np.linalg.norm(places - [40.5, 30.5], axis=1).min() < 0.1
