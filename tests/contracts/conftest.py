"""What the contract of mappers maps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from mapping_tasks import task_with_given_cameras
from small_scene import INTRINSICS

import colmap_affrect
from colmap_affrect.mappers.base import MappingTask


@pytest.fixture(scope="session")
def task(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> MappingTask:
    """Four photographs, verified, whose cameras are given."""
    path = tmp_path_factory.mktemp("mappers") / "database.db"
    cameras = {"camera_model": "PINHOLE", "camera_params": INTRINSICS}
    colmap_affrect.extract_features(
        path, photos, (), "single", cameras, "unrectified-rootsift"
    )
    colmap_affrect.match_exhaustive(path)
    return replace(task_with_given_cameras(path), image_path=photos)


@pytest.fixture(scope="session")
def unmatched_task(
    photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> MappingTask:
    """The same photographs without a verified pair."""
    path = tmp_path_factory.mktemp("unmatched") / "database.db"
    cameras = {"camera_model": "PINHOLE", "camera_params": INTRINSICS}
    colmap_affrect.extract_features(
        path, photos, (), "single", cameras, "unrectified-rootsift"
    )
    return replace(task_with_given_cameras(path), image_path=photos)
