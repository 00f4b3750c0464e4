"""Every mapper that is registered keeps the contract."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from mapping_tasks import task_with_given_cameras
from small_scene import INTRINSICS, NAMES

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import OptionError
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.mapping import map_database


@pytest.fixture(scope="module")
def task(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> MappingTask:
    """Four photographs, verified."""
    path = tmp_path_factory.mktemp("mappers") / "database.db"
    cameras = {"camera_model": "PINHOLE", "camera_params": INTRINSICS}
    colmap_affrect.extract_features(
        path, photos, (), "single", cameras, "unrectified-rootsift"
    )
    colmap_affrect.match_exhaustive(path)
    return replace(task_with_given_cameras(path), image_path=photos)


@pytest.mark.parametrize("name", MAPPERS.names())
def test_mapper_registers_tells_of_it_and_keeps_given_cameras(
    name: str, task: MappingTask, tmp_path: Path
) -> None:
    shown: list[int] = []
    mapper = MAPPERS.make(MAPPERS.options(name))
    (model, *_) = map_database(mapper, task, tmp_path / "sparse", shown.append)
    assert model.registered_names == tuple(sorted(NAMES))
    assert sum(shown) == len(NAMES)
    assert [path.name for path in tmp_path.iterdir()] == ["sparse"]
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse" / "0").cameras.values()
    assert camera.params.tolist() == [float(value) for value in INTRINSICS.split(",")]


@pytest.mark.parametrize("name", MAPPERS.names())
def test_mapper_has_presets_and_refuses_unknown_options(name: str) -> None:
    options = MAPPERS.options({"name": name, "random_seed": 5, "mapper_options": {}})
    colmap = type(options).preset("colmap")
    assert (colmap.preset_name, options.preset_name) == ("colmap", "sparse")
    with pytest.raises(OptionError, match="no such option"):
        MAPPERS.make(options.changed(mapper_options={"nonsense": 1}))
