"""EXIF is checked against itself and against the file, and nothing in it can break a run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from photographs_with_exif import BODY, LENS_50, write_photograph

from colmap_affrect.colmap import pycolmap
from colmap_affrect.images.exif import CameraTags, exif_focal, read_camera_tags

MM50 = {**BODY, "FocalLength": 50.0}


def tags_of(path: Path, size: tuple[int, int], tags: dict[str, Any]) -> CameraTags:
    write_photograph(path, size, tags)
    found = read_camera_tags(path)
    assert found is not None
    return found


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("tags", [
    {**BODY, "FocalLengthIn35mmFilm": 28},
    {**MM50, "FocalPlaneXResolution": 3 / 0.7, "FocalPlaneResolutionUnit": 4},
    {
        "Make": "A", "FocalLength": 6.1, "FocalPlaneXResolution": 312.5,
        "FocalPlaneResolutionUnit": 3,
        "FocalPlaneYResolution": 312.5, "ExifImageWidth": 180, "ExifImageHeight": 120,
    },
    {},
])  # fmt: skip
def test_focal_length_of_right_exif_is_exactly_colmaps(
    tmp_path: Path, suffix: str, tags: dict[str, Any]
) -> None:
    path = tmp_path / f"a{suffix}"
    found = exif_focal(tags_of(path, (180, 120), tags))
    assert (
        found.focal_px == pycolmap.Bitmap.read(path, as_rgb=False).exif_focal_length()
    )
    assert (found.is_rescaled, found.why) == (
        False,
        "" if tags else "no EXIF focal length in px",
    )


@pytest.mark.parametrize(
    ("size", "scale"), [((1092, 728), 4), ((728, 1092), 4), ((546, 364), 8)]
)
def test_photograph_that_was_shrunk_is_rescaled_also_if_it_was_turned(
    tmp_path: Path, size: tuple[int, int], scale: int
) -> None:
    original = {"ExifImageWidth": 4368, "ExifImageHeight": 2912}
    tags = tags_of(tmp_path / "a.jpg", size, {**LENS_50, **original})
    found = exif_focal(tags)
    assert found.focal_px == pytest.approx(50 / 35.8 * 4368 / scale)
    assert found.is_rescaled
    assert found.why == f"shrunk: {size[0]} x {size[1]} px, when taken 4368 x 2912"
    assert tags.identity is not None


@pytest.mark.parametrize(("size", "tags", "why"), [
    ((1092, 600), {"ExifImageWidth": 4368, "ExifImageHeight": 2912}, "cropped or padded: 1092"),
    ((160, 107), {"ExifImageWidth": 4368, "ExifImageHeight": 2912}, "a thumbnail: 160 x 107"),
    ((300, 200), {}, "resolution would be a focal length of 20 longer sides"),
])  # fmt: skip
def test_cropped_ones_thumbnails_and_impossible_views_are_distrusted(
    tmp_path: Path, size: tuple[int, int], tags: dict[str, Any], why: str
) -> None:
    found = exif_focal(tags_of(tmp_path / "a.jpg", size, {**LENS_50, **tags}))
    assert found.focal_px is None
    assert why in found.why


def tags(size: tuple[int, int], **values: Any) -> CameraTags:
    return CameraTags(size, focal_mm=50.0, **values)


@pytest.mark.parametrize(("given", "sensor_mm", "focal_px", "is_rescaled"), [
    # Shrunk to a quarter by a program that updated sizes but not the resolution.
    (tags((1092, 728), equivalent_mm=50.0, px_per_mm=(122, 122)), None, 1516.6, False),
    (tags((1092, 728), px_per_mm=(122, 122)), 36.0, 1516.7, True),
    # Cropped instead, as the shape tells: nobody knows.
    (tags((1092, 600), equivalent_mm=50.0, px_per_mm=(122, 122)), None, None, False),
    # Only one of two can be.
    (tags((400, 300), equivalent_mm=28.0, px_per_mm=(122, 122)), None, 323.6, False),
    # Pixels that are not square, and a zoom that focal lengths in mm do not know.
    (tags((4368, 2912), px_per_mm=(122, 61)), None, None, False),
    (tags((4368, 2912), px_per_mm=(122, 122), zoom=2.0), None, None, False),
    (tags((4368, 2912)), 35.8, 6100.6, False),
])  # fmt: skip
def test_statements_that_contradict_each_other(
    given: CameraTags,
    sensor_mm: float | None,
    focal_px: float | None,
    is_rescaled: bool,
) -> None:
    found = exif_focal(given, sensor_mm)
    if focal_px is None:
        assert found.focal_px is None
        assert found.why
    else:
        assert found.focal_px == pytest.approx(focal_px, rel=1e-3)
    assert found.is_rescaled == is_rescaled


@pytest.mark.parametrize("num_bytes", range(0, 300, 29))
def test_damaged_headers_never_raise(tmp_path: Path, num_bytes: int) -> None:
    path = tmp_path / "a.jpg"
    write_photograph(path, (90, 60), LENS_50)
    content = path.read_bytes()
    path.write_bytes(content[:num_bytes])
    read_camera_tags(path)
    path.write_bytes(
        content[:num_bytes] + b"\xee\x00\xff" * 5 + content[num_bytes + 15 :]
    )
    found = read_camera_tags(path)
    if found:
        exif_focal(found)


ORIGINAL = {"ExifImageWidth": 4368, "ExifImageHeight": 2912}


def test_exif_of_a_crop_tells_the_focal_length_of_the_whole_photograph(
    tmp_path: Path,
) -> None:
    found = exif_focal(
        tags_of(tmp_path / "a.jpg", (1092, 600), {**LENS_50, **ORIGINAL})
    )
    assert (found.focal_px, found.uncropped_px) == (
        None,
        pytest.approx(50 / 35.8 * 4368),
    )
    equivalent = {**BODY, "FocalLengthIn35mmFilm": 50, **ORIGINAL}
    found = exif_focal(tags_of(tmp_path / "b.jpg", (1092, 600), equivalent))
    assert found.uncropped_px == pytest.approx(50 / 43.27 * math.hypot(4368, 2912))


def test_a_photograph_that_kept_its_shape_is_no_shrunk_one_where_others_are_crops(
    tmp_path: Path,
) -> None:
    tags = tags_of(tmp_path / "a.jpg", (1092, 728), {**LENS_50, **ORIGINAL})
    assert exif_focal(tags).focal_px == pytest.approx(50 / 35.8 * 1092)
    found = exif_focal(tags, has_crops=True)
    assert (found.focal_px, found.uncropped_px) == (
        None,
        pytest.approx(50 / 35.8 * 4368),
    )
    whole = tags_of(tmp_path / "b.jpg", (4368, 2912), {**LENS_50, **ORIGINAL})
    assert exif_focal(whole, has_crops=True) == exif_focal(whole)
