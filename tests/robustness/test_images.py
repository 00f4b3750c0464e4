"""Images of all kinds beside good ones, through the whole chain."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from command import CAMERA, FAST, Ended, run_in_process_of_its_own
from results import state
from small_scene import NAMES, photograph, write_photographs
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.images.reading import IMAGE_SUFFIXES, read_gray

TRIO = sorted(NAMES[:3])


def fifth_photograph() -> np.ndarray:
    """One more photograph of the small scene, (240, 320) uint8."""
    return photograph((0.8, -0.3, 0.3), -7.5)


FORMATS = {"WEBP": "WebP", "GIF": "GIF", "AVIF": "AVIF or HEIF", "JPEG2000": "JPEG 2000"}
"""Formats that COLMAP cannot read, as Pillow and as we call them."""


def write_bad_images(folder: Path) -> None:
    """Put all kinds of bad images beside good ones."""
    photo = PIL.Image.fromarray(fifth_photograph())
    data = cv2.imencode(".jpg", fifth_photograph())[1].tobytes()
    png = (folder / "a.png").read_bytes()
    (folder / "half.jpg").write_bytes(data[: len(data) // 2])
    (folder / "start.jpg").write_bytes(data[:200])
    noise = np.random.default_rng(0).bytes(len(data) - 1400)
    (folder / "noise.jpg").write_bytes(data[:700] + noise + data[-700:])
    (folder / "half.png").write_bytes(png[: len(png) // 2])
    (folder / "0 empty.jpg").write_bytes(b"")
    (folder / "gone.png").symlink_to(folder / "nowhere.png")
    os.mkfifo(folder / "pipe.jpg")
    # The header says 40000 x 40000 px, more than OpenCV takes; it raises instead of returning.
    header = b"IHDR" + struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    (folder / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    for kind in FORMATS:
        photo.save(folder / f"{kind}.jpg", format=kind)
    photo.save(folder / "x.webp")
    photo.save(folder / "side" / "y.WebP", format="webp")
    photo.save(folder / "z.gif")


@dataclass(frozen=True)
class Mixed:
    """A run of three good images among bad ones, in folders that may not be written to."""

    photos: Path
    out: Path
    ended: Ended
    changed: bool


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Mixed:
    base = tmp_path_factory.mktemp("mixed")
    photos, out = base / "photos", base / "out"
    write_photographs(photos, 3)
    write_bad_images(photos)
    before = state(photos)
    folders = [photos, photos / "side"]
    for folder in folders:
        folder.chmod(0o555)  # does not stop root, but then the times of the folders tell
    try:
        ended = run_in_process_of_its_own(
            "run", "--image-path", photos, "--output-path", out, "--json", *FAST
        )
    finally:
        for folder in folders:
            folder.chmod(0o755)
    return Mixed(photos, out, ended, state(photos) != before)


def test_bad_images_are_reported_and_the_others_registered(mixed: Mixed) -> None:
    failures = mixed.ended.report["stages"][0]["failures"]
    surely = {"start.jpg", "0 empty.jpg", "gone.png", "pipe.jpg", "bomb.png"}
    surely |= {f"{kind}.jpg" for kind in FORMATS}
    # Decoders differ in what they make of data that ends early.
    assert surely <= set(failures) <= surely | {"half.jpg", "half.png", "noise.jpg"}
    assert set(TRIO) <= set(mixed.ended.report["registered_names"])
    assert mixed.ended.code == 1
    assert len(mixed.ended.errors) == 1
    assert all(name in mixed.ended.errors[0] for name in failures)
    assert not mixed.changed


def test_formats_that_colmap_cannot_read_are_reported(mixed: Mixed) -> None:
    warnings = mixed.ended.report["stages"][0]["warnings"]
    assert set(warnings) == {"*.webp", "*.gif", "contrast"}
    assert warnings["*.webp"].startswith("2 left out, such as side/y.WebP: ")
    assert "colmap-affrect convert makes PNG" in warnings["*.gif"]
    assert any("*.gif: 1 left out, such as z.gif" in line for line in mixed.ended.stderr)


def test_format_is_told_by_content_and_not_by_suffix(mixed: Mixed) -> None:
    failures = mixed.ended.report["stages"][0]["failures"]
    for kind, name in FORMATS.items():
        assert f"is of the format {name}, which COLMAP cannot read; conv" in failures[f"{kind}.jpg"]
        # So it is in truth, or the rule would keep good images out.
        assert pycolmap.Bitmap.read(mixed.photos / f"{kind}.jpg", as_rgb=False) is None


@pytest.mark.parametrize("suffix", IMAGE_SUFFIXES)
def test_formats_that_are_taken_are_read_alike_by_colmap(tmp_path, suffix) -> None:
    mode = {".ppm": "RGB", ".pbm": "1"}.get(suffix, "L")
    PIL.Image.fromarray(fifth_photograph()).convert(mode).save(tmp_path / f"x{suffix}")
    theirs = pycolmap.Bitmap.read(tmp_path / f"x{suffix}", as_rgb=False).to_array()
    ours = read_gray(tmp_path / f"x{suffix}")
    np.testing.assert_allclose(ours.astype(int), theirs.squeeze(), atol=3)


@pytest.mark.long
def test_tiny_images_are_no_obstacle(trio, run_images) -> None:
    gray = fifth_photograph()
    sizes = {"1x1": (1, 1), "1 high": (1, 320), "1 wide": (240, 1), "7": (7, 7), "31": (31, 31)}
    for name, (height, width) in sizes.items():
        write_image(trio / f"{name}.png", gray[100 : 100 + height, :width])
    write_image(trio / "flat strip.png", np.full((2, 4000), 9, np.uint8))
    ended = run_images(trio, "--recipe", "default", *CAMERA)
    assert ended.code == 0, ended.stderr
    assert ended.report["registered_names"] == TRIO
    assert set(ended.report["unregistered"]) == {f"{name}.png" for name in [*sizes, "flat strip"]}
    assert set(ended.report["unregistered"].values()) <= {"no features", "no verified pair"}


def test_float_pixels_that_are_not_finite_are_black_or_white(tmp_path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 0.5]], np.float32)
    assert read_gray(write_image(tmp_path / "x.tif", values)).tolist() == [[0, 255, 0, 127]]
