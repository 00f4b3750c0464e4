"""Files of COLMAP models are followed to their ends, whole or damaged."""

from __future__ import annotations

import json
import random
import shutil
from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import (
    RECORDS,
    SUMMARY,
    file_digests,
    read_given_model,
    registered_names,
)
from colmap_affrect.errors import StoreError


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
        with pytest.raises(StoreError, match=rf"{name}: damaged \(it ends within a record"):
            registered_names(model_path)
    path.write_bytes(data + b"x")
    with pytest.raises(StoreError, match=rf"{name}: damaged \(something follows"):
        registered_names(model_path)
    path.unlink()
    with pytest.raises(StoreError, match=rf"{name}: damaged \(.*No such file"):
        registered_names(model_path)


def test_damaged_models_are_an_error_or_can_be_used(model_path: Path, tmp_path: Path) -> None:
    rng, num_errors = random.Random(2), 0
    for _ in range(60):
        path = model_path / rng.choice(sorted(RECORDS))
        data = path.read_bytes()
        changed, start = bytearray(data), rng.randrange(len(data))
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
    (other := tmp_path / "other").mkdir()
    changed.write(other)
    shutil.copy(other / "points3D.bin", tmp_path)
    what = "is not as it was written" if is_ours else "images and points are not of one model"
    with pytest.raises(StoreError, match=what):
        read_given_model(tmp_path)
