"""Retrieval on real photographs in ../shared, against the true poses of their cameras."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path

import pytest

from colmap_affrect.colmap.poses import read_poses
from colmap_affrect.evaluation.datasets import difficulty
from colmap_affrect.pairs.base import PairOptions
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.inputs import Inputs
from colmap_affrect.stages.pairs import choose_pairs

SCENES = Path(__file__).parents[3] / "shared" / "scenes"
RING = "temple_sparse_ring"

pytestmark = [
    pytest.mark.shared,
    pytest.mark.skipif(not SCENES.is_dir(), reason="the photographs of ../shared are not here"),
]


def test_photographs_of_one_side_of_a_temple_find_each_other(tmp_path: Path) -> None:
    for scene in (RING, "kermit"):
        shutil.copytree(SCENES / scene / "images", tmp_path / "images" / scene)
    context = Context(Workspace(tmp_path / "out"))
    context.workspace.begin()
    inputs = Inputs.of(tmp_path / "images")
    extract(context, inputs, load_recipe("unrectified-rootsift"))
    choose_pairs(context, PairOptions(methods=("retrieval",), num_neighbors=4))
    pairs = read_pairs(context.workspace.pairs, inputs.names())
    assert len(pairs) == 27 * 4 // 2
    assert all(first.split("/")[0] == second.split("/")[0] for first, second in pairs)
    poses = read_poses(SCENES / RING / "ground_truth")
    near = {
        (f"{RING}/{first}", f"{RING}/{second}")
        for first, second in itertools.combinations(sorted(poses), 2)
        if difficulty(poses[first], poses[second]) < 4
    }
    assert len(near) >= 12
    assert near <= set(pairs)
