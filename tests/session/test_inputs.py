"""What the features of photographs are made from, and what only their cameras are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.recipes import load_recipe
from colmap_affrect.session.context import Inputs

OTHERS = [
    CameraOptions(mode="single"),
    CameraOptions(focal_length_px=300.0),
    CameraOptions(focal_length_px=301.0),
]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    (tmp_path / "a.png").write_bytes(b"a photograph")
    np.save(tmp_path / "a.npy", np.ones((4, 4)))
    return tmp_path


@pytest.mark.parametrize(
    ("recipe", "settings", "num_contents"),
    [("rectified", (), 1), ("depth-planes-recommended", ("depth.path={photos}",), 4)],
)
def test_only_features_of_warps_by_depth_are_made_from_cameras(
    photos: Path, recipe: str, settings: tuple[str, ...], num_contents: int
) -> None:
    extraction = load_recipe(
        recipe, [one.format(photos=photos) for one in settings]
    ).extraction
    found = set()
    for cameras in (CameraOptions(), *OTHERS):
        inputs = Inputs.of(photos, cameras=cameras)
        contents = inputs.contents(["a.png"], extraction, {})
        assert inputs.contents(["a.png"], extraction, contents) == contents
        found.add(contents["a.png"])
    assert len(found) == num_contents


def test_cameras_have_a_digest_of_what_is_given_wherever_it_lies(
    tmp_path: Path,
) -> None:
    tables = [tmp_path / name for name in ("one.csv", "same.csv", "other.csv")]
    for table, focal in zip(tables, (300, 300, 310), strict=True):
        table.write_text(f"name,focal_px\na.png,{focal}\n", encoding="utf-8")
    given = [
        CameraOptions(),
        *OTHERS,
        *(CameraOptions(cameras_path=str(t)) for t in tables),
    ]
    digests = [
        Inputs.of(tmp_path, cameras=cameras).cameras_digest() for cameras in given
    ]
    assert digests[0] == ""
    assert digests[-3] == digests[-2]
    assert len(set(digests)) == len(digests) - 1
