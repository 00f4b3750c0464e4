"""Images whose keypoints were changed after their pairs were verified are named."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import check_database, refuse_unusable
from colmap_affrect.colmap.database import open_database
from colmap_affrect.geometry.arrays import Floats

NUM_IMAGES = 6
SIZE = (1024, 768)  # of the images that COLMAP makes up, px
CHANGED = 3  # id of the image whose keypoints are changed
FISHEYE = (400.0, 400.0, 512.0, 384.0, 0.05, 0.01, 0.0, 0.0)

Change = Callable[[Floats], Floats]


def write_database(path: Path, *, fisheye: bool = False) -> Path:
    """Write a verified database of cameras around points."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=NUM_IMAGES,
        num_points3D=60,
    )
    if fisheye:
        options.camera_model_id = pycolmap.CameraModelId.OPENCV_FISHEYE
        options.camera_params = FISHEYE
    pycolmap.set_random_seed(1)
    with open_database(path) as database:
        pycolmap.synthesize_dataset(options, database)
    return path


def change_keypoints(path: Path, change: Change, image_id: int = CHANGED) -> str:
    """Change the keypoints of one image; return its name."""
    with open_database(path) as database:
        keypoints = np.array(database.read_keypoints(image_id))
        keypoints[:, :2] = change(keypoints[:, :2])
        database.update_keypoints(image_id, keypoints)
        return str(database.read_image(image_id).name)


def mirrored(points: Floats) -> Floats:
    return points * (-1.0, 1.0) + (SIZE[0], 0.0)


def upside_down(points: Floats) -> Floats:
    return np.asarray(SIZE - points)


def sorted_by_place(points: Floats) -> Floats:
    return points[np.argsort(points[:, 0])]


def half_as_large(points: Floats) -> Floats:
    return points * 0.5


@pytest.mark.parametrize(
    "change", [mirrored, upside_down, sorted_by_place, half_as_large]
)
@pytest.mark.parametrize("fisheye", [False, True])
def test_image_with_changed_keypoints_is_named_and_its_partners_are_not(
    tmp_path: Path, change: Change, fisheye: bool
) -> None:
    path = write_database(tmp_path / "any.db", fisheye=fisheye)
    name = change_keypoints(path, change)
    assert check_database(path)[1] == {"keypoints-moved": [name]}


def test_partners_of_two_images_with_changed_keypoints_are_not_named(
    tmp_path: Path,
) -> None:
    path = write_database(tmp_path / "any.db")
    names = [change_keypoints(path, mirrored, image_id) for image_id in (2, CHANGED)]
    assert check_database(path)[1] == {"keypoints-moved": sorted(names)}


@pytest.mark.parametrize("fisheye", [False, True])
def test_keypoints_as_they_were_verified_are_no_problem(
    tmp_path: Path, fisheye: bool
) -> None:
    path = write_database(tmp_path / "any.db", fisheye=fisheye)
    assert check_database(path)[1] == {}


def test_keypoints_that_were_refined_by_a_few_px_are_no_problem(tmp_path: Path) -> None:
    path = write_database(tmp_path / "any.db")
    rng = np.random.default_rng(0)
    change_keypoints(path, lambda points: points + rng.normal(0.0, 4.0, points.shape))
    assert check_database(path)[1] == {}


def test_pairs_without_geometries_say_nothing(tmp_path: Path) -> None:
    path = write_database(tmp_path / "any.db")
    with open_database(path) as database:
        for pair_id, known in zip(*database.read_two_view_geometries(), strict=True):
            without = pycolmap.TwoViewGeometry()
            without.config = known.config
            without.inlier_matches = known.inlier_matches
            database.update_two_view_geometry(
                *pycolmap.pair_id_to_image_pair(pair_id), without
            )
    change_keypoints(path, mirrored)
    assert check_database(path)[1] == {}


def test_image_is_named_in_a_warning_before_its_database_is_mapped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_database(tmp_path / "any.db")
    name = change_keypoints(path, mirrored)
    with caplog.at_level(logging.WARNING):
        refuse_unusable(path, warns=True)
    (record,) = caplog.records
    assert f"({name})" in record.getMessage()
    assert "--leave-out NAME" in record.getMessage()
