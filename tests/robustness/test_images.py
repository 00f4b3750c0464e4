"""Images of all kinds beside good ones, through the whole chain."""

from __future__ import annotations

import os
import struct
import unicodedata
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
from colmap_affrect.project.stores import FeatureStore

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
def test_pixels_of_all_kinds_register(trio, run_images, tmp_path) -> None:
    gray = fifth_photograph()
    image = PIL.Image.fromarray(gray)
    image.convert("RGBA").save(trio / "rgba.png")
    image.convert("CMYK").save(trio / "cmyk.jpg", quality=95)
    image.convert("P").save(trio / "palette.png")
    image.convert("RGB").quantize(64).save(trio / "palette.tif")
    image.convert("1", dither=PIL.Image.Dither.NONE).save(trio / "bilevel.png")
    write_image(trio / "deep.png", gray.astype(np.uint16) * 257)
    write_image(trio / "float.tif", gray.astype(np.float32) / 255)
    image.save(trio / "progressive.jpg", progressive=True, quality=95)
    added = sorted({path.name for path in trio.iterdir() if path.is_file()} - set(NAMES))
    assert len(added) == 8
    pairs = tmp_path / "pairs.txt"  # each with the trio only: copies of one image prove nothing
    lines = [f"{one}\t{name}\n" for one in TRIO for name in TRIO if one < name]
    lines += [f"{name}\t{one}\n" for one in TRIO[:2] for name in added]
    pairs.write_text("".join(lines), encoding="utf-8")
    ended = run_images(trio, *FAST, "--match-list-path", pairs)
    assert ended.code == 0, ended.stderr
    assert ended.report["unregistered"] == {}


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


@pytest.mark.long
def test_names_of_all_kinds_go_through(tmp_path, run_images, call) -> None:
    accented = "ž é.png"
    names = [
        "# first.png",
        " leading space.png",
        unicodedata.normalize("NFC", accented),
        unicodedata.normalize("NFD", accented),
        "back\\slash/a,b 'c'  \"d\" %41 $HOME *.png.\u56fe\U0001f3db.png",
    ]
    assert len(set(names)) == 5
    photos = tmp_path / "photos"
    for index, name in enumerate(names):
        (photos / name).parent.mkdir(parents=True, exist_ok=True)
        shift = 0.3 * (index - 2)
        write_image(tmp_path / "one.png", photograph((shift, -0.05 * index, 0.0), 0.0))
        (tmp_path / "one.png").rename(photos / name)
    ended = run_images(photos)
    assert ended.code == 0, ended.stderr
    assert ended.report["registered_names"] == sorted(names)
    listed = tmp_path / "list.txt"
    listed.write_text("# a comment\n" + "".join(f"{name}\n" for name in names), encoding="utf-8")
    again = ["--output-path", tmp_path / "again"]
    images = ["--image-path", photos, "--image-list-path", listed]
    assert call("extract", *again, *images, *FAST).code == 0
    assert FeatureStore(tmp_path / "again" / "features.h5").names() == sorted(names)
    # The list of pairs that the run wrote is one that it reads.
    ended = call("pairs", *again, "--match-list-path", tmp_path / "out" / "pairs.txt")
    assert ended.stdout.startswith("pairs: 10 done")


def test_float_pixels_that_are_not_finite_are_black_or_white(tmp_path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 0.5]], np.float32)
    assert read_gray(write_image(tmp_path / "x.tif", values)).tolist() == [[0, 255, 0, 127]]
