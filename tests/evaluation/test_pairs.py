"""pairs.json: the three kinds of truth, their scores, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planar_pairs import SIZE, TRUTH, write_pair
from small_scene import FOCAL_PX, IMAGE_SIZE, photograph
from synthetic import write_image

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.correspondences import (
    FundamentalEstimator,
    correspondence_doubts,
    recalls,
    score_correspondences,
    symmetric_epipolar_distances,
)
from colmap_affrect.evaluation.pairs import Pairs
from colmap_affrect.evaluation.protocol import Dataset, PairResult

SHARED_PAIRS = Path(__file__).resolve().parents[3] / "shared" / "pairs"
UNCHECKED = Pairs(check_truth=False)

SHIFT_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Fundamental matrix of a camera that moved along x: y stays the same."""

INTRINSICS = [
    [FOCAL_PX, 0, IMAGE_SIZE[0] / 2 - 0.5],
    [0, FOCAL_PX, IMAGE_SIZE[1] / 2 - 0.5],
    [0, 0, 1],
]


def load(
    folder: Path, *entries: dict[str, Any], protocol: Pairs = UNCHECKED, **top: Any
) -> Dataset:
    content = {"pairs": list(entries), **top}
    (folder / "pairs.json").write_text(json.dumps(content), encoding="utf-8")
    return protocol.load(folder)


@pytest.fixture
def planar(tmp_path: Path) -> dict[str, Any]:
    write_pair(tmp_path / "a.png", tmp_path / "b.png", seed=3)
    return {"image1": "a.png", "image2": "b.png"}


def project(points: np.ndarray) -> np.ndarray:
    mapped = np.hstack([points, np.ones((len(points), 1))]) @ TRUTH.T
    return mapped[:, :2] / mapped[:, 2:]


def test_epipolar_distances_by_hand() -> None:
    pairs = np.array([[5.0, 7.0, 90.0, 7.0], [5.0, 7.0, 90.0, 10.0]])
    distances = symmetric_epipolar_distances(SHIFT_X, pairs)
    np.testing.assert_allclose(distances, [0.0, 3.0 * np.sqrt(2.0)])
    assert np.isinf(symmetric_epipolar_distances(None, pairs)).all()


def test_distances_in_the_two_images_are_weighted_by_their_own_lines() -> None:
    # Image 2 is three times as large: 3 px off there are 1 px in image 1.
    larger = np.diag([1 / 3, 1 / 3, 1.0]) @ SHIFT_X
    distances = symmetric_epipolar_distances(larger, np.array([[5.0, 7.0, 90.0, 24.0]]))
    np.testing.assert_allclose(distances, [np.hypot(3.0, 1.0)])


def test_score_of_wxbs_is_the_mean_recall_over_thresholds() -> None:
    found = recalls(np.array([0.0, 1.0, 18.5, 40.0]))
    assert found["wxbs_score"] == pytest.approx((20 + 19 + 1) / (4 * 20))
    assert (found["recall_1px"], found["recall_20px"]) == (0.5, 0.75)


def test_matches_of_another_geometry_score_worse() -> None:
    rng = np.random.default_rng(2)
    depths = rng.uniform(3.0, 9.0, 200)
    points1 = rng.uniform((0, 0), (320, 200), (200, 2))
    points2 = points1 + np.stack([300.0 / depths, np.zeros(200)], axis=1)
    truth = np.hstack([points1[:30], points2[:30]])
    estimator = FundamentalEstimator(1.0, 0.9999, 10_000, 3)
    right = score_correspondences(truth, points1[30:], points2[30:], estimator, 0)
    assert right.error < 0.01
    assert right.details["wxbs_score"] >= 19 / 20 - 1e-9  # all but the threshold 0
    turned = np.stack([points1[30:, 0], points1[30:, 1] + 300.0 / depths[30:]], axis=1)
    wrong = score_correspondences(truth, points1[30:], turned, estimator, 0)
    assert wrong.error > 10.0
    none = score_correspondences(truth, points1[:7], points2[:7], estimator, 0)
    assert (none.error, none.details["wxbs_score"]) == (float("inf"), 0.0)


def test_homography_in_a_file_and_pixels_from_the_corner(
    tmp_path: Path, planar: dict[str, Any]
) -> None:
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    np.savetxt(tmp_path / "h.txt", corner @ TRUTH @ np.linalg.inv(corner))
    (pair,) = load(tmp_path, {**planar, "homography": "h.txt"}, pixel_origin="corner").pairs
    np.testing.assert_allclose(pair.truth.matrix, TRUTH, atol=1e-9)
    assert pair.name == "a b"
    points = np.random.default_rng(0).uniform(0, SIZE, (40, 2))
    score = UNCHECKED.score(pair, points, project(points), 0)
    assert score.error < 1e-3
    assert UNCHECKED.success(score) == 1.0


