"""Retrieval on real photographs in ../shared, against the true poses of their cameras."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "benchmarks"))
from registration import link_images, read_true_poses

from colmap_affrect import stages
from colmap_affrect.evaluation.relative_pose import rotation_angle_deg
from colmap_affrect.matching.pairs import read_pairs
from colmap_affrect.options import CameraOptions, PairOptions
from colmap_affrect.recipes import load_recipe
from colmap_affrect.workspace import Workspace

SCENES = Path(__file__).parents[2] / "shared" / "scenes"
RING = "temple_sparse_ring"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="the photographs of ../shared are not here"),
]


def test_photographs_of_one_side_of_a_temple_find_each_other(tmp_path: Path) -> None:
    for scene in (RING, "kermit"):
        link_images(sorted((SCENES / scene / "images").iterdir()), tmp_path / "images" / scene)
    workspace = Workspace(tmp_path)
    recipe = load_recipe("unrectified-rootsift")
    stages.extract(workspace, tmp_path / "images", recipe, CameraOptions())
    stages.choose_pairs(workspace, PairOptions(methods=("retrieval",), num_neighbors=4))
    names = stages.recorded_images(workspace)
    pairs = read_pairs(workspace.pairs, names)
    assert len(pairs) == 27 * 4 // 2
    assert all(first.split("/")[0] == second.split("/")[0] for first, second in pairs)
    poses = read_true_poses(SCENES / RING)
    assert poses
    near = {
        (f"{RING}/{first}", f"{RING}/{second}")
        for first, second in itertools.combinations(sorted(poses), 2)
        if rotation_angle_deg(poses[first][0] @ poses[second][0].T) < 40.0
    }
    assert len(near) >= 12
    assert near <= set(pairs)
