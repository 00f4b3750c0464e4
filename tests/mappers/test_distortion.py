"""Which cameras have images that can tell their distortion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.distortion import (
    MIN_REDUNDANCY,
    cameras_that_tell_distortion,
    redundancy_of,
)
from colmap_affrect.mappers.pair_graph import PairGraph

PARAMS = [1280.0, 512.0, 384.0, 0.0]


@pytest.mark.parametrize(("num_images", "is_told"), [(4, True), (2, False)])
def test_several_images_of_a_camera_tell_its_distortion_and_two_do_not(
    tmp_path: Path, num_images: int, *, is_told: bool
) -> None:
    path = tmp_path / "database.db"
    synthesize(
        path,
        num_rigs=1,
        num_frames_per_rig=num_images,
        num_points3D=200,
        camera_params=PARAMS,
    )
    assert cameras_that_tell_distortion(PairGraph.read(path)) == (
        {1} if is_told else set()
    )


def test_an_image_full_of_points_of_many_others_tells_it_and_one_of_pairs_does_not() -> (
    None
):
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", 1000.0, 800, 800
    )
    middles = 100.0 * np.arange(8) + 50.0
    keypoints = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    pairs = redundancy_of(camera, keypoints, np.ones(64, np.int64))
    assert pairs == pytest.approx(64 * 0.5 - 6)
    assert pairs < MIN_REDUNDANCY < redundancy_of(camera, keypoints, np.full(64, 4))
    twice = np.repeat(keypoints, 2, axis=0)
    assert redundancy_of(camera, twice, np.ones(128, np.int64)) == pytest.approx(pairs)


def test_single_images_of_few_points_do_not(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize(path, num_rigs=4, num_points3D=60)
    assert not cameras_that_tell_distortion(PairGraph.read(path))
