"""Files of COLMAP models are followed to their ends, whole or damaged."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import (
    RECORDS,
    SUMMARY,
    file_digests,
    model_folder,
    read_given_model,
    registered_names,
)
from colmap_affrect.errors import OptionError, StoreError


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    """A model with a rig of two cameras."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=20
    )
    return pycolmap.synthesize_dataset(options)


@pytest.fixture
def model_path(model: pycolmap.Reconstruction, tmp_path: Path) -> Path:
    path = tmp_path / "0"
    path.mkdir()
    model.write(path)
    return path


def test_names_are_those_that_pycolmap_reads(
    model: pycolmap.Reconstruction, model_path: Path
) -> None:
    expected = sorted(model.images[image_id].name for image_id in model.reg_image_ids())
    assert len(expected) == 12
    assert registered_names(model_path) == expected


@pytest.mark.parametrize("name", sorted(RECORDS))
def test_missing_cut_and_lengthened_files_are_errors_that_name_them(
    model_path: Path, name: str
) -> None:
    path = model_path / name
    data = path.read_bytes()
    rng = random.Random(1)
    for length in [0, 7, len(data) - 1, *(rng.randrange(len(data)) for _ in range(5))]:
        path.write_bytes(data[:length])
        with pytest.raises(
            StoreError, match=rf"{name}: damaged \(it ends within a record"
        ):
            registered_names(model_path)
    path.write_bytes(data + b"x")
    with pytest.raises(StoreError, match=rf"{name}: damaged \(something follows"):
        registered_names(model_path)
    path.unlink()
    with pytest.raises(StoreError, match=rf"{name}: damaged \(.*No such file"):
        registered_names(model_path)


def test_damaged_models_are_an_error_or_can_be_used(
    model_path: Path, tmp_path: Path
) -> None:
    rng = random.Random(2)
    num_errors = 0
    for _ in range(60):
        path = model_path / rng.choice(sorted(RECORDS))
        data = path.read_bytes()
        changed = bytearray(data)
        start = rng.randrange(len(data))
        for k in range(start, min(len(data), start + rng.choice([1, 8, 60]))):
            changed[k] = rng.choice([0, rng.randrange(256)])
        path.write_bytes(changed)
        try:
            read_given_model(model_path).write_text(tmp_path)
        except StoreError:
            num_errors += 1
        path.write_bytes(data)
    assert 10 < num_errors < 60


@pytest.mark.parametrize("is_ours", [False, True])
def test_tracks_and_keypoints_name_each_other(
    model: pycolmap.Reconstruction, tmp_path: Path, is_ours: bool
) -> None:
    model.write(tmp_path)
    if is_ours:
        content = {"model": file_digests(tmp_path)}
        (tmp_path / SUMMARY).write_text(json.dumps(content))
        read_given_model(tmp_path)
    changed = pycolmap.Reconstruction(tmp_path)
    changed.delete_point3D(min(changed.points3D))
    other = tmp_path / "other"
    other.mkdir()
    changed.write(other)
    shutil.copy(other / "points3D.bin", tmp_path)
    what = (
        "is not as it was written"
        if is_ours
        else "images and points are not of one model"
    )
    with pytest.raises(StoreError, match=what):
        read_given_model(tmp_path)


def _first(model: pycolmap.Reconstruction) -> pycolmap.Image:
    return model.image(min(model.reg_image_ids()))


def set_pose(model: pycolmap.Reconstruction, quaternion: list[float], x: float) -> None:
    image = _first(model)
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array(quaternion)), np.array([x, 0.0, 0.0])
    )
    model.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)


def set_focal(model: pycolmap.Reconstruction, value: float) -> None:
    camera = model.cameras[_first(model).camera_id]
    params = np.array(camera.params)
    params[camera.focal_length_idxs()] = value
    camera.params = params


def set_point(model: pycolmap.Reconstruction, x: float) -> None:
    model.points3D[min(model.points3D)].xyz = np.array([x, 0.0, 0.0])


def set_keypoint(model: pycolmap.Reconstruction, x: float) -> None:
    _first(model).points2D[0].xy = np.array([x, 0.0])


def set_error(model: pycolmap.Reconstruction) -> None:
    model.points3D[min(model.points3D)].error = NAN


def name_one_file_twice(model: pycolmap.Reconstruction) -> None:
    _first(model).name = f"./{model.image(max(model.reg_image_ids())).name}"


def deregister(model: pycolmap.Reconstruction) -> None:
    for frame_id in list(model.reg_frame_ids()):
        model.deregister_frame(frame_id)


def name_twice(model: pycolmap.Reconstruction) -> None:
    _first(model).name = model.image(max(model.reg_image_ids())).name


NAN = float("nan")
INF = float("inf")
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
UNSOUND: dict[str, tuple[Callable[[pycolmap.Reconstruction], None], str]] = {
    "rotation": (
        lambda model: set_pose(model, [NAN, 0.0, 0.0, 1.0], 0.0),
        "the pose of .* is not",
    ),
    "no rotation": (
        lambda model: set_pose(model, [0.0] * 4, 0.0),
        "the pose of .* is not finite",
    ),
    "translation": (
        lambda model: set_pose(model, UPRIGHT, NAN),
        "the pose of .* is not finite",
    ),
    "infinite": (
        lambda model: set_pose(model, UPRIGHT, INF),
        "the pose of .* is not finite",
    ),
    "huge": (
        lambda model: set_pose(model, UPRIGHT, 1e300),
        "the pose of .* is not finite",
    ),
    "focal length": (
        lambda model: set_focal(model, NAN),
        "camera 1 has no size, or no finite",
    ),
    "negative focal length": (
        lambda model: set_focal(model, -5.0),
        "camera 1 has no size",
    ),
    "point": (lambda model: set_point(model, NAN), "point 1 is at no finite place"),
    "keypoint": (
        lambda model: set_keypoint(model, NAN),
        "a keypoint of .* is at no finite place",
    ),
    "keypoint far away": (
        lambda model: set_keypoint(model, 1e300),
        "a keypoint of .* is at no finite place",
    ),
    "error of a point": (set_error, "the error of point 1 is no number"),
    "two of one file": (name_one_file_twice, "two of its images are called"),
    "no image": (deregister, "the model has no images with poses"),
    "two of one name": (name_twice, "two of its images are called"),
}


@pytest.mark.parametrize("case", UNSOUND)
def test_models_that_nothing_can_be_computed_with_are_refused(
    model_path: Path, tmp_path: Path, case: str
) -> None:
    change, said = UNSOUND[case]
    model = pycolmap.Reconstruction(model_path)
    change(model)
    changed = tmp_path / "changed"
    changed.mkdir()
    model.write(changed)
    with pytest.raises(StoreError, match=said):
        read_given_model(changed)
    for path in changed.iterdir():
        path.unlink()
    model.write_text(changed)
    with pytest.raises((StoreError, OptionError)):
        read_given_model(changed)


def test_model_of_cameras_alone_needs_no_pose(model_path: Path) -> None:
    model = pycolmap.Reconstruction(model_path)
    set_pose(model, UPRIGHT, NAN)
    model.write(model_path)
    assert len(read_given_model(model_path, needs_poses=False).images) == 12


def test_folder_of_a_run_stands_for_its_largest_model(
    model_path: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out" / "sparse"
    out.mkdir(parents=True)
    shutil.copytree(model_path, out / "0")
    for folder in (out.parent, out, out / "0"):
        assert model_folder(folder) == out / "0"
        assert read_given_model(folder).num_reg_images() == 12
    assert model_folder(tmp_path / "none") == tmp_path / "none"
