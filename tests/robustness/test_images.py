"""Images of all kinds beside good ones, through the whole chain."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from command import CAMERA, FAST, Call
from results import tree
from small_scene import NAMES, photograph, write_photographs
from synthetic import png_of_size, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.images.reading import IMAGE_SUFFIXES, read_gray

TRIO = sorted(NAMES[:3])
PHOTOGRAPH = photograph((0.8, -0.3, 0.3), -7.5)
"""One more of the small scene, (240, 320) uint8."""
FORMATS = {"WEBP": "WebP", "GIF": "GIF", "AVIF": "AVIF or HEIF", "JPEG2000": "JPEG 2000"}
"""Formats that COLMAP cannot read, as Pillow and as we call them."""
FAILING = {"start.jpg", "0 empty.jpg", "gone.png", "pipe.jpg", "bomb.png"}
FAILING |= {f"{kind}.jpg" for kind in FORMATS}


def write_bad_images(folder: Path) -> None:
    """Put all kinds of bad images beside good ones."""
    photo = PIL.Image.fromarray(PHOTOGRAPH)
    data = cv2.imencode(".jpg", PHOTOGRAPH)[1].tobytes()
    png = (folder / "a.png").read_bytes()
    (folder / "half.jpg").write_bytes(data[: len(data) // 2])
    (folder / "start.jpg").write_bytes(data[:200])
    noise = np.random.default_rng(0).bytes(len(data) - 1400)
    (folder / "noise.jpg").write_bytes(data[:700] + noise + data[-700:])
    (folder / "half.png").write_bytes(png[: len(png) // 2])
    (folder / "0 empty.jpg").write_bytes(b"")
    (folder / "gone.png").symlink_to(folder / "nowhere.png")
    os.mkfifo(folder / "pipe.jpg")
    (folder / "bomb.png").write_bytes(png_of_size(40_000, 40_000))  # more than OpenCV takes
    for kind in FORMATS:
        photo.save(folder / f"{kind}.jpg", format=kind)
    photo.save(folder / "x.webp")
    photo.save(folder / "side" / "y.WebP", format="webp")
    photo.save(folder / "z.gif")


def test_bad_images_are_named_and_the_others_registered(tmp_path: Path, call: Call) -> None:
    photos = tmp_path / "photos"
    write_photographs(photos, 3)
    write_bad_images(photos)
    folders = [photos, photos / "side"]

    def state() -> object:
        return tree(photos), [folder.stat().st_mtime_ns for folder in folders]

    before = state()
    for folder in folders:
        folder.chmod(0o555)  # does not stop root, but then the times of the folders tell
    ended = call("run", "--image-path", photos, "--output-path", tmp_path / "out", "--json", *FAST)
    for folder in folders:
        folder.chmod(0o755)
    assert state() == before
    extraction = ended.report["stages"][0]
    failures, warnings = extraction["failures"], extraction["warnings"]
    # Decoders differ in what they make of data that ends early.
    assert set(failures) >= FAILING >= set(failures) - {"half.jpg", "half.png", "noise.jpg"}
    for kind, name in FORMATS.items():
        assert f"is of the format {name}, which COLMAP cannot read" in failures[f"{kind}.jpg"]
        # So it is in truth, or the rule would keep good images out.
        assert pycolmap.Bitmap.read(photos / f"{kind}.jpg", as_rgb=False) is None
    assert set(TRIO) <= set(ended.report["registered_names"])
    assert (ended.code, len(ended.errors)) == (1, 1)
    assert all(name in ended.errors[0] for name in failures)
    assert set(warnings) == {"*.webp", "*.gif", "contrast"}
    assert warnings["*.webp"].startswith("2 left out, such as side/y.WebP: ")
    assert "colmap-affrect convert makes PNG" in warnings["*.gif"]


@pytest.mark.parametrize("suffix", IMAGE_SUFFIXES)
def test_formats_that_are_taken_are_read_alike_by_colmap(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    mode = {".ppm": "RGB", ".pbm": "1"}.get(suffix, "L")
    PIL.Image.fromarray(PHOTOGRAPH).convert(mode).save(path)
    theirs = pycolmap.Bitmap.read(path, as_rgb=False).to_array()
    np.testing.assert_allclose(read_gray(path).astype(int), theirs.squeeze(), atol=3)


@pytest.mark.long
def test_tiny_images_are_no_obstacle(tmp_path: Path, call: Call) -> None:
    photos = tmp_path / "photos"
    write_photographs(photos, 3)
    tiny = {
        f"{height} x {width}.png": PHOTOGRAPH[100 : 100 + height, :width]
        for height, width in [(1, 1), (1, 320), (140, 1), (7, 7), (31, 31)]
    }
    tiny["flat strip.png"] = np.full((2, 4000), 9, np.uint8)
    for name, gray in tiny.items():
        write_image(photos / name, gray)
    given = ["--image-path", photos, "--output-path", tmp_path / "out", "--json", *CAMERA]
    ended = call("run", *given)
    assert ended.code == 0, ended.stderr
    assert ended.report["registered_names"] == TRIO
    assert set(ended.report["unregistered"]) == set(tiny)
    assert set(ended.report["unregistered"].values()) <= {"no features", "no verified pair"}


def test_float_pixels_that_are_not_finite_are_black_or_white(tmp_path: Path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 0.5]], np.float32)
    assert read_gray(write_image(tmp_path / "x.tif", values)).tolist() == [[0, 255, 0, 127]]
