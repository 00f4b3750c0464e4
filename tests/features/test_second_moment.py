"""Shapes from the structure tensor follow the image; images without texture have none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from strategies import Array
from synthetic import texture

from colmap_affrect.data import GrayImage, ShapeGrid
from colmap_affrect.features.second_moment import (
    SecondMoment,
    SecondMomentOptions,
    _block_tensors,
)
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.tilts import STEP_PX, tilts_from_metrics

TILT_BAND = 0.25
"""Relative: isotropic noise in a window of 32 px is isotropic to about a tenth, and the
smoothing before the gradients blurs a compressed texture more along one axis."""

ANGLE_BAND_DEG = 5.0


SOURCE = SecondMoment(SecondMomentOptions())


def mean_class(grid: ShapeGrid, border_px: int = 48) -> tuple[float, float]:
    """Tilt and angle in degrees of the mean shape, away from the border of the image."""
    cells = border_px // STEP_PX
    metrics = grid.metrics[cells:-cells, cells:-cells].reshape(-1, 3).mean(axis=0)
    metrics = metrics / np.sqrt(metrics[0] * metrics[1] - metrics[2] ** 2)
    tilt, angle = tilts_from_metrics(metrics)
    return float(tilt), float(np.rad2deg(angle))


def resample(
    image: GrayImage, image_from_result: Array, size: tuple[int, int]
) -> GrayImage:
    """Show an image through a (2, 2) map about the centres of image and result."""
    height, width = image.shape
    matrix = np.zeros((2, 3))
    matrix[:, :2] = image_from_result
    center = (np.array(size) - 1) / 2
    matrix[:, 2] = (np.array([width, height]) - 1) / 2 - image_from_result @ center
    return cv2.warpAffine(
        image,
        matrix,
        size,
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )


@pytest.fixture(scope="module")
def isotropic() -> GrayImage:
    """A texture without direction, coarse enough to be stretched and turned."""
    return texture((640, 560), seed=9, finest_sigma_px=2.5)


@pytest.mark.parametrize("axis_deg", [0.0, 35.0, 90.0, 140.0])
def test_second_moment_shapes_of_a_texture_stretched_by_3_undo_the_stretch(
    isotropic: GrayImage, axis_deg: float
) -> None:
    # The result shows the texture three times longer along axis_deg (x towards y).
    turn = rotation(np.deg2rad(axis_deg))
    result_from_image = turn @ np.diag([3.0, 1.0]) @ turn.T
    stretched = resample(isotropic, np.linalg.inv(result_from_image), (500, 480))
    tilt, angle_deg = mean_class(SOURCE.grid(stretched))
    # The rectifying map diag(t, 1) R(phi) stretches the direction -phi: across the axis.
    expected_deg = (90.0 - axis_deg) % 180.0
    assert_allclose(tilt, 3.0, rtol=TILT_BAND)
    assert abs((angle_deg - expected_deg + 90.0) % 180.0 - 90.0) < ANGLE_BAND_DEG


def test_textured_blocks_lie_round_the_texture() -> None:
    image = np.full((161, 318), 128, np.uint8)
    image[40:72, 200:236] = texture((36, 32), seed=5)
    grid = SOURCE.grid(image)
    rows, columns = np.nonzero(grid.textured)
    middle = np.array([columns.mean(), rows.mean()]) * grid.step_px + grid.origin_px
    assert_allclose(middle, [217.5, 55.5], atol=2.0)


@pytest.mark.parametrize(("step", "has_texture"), [(0.5, False), (3.0, True)])
def test_a_slope_of_less_than_one_gray_value_a_pixel_is_no_texture(
    step: float, has_texture: bool
) -> None:
    row = np.rint(10.0 + step * np.arange(80)).astype(np.uint8)
    grid = SOURCE.grid(np.tile(row, (64, 1)))
    assert bool(grid.textured[4:-4, 4:-4].all()) == has_texture
    assert bool(grid.textured[4:-4, 4:-4].any()) == has_texture


def test_block_tensors_are_means_of_products_of_gradients() -> None:
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (18, 21), dtype=np.uint8)  # no whole blocks
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    framed = np.pad(smooth, 1, mode="reflect")
    gradient_x = (framed[1:-1, 2:] - framed[1:-1, :-2]) / 2.0
    gradient_y = (framed[2:, 1:-1] - framed[:-2, 1:-1]) / 2.0
    products = [gradient_x**2, gradient_y**2, gradient_x * gradient_y]
    padded = np.pad(np.stack(products, axis=-1), ((0, 2), (0, 3), (0, 0)), mode="edge")
    blocks = padded.reshape(5, 4, 6, 4, 3).mean(axis=(1, 3))
    found = _block_tensors(image, 1.5)
    assert found.dtype == np.float32
    assert_allclose(found, blocks, rtol=1e-4, atol=1e-3)


def textured_blocks(row: Array) -> NDArray[np.bool_]:
    """Return which blocks have texture in an image of which all rows are as one is."""
    image = np.tile(np.rint(row), (64, 1)).astype(np.uint8)
    return SecondMoment(SecondMomentOptions()).grid(image).textured[8]


@pytest.mark.parametrize(("amplitude", "has_texture"), [(8.0, False), (100.0, True)])
def test_stripes_of_four_pixels_are_smoothed_to_a_sixteenth(
    amplitude: float, *, has_texture: bool
) -> None:
    stripes = 128.0 + amplitude * np.cos(0.5 * np.pi * np.arange(120.0))
    assert (textured_blocks(stripes) == has_texture).all()


def test_texture_is_seen_some_pixels_beside_it() -> None:
    """The left part of the image has stripes, up to the column 100."""
    columns = np.arange(400.0)
    stripes = 128.0 + 100.0 * np.cos(columns * np.pi / 8.0) * (columns < 100.0)
    textured = textured_blocks(stripes)
    assert textured[: 112 // STEP_PX].all()
    assert not textured[200 // STEP_PX :].any()
