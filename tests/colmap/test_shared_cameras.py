"""Which photographs share a camera, and what of a size or a body speaks against it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from colmap_affrect.colmap.cameras import CameraRecord, with_shared_cameras
from colmap_affrect.colmap.initial_cameras import (
    InitialCameras,
    _implausible,
    sensor_width_mm,
)

WIDE = (800, 600)
HIGH = (600, 800)


def test_photographs_of_one_size_share_a_camera_of_which_nothing_is_known() -> None:
    records = {
        1: CameraRecord(("b.jpg",), "guess", 960.0, size=WIDE),
        2: CameraRecord(("c.jpg",), "guess", 960.0, size=HIGH),
        3: CameraRecord(("a.jpg",), "guess", 960.0, size=WIDE),
        4: CameraRecord(("d.jpg",), "exif", 900.0, size=WIDE),
        5: CameraRecord(
            ("e.jpg",), "guess", 960.0, size=WIDE, given=("principal-point",)
        ),
    }
    shared = with_shared_cameras(records)
    names = {key: record.names for key, record in shared.items()}
    assert names == {
        1: ("a.jpg", "b.jpg"),
        2: ("c.jpg",),
        4: ("d.jpg",),
        5: ("e.jpg",),
    }
    assert len(records) == 5


@pytest.mark.parametrize(
    ("scale", "body", "may_be_crop"),
    [(0.5, "cropped", True), (1.0, "cropped", False), (0.5, "other", False)],
)
def test_smaller_photographs_may_be_crops_as_others_of_their_body_are(
    scale: float, body: str, *, may_be_crop: bool
) -> None:
    known: Any = SimpleNamespace(_cropped_bodies={"cropped"})
    tags: Any = SimpleNamespace(scale=scale, body=body)
    assert InitialCameras._may_be_crop(known, tags) == may_be_crop


@pytest.mark.parametrize(
    ("size", "is_panorama"),
    [((6000, 900), True), ((900, 6000), True), ((900, 600), False), (HIGH, False)],
)
def test_panoramas_may_be_upright(size: tuple[int, int], *, is_panorama: bool) -> None:
    assert _implausible("guess", 1000.0, size).startswith("a panorama") == is_panorama


def test_colmap_knows_how_wide_sensors_are() -> None:
    width_mm = sensor_width_mm("Canon", "Canon EOS 5D Mark II")
    assert width_mm == pytest.approx(36.0, abs=0.1)
    assert sensor_width_mm("Nobody", "Nothing") is None