def test_relative_pose_is_that_of_the_photographs(tmp_path: Path) -> None:
    position, yaw_deg = np.array([0.6, -0.1, 0.2]), -9.0
    write_image(tmp_path / "a.png", photograph((0.0, 0.0, 0.0), 0.0))
    write_image(tmp_path / "b.png", photograph(tuple(position), yaw_deg))
    yaw = np.deg2rad(yaw_deg)
    rotation = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    pose = {
        "rotation": rotation.tolist(),
        "translation": (-rotation @ position).tolist(),
        "intrinsics1": INTRINSICS,
        "intrinsics2": INTRINSICS,
    }
    entry = {"image1": "a.png", "image2": "b.png", "relative_pose": pose}
    dataset = load(tmp_path, entry)
    assert dataset.notes == ()
    rng = np.random.default_rng(1)
    points3d = rng.uniform((-1.5, -1, 4), (1.5, 1, 7), (50, 3))
    projected = []
    for points in (points3d, (points3d - position) @ rotation.T):
        pixels = points @ np.array(INTRINSICS).T
        projected.append(pixels[:, :2] / pixels[:, 2:])
    score = UNCHECKED.score(dataset.pairs[0], projected[0], projected[1], 0)
    assert score.error < 0.05
    assert score.details["direction_error_deg"] < 0.5
    result = PairResult("a b", "indoors", score, 50, 0.1)
    columns = UNCHECKED.summarize([result])
    assert min(columns.values()) > 0.999
    assert {"poses: all", "poses, GC-RANSAC: all < 10°", "poses: pose AUC 10°"} <= columns.keys()
    assert not [name for name in columns if name.endswith(": 0°")]
    off = {**pose, "intrinsics2": [[FOCAL_PX, 0, 30], [0, FOCAL_PX, 110], [0, 0, 1]]}
    assert (
        "principal point of intrinsics2" in load(tmp_path, {**entry, "relative_pose": off}).notes[0]
    )
    scaled = {**pose, "rotation": (2 * rotation).tolist()}
    (pair,) = load(tmp_path, {**entry, "relative_pose": scaled}).pairs
    assert "scaled by 2" in pair.problem


def test_tables_are_by_kind_of_truth(tmp_path: Path, planar: dict[str, Any]) -> None:
    marked = [[10, 20, 30, 40], [50, 60, 70, 80]]
    dataset = load(
        tmp_path,
        {**planar, "name": "h", "homography": TRUTH.tolist()},
        {**planar, "name": "c", "correspondences": marked, "category": "night"},
        {**planar, "name": "bad", "homography": [[1, 2], [3, 4]]},
    )
    assert [bool(pair.problem) for pair in dataset.pairs] == [False, False, True]
    assert "bad: cannot be evaluated and counts as failed" in dataset.notes[0]
    nothing = np.zeros((0, 2))
    results = [
        PairResult(pair.name, pair.category, UNCHECKED.score(pair, nothing, nothing, 0), 0, 0.0)
        for pair in dataset.pairs[:2]
    ]
    columns = UNCHECKED.summarize(results)
    assert {name.split(":")[0] for name in columns} == {"homographies", "correspondences"}
    assert not any(columns.values())


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (np.eye(4), ""),
        (np.eye(4)[[1, 0, 3, 2]], "x and y are exchanged"),
        (np.eye(4)[[2, 3, 0, 1]], "the images are exchanged"),
        (0.5 * np.eye(4), "of images 0.5 times as large"),
        (8.0 * np.eye(4), "outside of image"),
    ],
)
def test_wrong_correspondences_are_noticed(change: np.ndarray, note: str, tmp_path: Path) -> None:
    paths = tmp_path / "a.png", tmp_path / "b.png"
    write_image(paths[0], photograph((0.0, 0.0, 0.0), 0.0))
    write_image(paths[1], photograph((0.0, -0.6, 0.2), 8.0))
    found = correspondence_doubts(wall_correspondences() @ change.T, paths)
    assert note in found
    assert bool(note) == bool(found)


def wall_correspondences() -> np.ndarray:
    """Points on the wall behind, at z = 7, in both photographs."""
    grid = np.stack(np.meshgrid([-1.1, -0.2, 0.7, 1.3], [-1.2, -0.6, 0.1]), axis=-1).reshape(-1, 2)
    points = np.hstack([grid, np.full((len(grid), 1), 7.0)])
    yaw = np.deg2rad(8.0)
    rotation = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    sides = []
    for seen in (points, (points - [0.0, -0.6, 0.2]) @ rotation.T):
        pixels = seen @ np.array(INTRINSICS).T
        sides.append(pixels[:, :2] / pixels[:, 2:])
    return np.hstack(sides)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "has no list 'pairs'"),
        ("{", "cannot be read"),
        ('{"pairs": []}', "lists no pairs"),
        ('{"pairs": [1]}', r"pairs\[0\]: is not an object"),
        ('{"pairs": [{}], "origin": 1}', "unknown key 'origin'"),
        ('{"pairs": [{}], "pixel_origin": "left"}', "not one of center, corner"),
        ('{"pairs": [{"image1": "a.png"}]}', "image2 must be the path"),
        ('{"pairs": [{"image1": "../a.png", "image2": "b.png"}]}', "image1 must be the path"),
        ('{"pairs": [{"image1": "a", "image2": "b"}]}', "has none"),
        ('{"pairs": [{"image1": "a", "image2": "b", "truth": 1}]}', "unknown key 'truth'"),
    ],
)
def test_bad_list_is_one_line(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.json").write_text(content)
    with pytest.raises(EvaluationError, match=message):
        UNCHECKED.load(tmp_path)


def test_two_pairs_of_one_name_are_refused(tmp_path: Path, planar: dict[str, Any]) -> None:
    entry = {**planar, "homography": TRUTH.tolist()}
    with pytest.raises(EvaluationError, match="two pairs are called 'a b'"):
        load(tmp_path, entry, entry)


@pytest.mark.shared
def test_marked_correspondences_of_wxbs_are_plausible() -> None:
    dataset = Pairs().load(SHARED_PAIRS / "wxbs_sample")
    assert len(dataset.pairs) == 8
    assert dataset.notes == ()
