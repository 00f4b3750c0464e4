"""Which cameras have images that can tell their distortion."""

from __future__ import annotations

from pathlib import Path

from mapping_tasks import synthesize

from colmap_affrect.mappers.distortion import cameras_that_tell_distortion
from colmap_affrect.mappers.pair_graph import PairGraph

PARAMS = [1280.0, 512.0, 384.0, 0.0]


def test_several_images_of_a_camera_tell_its_distortion_and_one_with_few_points_does_not(
    tmp_path: Path,
) -> None:
    shared = tmp_path / "shared.db"
    synthesize(shared, num_rigs=1, num_frames_per_rig=4, num_points3D=300, camera_params=PARAMS)
    assert cameras_that_tell_distortion(PairGraph.read(shared)) == {1}
    own = tmp_path / "own.db"
    synthesize(own, num_rigs=4, num_points3D=60)
    assert not cameras_that_tell_distortion(PairGraph.read(own))
