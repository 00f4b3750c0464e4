"""Reading of images of all kinds, their sizes and regions, and OpenCV's threads."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest
from numpy.testing import assert_allclose
from synthetic import blobs, centroid, png_of_size, write_image

from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.conventions import resized_from_original
from colmap_affrect.images import reading
from colmap_affrect.images.pnm import pnm_header
from colmap_affrect.images.reading import (
    IMAGE_SUFFIXES,
    decode,
    header_size,
    in_eight_bits,
    read_color,
    read_gray,
    read_header,
    shrink_to,
    tones,
)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_read_gray_weighs_colours_as_itu_601(tmp_path: Path, suffix: str) -> None:
    bgr = np.zeros((2, 4, 3), np.uint8)
    bgr[0] = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]]
    path = write_image(tmp_path / f"colours{suffix}", bgr)
    expected = [0.114 * 255, 0.587 * 255, 0.299 * 255, 0.114 * 200 + 58.7 + 0.299 * 50]
    assert_allclose(read_gray(path)[0], expected, atol=1)
    assert read_gray(path)[1].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_read_gray_scales_sixteen_bits_to_eight(tmp_path: Path, suffix: str) -> None:
    values = np.array(
        [[0, 257, 128 * 257, 65535], [256, 1000, 30000, 65000]], np.uint16
    )
    read = read_gray(write_image(tmp_path / f"deep{suffix}", values))
    assert read.dtype == np.uint8
    assert read.tolist() == [[0, 1, 128, 255], [0, 3, 116, 252]]


def test_read_gray_reads_floats_from_zero_to_one(tmp_path: Path) -> None:
    values = np.array([[0.0, 0.5, 1.0], [-0.2, 0.25, 1.7]], np.float32)
    read = read_gray(write_image(tmp_path / "float.tif", values))
    assert_allclose(read, [[0, 127.5, 255], [0, 63.75, 255]], atol=1)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", None])
def test_read_gray_names_the_file_that_is_no_image(
    tmp_path: Path, content: bytes | None
) -> None:
    path = tmp_path / "broken name.jpg"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError, match=r"broken name\.jpg"):
        read_gray(path)
    with pytest.raises(ImageError, match=re.escape(str(tmp_path))):
        read_gray(tmp_path)


@pytest.mark.parametrize("limit", [150, 97])
def test_shrink_to_moves_points_as_the_conventions_say(limit: int) -> None:
    center = np.array([[101.4, 52.8]])
    image = blobs((300, 170), center, 12.0 * np.eye(2), background=0)
    small = shrink_to(image, limit)
    matrix = resized_from_original((300, 170), small.shape[::-1])
    assert_allclose(centroid(small), project(matrix, center)[0], atol=0.03)


def test_low_contrast_is_stretched_alike_in_gray_and_colour(tmp_path: Path) -> None:
    ramp = np.tile(np.linspace(90, 150, 200), (120, 1)).astype(np.uint8)
    ramp[:, :15], ramp[:, -15:] = 255, 0  # the frame of a scan
    path = write_image(tmp_path / "faded.png", cv2.cvtColor(ramp, cv2.COLOR_GRAY2BGR))
    np.testing.assert_array_equal(read_gray(path), ramp)
    stored = decode(path)
    gray = in_eight_bits(stored, tones(stored))
    color = read_color(path, 200)
    assert_allclose(gray[5, [22, 100, 177]], [0, 128, 255], atol=4)
    assert (gray[:, :15] == 255).all()
    assert not gray[:, -15:].any()
    np.testing.assert_array_equal(color, np.dstack([gray] * 3))
    np.testing.assert_array_equal(read_color(path, 200, stretch=False)[..., 0], ramp)


@pytest.mark.parametrize(
    ("side_px", "divisor", "of_shown"),
    [(79, 1, 2), (81, 1, 1), (41, 1, 2), (39, 1, 4), (20, 8, 8), (21, 1, 4)],
)
def test_the_decoder_shrinks_what_is_far_larger_or_only_shown(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    side_px: int,
    divisor: int,
    of_shown: int,
) -> None:
    path = write_image(tmp_path / "a.jpg", np.zeros((100, 160, 3), np.uint8))
    decoded = []
    decode_file = reading.decode

    def decode_and_note(path: Path, flags: int) -> Any:
        decoded.append(decode_file(path, flags))
        return decoded[-1]

    monkeypatch.setattr(reading, "decode", decode_and_note)
    for is_shown in (False, True):
        assert read_color(path, side_px, is_shown=is_shown).shape[1] == side_px
    assert [image.shape[1] for image in decoded] == [160 // divisor, 160 // of_shown]


@pytest.mark.parametrize("value_range", [(40, 220), (100, 108)])
def test_tones_stay_where_contrast_is_good_or_nothing_is_seen(
    value_range: tuple[int, int],
) -> None:
    image = np.tile(np.linspace(*value_range, 100), (50, 1)).astype(np.uint8)
    assert tones(image) is None


@pytest.mark.parametrize("suffix", [*IMAGE_SUFFIXES, ".big.tif", ".motorola.tif"])
@pytest.mark.parametrize("orientation", [1, 6])
def test_header_and_pixels_are_those_that_are_stored(
    tmp_path: Path, suffix: str, orientation: int
) -> None:
    path = tmp_path / f"a{suffix}"
    exif = PIL.Image.Exif()
    exif[PIL.ExifTags.Base.Orientation] = orientation
    values = np.zeros((30, 50), np.uint8)
    values[:8, :24] = 255
    photo = PIL.Image.fromarray(values).convert("1" if suffix == ".pbm" else "L")
    if suffix == ".motorola.tif":
        photo = PIL.Image.frombytes("I;16B", (50, 30), values.repeat(2).tobytes())
    photo.save(path, exif=exif, big_tiff=suffix == ".big.tif")
    assert (path.read_bytes()[:2] == b"MM") == (suffix == ".motorola.tif")
    assert header_size(path) == (50, 30)
    assert_allclose(read_gray(path), values, atol=40)
    assert_allclose(read_color(path, 50)[:, :, 1], values, atol=40)


def test_size_of_a_photograph_of_four_hundred_megapixels_is_known(
    tmp_path: Path,
) -> None:
    """Pillow opens no more than 179 megapixels; cameras that shift their sensor have more."""
    path = tmp_path / "a.png"
    path.write_bytes(png_of_size(23_200, 17_400))
    assert header_size(path) == (23_200, 17_400)
    path.write_bytes(b"P5 no number")
    assert header_size(path) is None


def test_threads_that_read_headers_leave_filters_of_warnings(tmp_path: Path) -> None:
    path = write_image(tmp_path / "a.png", np.zeros((8, 8), np.uint8))
    before = [*warnings.filters]
    with ThreadPoolExecutor(2) as threads:
        for duration_s in (0.1, 0.3):  # the one that begins later ends later
            threads.submit(read_header, path, lambda _, s=duration_s: time.sleep(s))
    assert warnings.filters == before


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 255.0), (-1.0, 1.0), (-9.0, -5.0), (0.0, 1e6)]
)
def test_floats_of_any_range_are_seen(tmp_path: Path, low: float, high: float) -> None:
    ramp = np.linspace(low, high, 4000, dtype=np.float32).reshape(50, 80)
    path = write_image(tmp_path / "x.tif", ramp)
    expected = np.linspace(0, 255, 4000).reshape(50, 80)
    assert_allclose(read_gray(path).astype(float), expected, atol=40)
    assert len(np.unique(read_gray(path))) > 200
    assert_allclose(read_color(path, 80)[:, :, 0].astype(float), expected, atol=40)


@pytest.mark.skipif(
    not Path("/proc/self/mem").exists(), reason="only Linux has such a file"
)
@pytest.mark.parametrize("rest", [b"\xff" * 4_000_000, b"\xff\x00" * 2_000_000])
def test_header_of_nothing_but_fill_is_no_header_at_once(
    tmp_path: Path, rest: bytes
) -> None:
    """Pillow reads such a JPEG byte by byte, in Python."""
    path = tmp_path / "x.jpg"
    path.write_bytes(b"\xff\xd8" + rest)
    start = time.process_time()
    assert header_size(path) is None
    assert time.process_time() - start < 0.7  # it took 3 seconds and more


def test_photograph_of_thousands_of_parts_is_read(tmp_path: Path) -> None:
    pages = [PIL.Image.fromarray(np.zeros((8, 8), np.uint8))] * 400
    pages[0].save(tmp_path / "x.tif", save_all=True, append_images=pages[1:])
    assert len(reading.pages(tmp_path / "x.tif")) == 400


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_floats_that_are_no_numbers_are_read_without_a_warning(value: float) -> None:
    image = np.full((40, 60), value, np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tones(image) is None
        assert in_eight_bits(image).std() == 0.0


def test_a_file_whose_content_cannot_be_read_is_an_image_that_cannot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "x.jpg").symlink_to("/proc/self/mem")
    with pytest.raises(ImageError, match=r"x\.jpg: "):
        decode(tmp_path / "x.jpg")
    (tmp_path / "y.jpg").write_bytes(b"content")

    def fail(_: Path) -> object:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr("colmap_affrect.images.reading.open_regular", fail)
    with pytest.raises(
        ImageError, match=r"y\.jpg: cannot be read \(Input/output error\)"
    ):
        decode(tmp_path / "y.jpg")


@pytest.mark.parametrize("white", [1, 15, 100, 255, 300, 4095, 65535])
@pytest.mark.parametrize("kind", [2, 3, 5, 6])
def test_white_of_pnm_is_any_number(tmp_path: Path, kind: int, white: int) -> None:
    """Of text, too, that ends with its last number."""
    channels = 1 if kind in (2, 5) else 3
    values = np.random.default_rng(0).integers(0, white + 1, (9, 11))
    values[0, :2] = (0, white)
    numbers = np.repeat(values[:, :, None], channels, axis=2).ravel()
    if kind in (2, 3):
        content = " ".join(map(str, numbers)).encode()
    else:
        content = numbers.astype(">u2" if white > 255 else "u1").tobytes()
    path = tmp_path / "a.pnm"
    path.write_bytes(f"P{kind} # {white}\n11 9\n{white}\n".encode() + content)
    expected = values * (255.0 / white)
    assert np.abs(read_gray(path) - expected).max() <= 1.0


def test_numbers_that_are_no_tones_stay(tmp_path: Path) -> None:
    path = tmp_path / "depth.pgm"
    path.write_bytes(b"P5 2 1 5000\n" + np.array([1200, 5000], ">u2").tobytes())
    assert decode(path, cv2.IMREAD_UNCHANGED, keeps_numbers=True).tolist() == [
        [1200, 5000]
    ]


@pytest.mark.parametrize(
    "header", [b"P5 2 2 0\n", b"P5 2 2 70000\n", b"P4 16 2\n", b"P5 2 2"]
)
def test_header_without_a_possible_white_changes_nothing(header: bytes) -> None:
    assert pnm_header(np.frombuffer(header + bytes(8), np.uint8)) is None


def test_limit_of_the_environment_is_named(tmp_path: Path) -> None:
    """OpenCV reads it once, so that another process must be asked."""
    path = tmp_path / "a.png"
    path.write_bytes(cv2.imencode(".png", np.zeros((20, 30), np.uint8))[1].tobytes())
    code = (
        "import sys\nfrom pathlib import Path\nfrom colmap_affrect.images.reading import decode\n"
        "try:\n    decode(Path(sys.argv[1]))\nexcept Exception as error:\n    print(error)"
    )
    limit = {"OPENCV_IO_MAX_IMAGE_PIXELS": "100"}
    done = subprocess.run(
        [sys.executable, "-c", code, path],
        env={**os.environ, **limit},
        capture_output=True,
        text=True,
        check=True,
    )
    assert (
        "is larger than OpenCV may read here, by OPENCV_IO_MAX_IMAGE_PIXELS=100"
        in done.stdout
    )
