"""Warps are exact and free of aliasing."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import IMAGE_SIZE, Array, homographies, tilt_angles
from synthetic import texture

from colmap_affrect.data import GrayImage, Rectification
from colmap_affrect.geometry.affine import (
    fit_canvas,
    image_corners,
    project,
    rectifying_affine,
)
from colmap_affrect.images.warping import half_size, warp, warp_mask

RAMP_ERROR_PX = 0.05
"""A plane fitted to a thousand samples or more with 8-bit rounding, at its corners."""

ALIGNED_RAMP_ERROR_PX = 0.15
"""Where the ramp runs along the warp's axes all samples of a row are rounded alike, worth up to
0.12 px (with floats it is 0.00). Half a px of a warp would be at least 0.2 px of the image."""

DITHER = 0.5
"""Noise in gray values that makes the rounding of the ramp random."""

PERSPECTIVE_RAMP_ERROR_PX = 0.1
"""A plane fitted to the errors of 2000 samples or more, at the far end of the warp."""

SIZE = (150, 100)


def rectification(tilt: float, angle_rad: float) -> Rectification:
    """Warp of a whole image of ``SIZE``."""
    linear = rectifying_affine(tilt, angle_rad)
    corners = image_corners(SIZE)
    matrix, canvas = fit_canvas(linear, corners, margin_px=4.0)
    return Rectification(matrix, canvas, np.ones(SIZE[::-1], bool), tilt, angle_rad)


def canvas_points(plan: Rectification) -> Array:
    """(H, W, 2) pixel-centre coordinates of all pixels of the canvas."""
    width, height = plan.canvas_size
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(
        float
    )


def coordinate_ramp(size: tuple[int, int], axis: int) -> tuple[GrayImage, float]:
    """An image whose gray values rise along an axis, and by how much a px."""
    slope = 240.0 / size[axis]
    noise = np.random.default_rng(0).uniform(-DITHER, DITHER, size[::-1])
    ramp = np.rint(DITHER + noise + slope * np.indices(size[::-1])[1 - axis])
    return ramp.astype(np.uint8), slope


@settings(max_examples=40)
@given(st.floats(1.0, 6.22), tilt_angles, st.sampled_from([0, 1]))
@example(1.0, 0.0, 1)
@example(6.22, 0.0, 0)
@example(6.22, np.pi / 2, 1)
@example(4.0, 0.6, 0)
def test_warp_of_a_coordinate_ramp_shows_image_from_rectified(
    tilt: float, angle_rad: float, axis: int
) -> None:
    plan = rectification(tilt, angle_rad)
    ramp, slope = coordinate_ramp(SIZE, axis)
    values = (warp(ramp, plan) - DITHER) / slope
    assert values.shape == plan.canvas_size[::-1]

    points = canvas_points(plan).reshape(-1, 2)
    sources = project(plan.image_from_rectified, points)
    # Outside, and as far inside as the blur reaches, the border is reflected.
    reach = 3 * 0.8 * tilt + 1
    inside = ((sources >= reach) & (sources <= np.array(SIZE) - 1 - reach)).all(axis=1)
    design = np.column_stack([points[inside], np.ones(np.count_nonzero(inside))])
    fitted, *_ = np.linalg.lstsq(design, values.ravel()[inside], rcond=None)
    expected = plan.image_from_rectified[axis]
    errors = design @ (fitted - expected)
    aligned = abs(np.sin(2 * angle_rad)) < 0.1
    assert np.abs(errors).max() < (ALIGNED_RAMP_ERROR_PX if aligned else RAMP_ERROR_PX)
    # Single pixels: the dither, and the rounding of input, intermediate result and output.
    assert (
        np.abs(values.ravel()[inside] - sources[inside, axis]).max()
        < (DITHER + 1.5) / slope
    )


def grating(direction: Array, period_px: float) -> GrayImage:
    """Sinusoid of amplitude 100 along a direction."""
    rows, columns = np.indices(SIZE[::-1])
    phase = 2 * np.pi * (direction[0] * columns + direction[1] * rows) / period_px
    return np.rint(128 + 100 * np.sin(phase)).astype(np.uint8)


def amplitude(image: GrayImage, plan: Rectification) -> float:
    """Amplitude of a sinusoid from its standard deviation, away from the image border."""
    sources = project(plan.image_from_rectified, canvas_points(plan).reshape(-1, 2))
    inside = ((sources > 16) & (sources < np.array(SIZE) - 17)).all(axis=1)
    return float(np.sqrt(2) * warp(image, plan).ravel()[inside].std())


@pytest.mark.parametrize("angle_rad", [0.0, 0.7])
@pytest.mark.parametrize("tilt", [3.15, 6.22])
def test_warp_suppresses_what_the_compressed_axis_cannot_show(
    tilt: float, angle_rad: float
) -> None:
    plan = rectification(tilt, angle_rad)
    compressed = plan.rectified_from_image[1, :2]
    compressed = compressed / np.linalg.norm(compressed)
    # Period below two px of the warp, i.e. 2 sqrt(t) of the image: it would alias.
    too_fine = grating(compressed, 1.3 * np.sqrt(tilt))
    assert amplitude(too_fine, plan) < 8.0
    coarse = grating(compressed, 24.0)
    assert amplitude(coarse, plan) > 80.0


def perspective(
    homography: Array, scale: float, size: tuple[int, int]
) -> Rectification:
    """Warp of a whole image of (width, height) by a scaled homography."""
    corners = project(homography, image_corners(size))
    matrix, canvas = fit_canvas(scale * np.eye(2), corners, margin_px=4.0)
    return Rectification(matrix @ homography, canvas, None, 1.0, 0.0)


def turned_camera(angle_deg: float, focal_px: float, size: tuple[int, int]) -> Array:
    """Homography to the view of a camera that turns about an oblique axis."""
    middle = (np.array(size) - 1.0) / 2.0
    camera = np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1.0]])
    turn, _ = cv2.Rodrigues(np.deg2rad(angle_deg) * np.array([0.5, 0.8, 0.33166]))
    return np.asarray(camera @ turn @ np.linalg.inv(camera))


def jacobian_spans(plan: Rectification, points: Array) -> Array:
    """(N, 2) image px that a px of the warp spans in x and in y, by finite differences."""
    step = 1e-3
    return np.stack(
        [
            np.linalg.norm(
                project(plan.image_from_rectified, points + step * np.eye(2)[axis])
                - project(plan.image_from_rectified, points - step * np.eye(2)[axis]),
                axis=1,
            )
            / (2 * step)
            for axis in (0, 1)
        ],
        axis=1,
    )


@settings(max_examples=20)
@given(homographies(), st.floats(0.25, 2.5), st.sampled_from([0, 1]))
@example(np.array([[1, 0, 0], [0, 1, 0], [0.002, 0, 1.0]]), 2.5, 0)
@example(np.array([[1, 0, 0], [0, 1, 0], [0, 0.004, 1.0]]), 0.3, 1)
def test_warp_by_a_homography_of_a_coordinate_ramp_shows_image_from_rectified(
    homography: Array, scale: float, axis: int
) -> None:
    size = IMAGE_SIZE
    plan = perspective(homography, scale, size)
    ramp, slope = coordinate_ramp(size, axis)
    values = ((warp(ramp, plan) - DITHER) / slope).ravel()
    assert values.shape == (plan.canvas_area_px,)
    points = canvas_points(plan).reshape(-1, 2)
    sources = project(plan.image_from_rectified, points)
    reach = 3 * 0.8 * jacobian_spans(plan, points).max(axis=1, keepdims=True) + 1
    inside = ((sources >= reach) & (sources <= np.array(size) - 1 - reach)).all(axis=1)
    if np.count_nonzero(inside) < 2000:
        return
    errors = values[inside] - sources[inside, axis]
    assert np.abs(errors).max() < (DITHER + 1.5) / slope
    # Rounding is random over a thousand px; an error of the map would grow along the warp.
    basis = (points[inside] - points[inside].mean(axis=0)) / np.array(plan.canvas_size)
    design = np.column_stack([np.ones(len(basis)), basis])
    fitted, *_ = np.linalg.lstsq(design, errors, rcond=None)
    assert abs(fitted[0]) < RAMP_ERROR_PX
    assert np.abs(design @ fitted).max() < PERSPECTIVE_RAMP_ERROR_PX


@pytest.mark.parametrize("is_affine", [True, False])
def test_warp_mask_marks_the_pixels_whose_source_is_in_the_region(
    is_affine: bool,
) -> None:
    region = np.zeros((45, 90), bool)
    region[5:, 10:] = True
    bent = perspective(turned_camera(35.0, 120.0, SIZE), 1.6, SIZE)
    plan = rectification(3.0, 0.5) if is_affine else bent
    plan = replace(plan, region=region, region_origin=(20, 15))
    assert plan.is_affine == is_affine
    mask = warp_mask(plan, SIZE)
    assert mask.shape == plan.canvas_size[::-1]
    assert np.unique(mask).tolist() == [0, 255]
    sources = project(plan.image_from_rectified, canvas_points(plan).reshape(-1, 2))
    low = np.array([29.5, 19.5])
    high = np.array([109.5, 59.5])
    slack = 0.1  # of OpenCV's fixed-point coordinates
    surely = ((sources > low + slack) & (sources < high - slack)).all(axis=1)
    surely_not = ((sources < low - slack) | (sources > high + slack)).any(axis=1)
    assert (mask.ravel()[surely] == 255).all()
    assert (mask.ravel()[surely_not] == 0).all()
    assert surely_not.any()
    assert surely.sum() > 1000


def test_warp_mask_is_zero_behind_the_camera() -> None:
    # A camera that turned by 70 degrees; the canvas reaches beyond the image's vanishing line.
    homography = turned_camera(70.0, 60.0, SIZE)
    plan = Rectification(np.array([[1, 0, 400.0], [0, 1, 300], [0, 0, 1]]) @ homography,
                         (800, 600), None, 1.0, 0.0)  # fmt: skip
    points = canvas_points(plan).reshape(-1, 2)
    third = points @ plan.image_from_rectified[2, :2] + plan.image_from_rectified[2, 2]
    sources = project(plan.image_from_rectified, points)
    mirrored = (third < 0) & ((sources > 0) & (sources < np.array(SIZE) - 1)).all(
        axis=1
    )
    assert mirrored.any(), "the canvas of this test shows no mirror image"
    mask = warp_mask(plan, SIZE).ravel()
    assert (mask[third <= 0] == 0).all()
    assert (mask == 255).any()
    assert warp(texture(SIZE, seed=1), plan).shape == (600, 800)


@pytest.mark.parametrize(("width", "height"), [(64, 40), (65, 41)])
def test_halved_samples_at_pixel_centres(width: int, height: int) -> None:
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    for axis, ramp in enumerate((x, y)):
        small = half_size(ramp.astype(np.float32))
        assert small.shape == (height // 2, width // 2)
        steps = np.arange(small.shape[1 - axis])
        along = (steps + 0.5) * (width, height)[axis] / len(steps) - 0.5
        found = small[10] if axis == 0 else small[:, 10]
        # Near the border the blur sees the reflected ramp.
        assert_allclose(found[2:-2], along[2:-2], atol=1e-4)


@pytest.mark.parametrize("perspective", [0.0, 0.002])
def test_warp_of_colours_is_that_of_each_channel(perspective: float) -> None:
    plan = rectification(2.5, 0.6)
    bent = np.diag([1.0, 1.0, 1.0])
    bent[2, 0] = perspective
    plan = replace(plan, rectified_from_image=plan.rectified_from_image @ bent)
    channels = [texture(SIZE, seed) for seed in (1, 2, 3)]
    warped = warp(np.stack(channels, axis=2), plan)
    assert warped.shape == (*plan.canvas_size[::-1], 3)
    for index, channel in enumerate(channels):
        np.testing.assert_array_equal(warped[:, :, index], warp(channel, plan))
