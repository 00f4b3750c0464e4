"""Reading of images of all kinds, and warps that are exact and free of aliasing."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import Array, tilt_angles
from synthetic import blobs, centroid, texture, write_image

from colmap_affrect.conventions import resized_from_original
from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.canvas import fit_canvas, rectifying_affine
from colmap_affrect.imaging import read_gray, shrink_to, warp, warp_mask
from colmap_affrect.types import GrayImage, Rectification

RAMP_ERROR_PX = 0.05
"""A plane fitted to a thousand samples or more with 8-bit rounding, at its corners."""

ALIGNED_RAMP_ERROR_PX = 0.15
"""Where the ramp runs along the warp's axes all samples of a row are rounded alike, worth up to
0.12 px (with floats it is 0.00). Half a px of a warp would be at least 0.2 px of the image."""

DITHER = 0.5
"""Noise in gray values that makes the rounding of the ramp random."""

BLOB_MEAN_ERROR_PX = 0.05
BLOB_WORST_ERROR_PX = 0.12
"""Centroids of a Gaussian of sigma 6 px after 8-bit rounding; measured for this warp."""

SIZE = (150, 100)


def rectification(tilt: float, angle_rad: float, size: tuple[int, int] = SIZE) -> Rectification:
    """Warp of a whole image of (width, height)."""
    width, height = size
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1.0]])
    matrix, canvas = fit_canvas(rectifying_affine(tilt, angle_rad), corners, margin_px=4.0)
    return Rectification(matrix, canvas, np.ones((height, width), bool), tilt, angle_rad)


def canvas_points(plan: Rectification) -> Array:
    """(H, W, 2) pixel-centre coordinates of all pixels of the canvas."""
    width, height = plan.canvas_size
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(float)


@settings(max_examples=60)
@given(st.floats(1.0, 6.22), tilt_angles, st.sampled_from([0, 1]))
@example(1.0, 0.0, 1)
@example(6.22, 0.0, 0)
@example(6.22, np.pi / 2, 1)
@example(4.0, 0.6, 0)
def test_warp_of_a_coordinate_ramp_shows_image_from_rectified(
    tilt: float, angle_rad: float, axis: int
) -> None:
    plan = rectification(tilt, angle_rad)
    slope = 240.0 / SIZE[axis]
    noise = np.random.default_rng(0).uniform(-DITHER, DITHER, SIZE[::-1])
    ramp = np.rint(DITHER + noise + slope * np.indices(SIZE[::-1])[1 - axis]).astype(np.uint8)
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
    assert np.abs(values.ravel()[inside] - sources[inside, axis]).max() < (DITHER + 1.5) / slope


def test_warp_keeps_gaussian_blobs_in_place_up_to_tilt_6_22() -> None:
    rng = np.random.default_rng(11)
    errors = []
    for tilt in (1.0, 2.0, 2.51, 3.15, 3.95, 4.96, 6.22):
        for angle_rad in (0.0, 0.37, 1.2, np.pi / 2, 2.5):
            center = np.array([[75.0, 50.0]]) + rng.uniform(-3, 3, (1, 2))
            image = blobs(SIZE, center, 6.0 * np.eye(2), amplitude=220, background=0)
            plan = rectification(tilt, angle_rad)
            # Outside the image the warp shows mirror images of the blob.
            sources = project(plan.image_from_rectified, canvas_points(plan).reshape(-1, 2))
            near = np.linalg.norm(sources - center, axis=1) < 40
            shown = warp(image, plan) * near.reshape(plan.canvas_size[::-1])
            back = project(plan.image_from_rectified, centroid(shown)[None])
            errors.append(np.linalg.norm(back - center))
    assert np.mean(errors) <= BLOB_MEAN_ERROR_PX
    assert np.max(errors) <= BLOB_WORST_ERROR_PX


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


@pytest.mark.parametrize("angle_rad", [0.0, 0.7, np.pi / 2, 2.2])
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


@pytest.mark.parametrize("angle_rad", [0.0, 0.7, 2.2])
def test_warp_does_not_blur_the_stretched_axis(angle_rad: float) -> None:
    plan = rectification(6.22, angle_rad)
    stretched = plan.rectified_from_image[0, :2]
    stretched = stretched / np.linalg.norm(stretched)
    assert amplitude(grating(stretched, 8.0), plan) > 80.0


def test_warp_by_the_identity_copies_the_image() -> None:
    image = texture(SIZE, seed=1)
    plan = Rectification(np.eye(3), SIZE, np.ones(SIZE[::-1], bool), 1.0, 0.0)
    np.testing.assert_array_equal(warp(image, plan), image)


def test_warp_of_a_flat_image_is_flat() -> None:
    image = np.full(SIZE[::-1], 77, np.uint8)
    assert np.unique(warp(image, rectification(5.0, 1.0))).tolist() == [77]


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (3, 2)])
def test_warp_of_tiny_images_has_the_planned_size(size: tuple[int, int]) -> None:
    image = np.full(size[::-1], 90, np.uint8)
    plan = rectification(4.0, 0.8, size)
    assert warp(image, plan).shape == plan.canvas_size[::-1]


def test_warp_mask_marks_the_pixels_whose_source_is_in_the_region() -> None:
    region = np.zeros((45, 90), bool)
    region[5:, 10:] = True
    plan = replace(rectification(3.0, 0.5), region=region, region_origin=(20, 15))
    mask = warp_mask(plan)
    assert mask.shape == plan.canvas_size[::-1]
    assert np.unique(mask).tolist() == [0, 255]
    sources = project(plan.image_from_rectified, canvas_points(plan).reshape(-1, 2))
    low, high = np.array([29.5, 19.5]), np.array([109.5, 59.5])
    slack = 0.1  # of OpenCV's fixed-point coordinates
    surely = ((sources > low + slack) & (sources < high - slack)).all(axis=1)
    surely_not = ((sources < low - slack) | (sources > high + slack)).any(axis=1)
    assert (mask.ravel()[surely] == 255).all()
    assert (mask.ravel()[surely_not] == 0).all()
    assert surely.any()
    assert surely_not.any()


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".ppm"])
def test_read_gray_weighs_colours_as_itu_601(tmp_path: Path, suffix: str) -> None:
    bgr = np.zeros((2, 4, 3), np.uint8)
    bgr[0] = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]]
    path = write_image(tmp_path / f"colours{suffix}", bgr)
    expected = [0.114 * 255, 0.587 * 255, 0.299 * 255, 0.114 * 200 + 58.7 + 0.299 * 50]
    assert_allclose(read_gray(path)[0], expected, atol=1)
    assert read_gray(path)[1].tolist() == [0, 0, 0, 0]


def test_read_gray_returns_contiguous_rows_of_eight_bits(tmp_path: Path) -> None:
    image = np.arange(15, dtype=np.uint8).reshape(3, 5)
    read = read_gray(write_image(tmp_path / "ramp.png", image))
    assert read.dtype == np.uint8
    assert read.flags.c_contiguous
    np.testing.assert_array_equal(read, image)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_read_gray_scales_sixteen_bits_to_eight(tmp_path: Path, suffix: str) -> None:
    values = np.array([[0, 257, 128 * 257, 65535], [256, 1000, 30000, 65000]], np.uint16)
    read = read_gray(write_image(tmp_path / f"deep{suffix}", values))
    assert read.dtype == np.uint8
    assert_allclose(read, values / 257.0, atol=1)
    assert read[0].tolist() == [0, 1, 128, 255]


def test_read_gray_scales_sixteen_bit_colours(tmp_path: Path) -> None:
    bgr = np.full((3, 2, 3), (10000, 20000, 60000), np.uint16)
    read = read_gray(write_image(tmp_path / "deep.png", bgr))
    expected = (0.114 * 10000 + 0.587 * 20000 + 0.299 * 60000) / 257
    assert_allclose(read, np.full((3, 2), expected), atol=1)


def test_read_gray_reads_floats_from_zero_to_one(tmp_path: Path) -> None:
    values = np.array([[0.0, 0.5, 1.0], [-0.2, 0.25, 1.7]], np.float32)
    read = read_gray(write_image(tmp_path / "float.tif", values))
    assert_allclose(read, [[0, 127.5, 255], [0, 63.75, 255]], atol=1)


def test_read_gray_ignores_transparency(tmp_path: Path) -> None:
    bgra = np.zeros((2, 3, 4), np.uint8)
    bgra[..., :3] = 100
    bgra[..., 3] = [[0, 128, 255], [255, 0, 1]]
    assert (read_gray(write_image(tmp_path / "clear.png", bgra)) == 100).all()


def jpeg_with_orientation(image: GrayImage, orientation: int) -> bytes:
    """JPEG whose EXIF segment holds nothing but the orientation tag."""
    success, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    assert success
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    tiff = b"II*\x00" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + bytes(4)
    segment = b"Exif\x00\x00" + tiff
    jpeg = data.tobytes()
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_read_gray_does_not_apply_the_exif_orientation(tmp_path: Path, orientation: int) -> None:
    image = blobs((48, 32), [[10.0, 8.0]], 4.0 * np.eye(2))
    path = tmp_path / "turned.jpg"
    path.write_bytes(jpeg_with_orientation(image, orientation))
    if orientation >= 5:
        obeying = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert obeying.shape == (48, 32), "the EXIF bytes of this test are not understood"
    assert_allclose(read_gray(path).astype(int), image, atol=4)


@pytest.mark.parametrize(
    "content", [b"", b"no image at all", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]
)
def test_read_gray_names_the_file_that_is_no_image(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken name.jpg"
    path.write_bytes(content)
    with pytest.raises(ImageError, match=r"broken name\.jpg"):
        read_gray(path)


def test_read_gray_names_the_file_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"missing\.png"):
        read_gray(tmp_path / "missing.png")


def test_read_gray_of_a_folder_is_an_image_error(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(ImageError, match="folder"):
        read_gray(tmp_path / "folder")


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".bmp"])
@pytest.mark.parametrize("kept_frac", [0.02, 0.5, 0.9])
def test_read_gray_of_a_truncated_file_keeps_the_size_or_is_an_image_error(
    tmp_path: Path, suffix: str, kept_frac: float
) -> None:
    image = texture((120, 70), seed=2)
    path = write_image(tmp_path / f"cut{suffix}", image)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept_frac * len(data))])
    try:
        read = read_gray(path)
    except ImageError:
        return
    assert read.shape == image.shape
    if suffix != ".bmp":  # which stores its last row first
        assert_allclose(read[:4].astype(int), image[:4], atol=25)


def test_read_gray_reads_names_with_spaces_and_letters_of_all_kinds(tmp_path: Path) -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    path = write_image(tmp_path / "Žižkův dům #1.png", image)
    np.testing.assert_array_equal(read_gray(path), image)


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (30, 1)])
def test_read_gray_reads_images_of_one_pixel_width(tmp_path: Path, shape: tuple[int, int]) -> None:
    image = np.full(shape, 200, np.uint8)
    assert read_gray(write_image(tmp_path / "thin.png", image)).shape == shape


def test_shrink_to_keeps_an_image_that_fits() -> None:
    image = texture((90, 60), seed=4)
    assert shrink_to(image, 90) is image


@pytest.mark.parametrize(
    ("size", "limit", "expected"),
    [((200, 100), 50, (50, 25)), ((90, 300), 100, (30, 100)), ((1000, 1), 10, (10, 1))],
)
def test_shrink_to_limits_the_longer_side(
    size: tuple[int, int], limit: int, expected: tuple[int, int]
) -> None:
    small = shrink_to(np.full(size[::-1], 120, np.uint8), limit)
    assert small.shape == expected[::-1]
    assert (small == 120).all()


def test_shrink_to_averages_areas() -> None:
    stripes = np.zeros((40, 80), np.uint8)
    stripes[:, ::2] = 200
    assert (shrink_to(stripes, 40) == 100).all()


@pytest.mark.parametrize("limit", [150, 97, 40])
def test_shrink_to_moves_points_as_the_conventions_say(limit: int) -> None:
    center = np.array([[101.4, 52.8]])
    image = blobs((300, 170), center, 12.0 * np.eye(2), background=0)
    small = shrink_to(image, limit)
    matrix = resized_from_original((300, 170), small.shape[::-1])
    assert_allclose(centroid(small), project(matrix, center)[0], atol=0.03)
