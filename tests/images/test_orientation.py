"""Exported pictures lie as their pixels do: no program turns them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from exported_model import SIZE, write_model
from PIL import Image, ImageOps
from synthetic import texture

from colmap_affrect.images.orientation import (
    forget_orientation,
    orientation,
    picture_down,
)
from colmap_affrect.interop.export import export

XMP = b"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description
xmlns:tiff="http://ns.adobe.com/tiff/1.0/" tiff:Orientation="8"/></rdf:RDF></x:xmpmeta>"""
AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
NAMES = ("a.jpg", "b.png", "side/c.tif", "d.bmp")


def write_turned(
    path: Path, seed: int, number: int = 6, *, has_exif: bool = True
) -> None:
    """Write a photograph that says it lies on its side; what cannot say so is upright."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    given = dict[str, object]()
    exif[0x112], exif[0x10F] = number, "Canon"
    if has_exif and path.suffix != ".bmp":
        given["exif"] = exif
    if path.suffix == ".jpg":
        given["xmp"] = XMP
    Image.fromarray(texture(SIZE, seed)).save(path, **given)


@pytest.mark.parametrize("form", ["undistorted", "nerfstudio"])
def test_exported_pictures_stand_upright(tmp_path: Path, form: str) -> None:
    model = write_model(tmp_path / "model")
    for seed, (number, name) in enumerate(
        zip(sorted(model.images), NAMES, strict=True)
    ):
        model.images[number].name = name
        write_turned(tmp_path / "photos" / name, seed)
    model.write(tmp_path / "model")
    export(tmp_path / "model", tmp_path / "out", [form], image_path=tmp_path / "photos")
    for name in NAMES:
        before = tmp_path / "photos" / name
        path = tmp_path / "out" / "dense" / "images" / name
        assert orientation(before) == (1 if name == "d.bmp" else 6)
        assert orientation(path) == 1
        with Image.open(path) as picture:
            width, height = picture.size
            assert ImageOps.exif_transpose(picture).size == (width, height)
        assert width > height
        assert cv2.imread(str(path)).shape[:2] == (height, width)


@pytest.mark.parametrize("number", range(2, 9))
@pytest.mark.parametrize("name", ["a.jpg", "b.png", "c.tif"])
def test_only_what_says_how_it_lies_is_changed(
    tmp_path: Path, name: str, number: int
) -> None:
    path = tmp_path / name
    write_turned(path, 1, number)
    before = cv2.imread(str(path), AS_STORED)
    size = path.stat().st_size
    linked = tmp_path / "linked"
    linked.hardlink_to(path)
    forget_orientation(path)
    assert orientation(path) == 1
    with Image.open(path) as picture:
        assert picture.getexif()[0x10F] == "Canon"
    assert path.stat().st_size == size
    if name != "c.tif":  # which OpenCV turns whatever the flags say
        assert (cv2.imread(str(path)) == before).all()
    assert orientation(linked) == number  # which may be a photograph of the user


def test_xmp_alone_is_changed_too(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    write_turned(path, 1, has_exif=False)
    said = re.compile(
        rb"tiff:Orientation\D+(\d)"
    )  # old versions of Pillow do not look there
    assert said.findall(path.read_bytes()) == [b"8"]
    forget_orientation(path)
    assert said.findall(path.read_bytes()) == [b"1"]
    assert orientation(path) == 1


def test_damaged_pictures_are_left_as_they_are(tmp_path: Path) -> None:
    write_turned(tmp_path / "whole.jpg", 1)
    data = (tmp_path / "whole.jpg").read_bytes()
    for count, start in enumerate(
        (b"", b"\x89PNG\r\n\x1a\n", data[:30], data[:3], b"II*\0", b"MM")
    ):
        path = tmp_path / str(count)
        path.write_bytes(start)
        forget_orientation(path)
        assert path.read_bytes() == start


@pytest.mark.parametrize("number", range(1, 9))
def test_downwards_is_where_the_lower_edge_of_the_picture_is_stored(
    tmp_path: Path, number: int
) -> None:
    stored = np.full((40, 60), 20, np.uint8)
    expected = {
        1: (0, 1),
        2: (0, 1),
        3: (0, -1),
        4: (0, -1),
        5: (1, 0),
        6: (1, 0),
        7: (-1, 0),
        8: (-1, 0),
    }
    right, down = expected[number]
    columns = slice(None) if right == 0 else slice(30, 60) if right > 0 else slice(30)
    rows = slice(None) if down == 0 else slice(20, 40) if down > 0 else slice(20)
    stored[rows, columns] = 220
    exif = Image.Exif()
    exif[0x112] = number
    path = tmp_path / "a.png"
    Image.fromarray(stored).save(path, exif=exif)
    assert picture_down(path) == (right, down)
    with Image.open(path) as picture:
        shown = np.asarray(ImageOps.exif_transpose(picture))
    middle = shown.shape[0] // 2
    assert shown[middle:].min() == 220
    assert shown[:middle].max() == 20
