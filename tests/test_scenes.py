"""Golden runs on the sample scenes: the default recipe, with two-sided bands."""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_affrect.colmap.model_files import read_poses
from colmap_affrect.comparison.results import pose_scores
from colmap_affrect.geometry.affine import project
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext
from colmap_affrect.matchers.nearest import NearestNeighbors, NearestOptions
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.one_image import prepare

SCENES = Path(__file__).parents[1] / "sample_scenes"
COURTYARD_CAMERA = CameraOptions(
    mode="single", model="PINHOLE", params="1080,1080,360,270"
)


@pytest.mark.long
def test_courtyard_registers_every_photograph_where_it_stands(tmp_path):
    options = RunOptions(cameras=COURTYARD_CAMERA)
    values = run(
        SCENES / "courtyard" / "images", tmp_path / "out", options
    ).to_mapping()
    assert (values["status"], values["unregistered"], values["num_pairs"]) == (
        "ok",
        {},
        36,
    )
    assert 800 < values["points3D"] < 20_000
    assert 2.0 < values["mean_track_length"] < 6.0
    assert 0.1 < values["mean_reprojection_error_px"] < 1.5
    assert 12 <= values["num_verified_pairs"] <= 36
    truth = read_poses(SCENES / "courtyard" / "ground_truth")
    scores = pose_scores(
        read_poses(tmp_path / "out" / "sparse" / "0"), truth, list(truth)
    )
    assert len(scores.correct_names) == len(truth) == 9
    # Exactly 0 would mean that the ground truth leaked into the run.
    assert 1e-4 < scores.median_rotation_error_deg < 0.3


MATCHER = NearestNeighbors(NearestOptions(), MatcherContext())


@functools.cache
def facade_view(recipe_name, view):
    recipe = load_recipe(recipe_name)
    path = next((SCENES / "facade" / "images").glob(f"view_{view}_*"))
    features = prepare(recipe.extraction).extract_file(path).features
    return MATCHER.prepare(ImageFeatures(features, (1, 1), "rootsift"))


@pytest.mark.long
@pytest.mark.parametrize(
    ("view", "low", "high"), [(4, 300, 6000), (5, 120, 3000), (6, 30, 2000)]
)
def test_facade_matches_follow_the_true_homography(view, low, high):
    homography = np.loadtxt(SCENES / "facade" / f"H_1_{view}.txt")
    correct = {}
    for name in ("rectified", "unrectified-rootsift"):
        first = facade_view(name, 1)
        second = facade_view(name, view)
        matches = MATCHER.match(first, second).indices
        expected = project(homography, first.features.keypoints[matches[:, 0]])
        errors = np.linalg.norm(
            expected - second.features.keypoints[matches[:, 1]], axis=1
        )
        correct[name] = int((errors < 3.0).sum())
    assert low < correct["rectified"] < high
    assert correct["rectified"] > 1.5 * correct["unrectified-rootsift"]


def test_scene_images_are_photographs_without_exif():
    paths = sorted(SCENES.glob("*/images/*.jpg"))
    assert len(paths) == 6 + 9 + 8
    for path in paths:
        assert b"Exif" not in path.read_bytes()[:4096]
        assert cv2.imread(str(path)).std() > 20
    assert (
        sum(path.stat().st_size for path in SCENES.rglob("*") if path.is_file())
        < 6_000_000
    )
