"""pairs.json: the three kinds of truth, their scores, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from planar_pairs import SIZE, TRUTH, write_pair
from small_scene import FOCAL_PX, IMAGE_SIZE, photograph
from synthetic import write_image

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.pairs import Pairs, recalls
from colmap_affrect.evaluation.protocol import Dataset, EvaluationPair, PairResult
from colmap_affrect.evaluation.two_views import symmetric_epipolar_distances

SHARED_PAIRS = Path(__file__).resolve().parents[3] / "shared" / "pairs"
UNCHECKED = Pairs()

SHIFT_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Fundamental matrix of a camera that moved along x: y stays the same."""

INTRINSICS = [
    [FOCAL_PX, 0, IMAGE_SIZE[0] / 2 - 0.5],
    [0, FOCAL_PX, IMAGE_SIZE[1] / 2 - 0.5],
    [0, 0, 1],
]

FIRST, SECOND = ((0.0, 0.0, 0.0), 0.0), ((0.6, -0.1, 0.2), -9.0)
"""Positions and angles of two photographs."""


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


def test_epipolar_distances_by_hand() -> None:
    points1, points2 = np.array([[5.0, 7.0]] * 2), np.array([[90.0, 7.0], [90.0, 10.0]])
    distances = symmetric_epipolar_distances(SHIFT_X, points1, points2)
    np.testing.assert_allclose(distances, [0.0, 3.0 * np.sqrt(2.0)])
    assert np.isinf(symmetric_epipolar_distances(None, points1, points2)).all()
    # Image 2 three times as large: 3 px off there are 1 px in image 1.
    larger = np.diag([1 / 3, 1 / 3, 1.0]) @ SHIFT_X
    distances = symmetric_epipolar_distances(larger, points1[:1], np.array([[90.0, 24.0]]))
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
    pair = EvaluationPair("", (None, None), truth=truth)
    protocol = Pairs(max_num_iterations=10_000, num_magsac_estimates=3)
    right = protocol.score(pair, points1[30:], points2[30:], 0)
    assert right.error < 0.01
    assert right.details["wxbs_score"] >= 19 / 20 - 1e-9  # all but the threshold 0
    turned = np.stack([points1[30:, 0], points1[30:, 1] + 300.0 / depths[30:]], axis=1)
    assert protocol.score(pair, points1[30:], turned, 0).error > 10.0
    none = protocol.score(pair, points1[:7], points2[:7], 0)
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
    carried = cv2.perspectiveTransform(points[:, None], TRUTH)[:, 0]
    score = UNCHECKED.score(pair, points, carried, 0)
    assert score.error < 1e-3
    assert UNCHECKED.success(score) == 1.0


def view(position: tuple[float, float, float], yaw_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (3, 3) rotation and (3,) translation, camera_from_world, of a photograph."""
    rotation, _ = cv2.Rodrigues(np.array([0.0, -np.deg2rad(yaw_deg), 0.0]))
    return rotation, -rotation @ np.array(position)


def seen(points: np.ndarray, position: tuple[float, float, float], yaw_deg: float) -> np.ndarray:
    """Return the px of (N, 3) points in a photograph."""
    rotation, translation = view(position, yaw_deg)
    pixels = (points @ rotation.T + translation) @ np.array(INTRINSICS).T
    return pixels[:, :2] / pixels[:, 2:]


@pytest.fixture
def posed(tmp_path: Path) -> dict[str, Any]:
    for name, where in (("a.png", FIRST), ("b.png", SECOND)):
        write_image(tmp_path / name, photograph(*where))
    rotation, translation = view(*SECOND)
    pose = {
        "rotation": rotation.tolist(),
        "translation": translation.tolist(),
        "intrinsics1": INTRINSICS,
        "intrinsics2": INTRINSICS,
    }
    return {"image1": "a.png", "image2": "b.png", "relative_pose": pose}


def test_relative_pose_is_that_of_the_photographs(tmp_path: Path, posed: dict[str, Any]) -> None:
    dataset = load(tmp_path, posed)
    assert dataset.notes == ()
    points = np.random.default_rng(1).uniform((-1.5, -1, 4), (1.5, 1, 7), (50, 3))
    score = UNCHECKED.score(dataset.pairs[0], seen(points, *FIRST), seen(points, *SECOND), 0)
    assert score.error < 0.05
    assert score.details["direction_error_deg"] < 0.5
    columns = UNCHECKED.summarize([PairResult(**vars(score), name="a b", category="indoors")])
    assert min(columns.values()) > 0.999
    names = ["all", "all < 10°", "all < 20°", "pose AUC 10°"]
    groups = ["poses: ", "poses, GC-RANSAC: "]
    assert list(columns) == [group + name for group in groups for name in names]


def test_pose_that_is_no_rotation_is_refused(tmp_path: Path, posed: dict[str, Any]) -> None:
    pose = posed["relative_pose"]
    scaled = (2 * np.array(pose["rotation"])).tolist()
    (pair,) = load(tmp_path, {**posed, "relative_pose": {**pose, "rotation": scaled}}).pairs
    assert "scaled by 2" in pair.problem


def test_pixels_from_the_corner_are_moved(
    tmp_path: Path, planar: dict[str, Any], posed: dict[str, Any]
) -> None:
    marked = {**planar, "name": "c", "correspondences": [[10, 20, 30, 40]]}
    poses, points = load(tmp_path, posed, marked, pixel_origin="corner").pairs
    np.testing.assert_array_equal(points.truth, [[9.5, 19.5, 29.5, 39.5]])
    principal = np.array(INTRINSICS)[:2, 2]
    np.testing.assert_array_equal(poses.images[0].intrinsics[:2, 2], principal - 0.5)


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
        PairResult(**vars(UNCHECKED.score(pair, nothing, nothing, 0)), name=pair.name)
        for pair in dataset.pairs[:2]
    ]
    columns = UNCHECKED.summarize(results)
    assert {name.split(":")[0] for name in columns} == {"homographies", "correspondences"}
    assert not any(columns.values())


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
