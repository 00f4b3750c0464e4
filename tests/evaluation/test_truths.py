"""Scores of matches by homographies, poses and marked points, with errors known beforehand."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import Pose, relative_pose
from colmap_affrect.evaluation import truths
from colmap_affrect.evaluation.truths import (
    Correspondences,
    PairResult,
    PairScore,
    ScoreOptions,
    TrueHomography,
    TruePose,
    columns,
    homography_columns,
    pose_columns,
    symmetric_epipolar_distances,
    wxbs_score,
)
from colmap_affrect.geometry.conventions import pixel_from_colmap

TRUTH = np.array([[0.9, 0.2, 30.0], [-0.1, 1.1, -20.0], [3e-4, -1e-4, 1.0]])
SIZE1 = (320, 200)
SIZE2 = (240, 260)
ROUNDING_PX = 1e-9  # double precision on coordinates of some hundred px
OPTIONS = ScoreOptions(max_num_iterations=10_000)


def shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def error_px(estimate: np.ndarray | None) -> float:
    return TrueHomography(TRUTH, SIZE1, SIZE2).error_px(estimate)


def test_error_agrees_with_all_visible_pixels_carried_there_and_back() -> None:
    """The protocol in words: the mask of image 1, pushed to image 2 and back, and its pixels."""
    estimate = TRUTH @ np.array(
        [[1.01, 0.02, 1.0], [0.0, 0.99, -2.0], [1e-5, 0.0, 1.0]]
    )
    ones = np.ones(SIZE1[::-1], np.uint8)
    there = cv2.warpPerspective(ones, TRUTH, SIZE2, flags=cv2.INTER_NEAREST)
    back = cv2.warpPerspective(
        there, np.linalg.inv(TRUTH), SIZE1, flags=cv2.INTER_NEAREST
    )
    rows, columns = np.nonzero(back)
    points = np.stack([columns, rows], axis=1).astype(np.float64)[:, None]
    carried = [
        cv2.perspectiveTransform(points, matrix)[:, 0] for matrix in (estimate, TRUTH)
    ]
    expected = np.linalg.norm(carried[0] - carried[1], axis=1).mean()
    assert expected > 1.0
    assert error_px(estimate) == pytest.approx(
        expected, rel=0.02
    )  # every 16th pixel, the border
    assert error_px(shift(0.3, -0.4) @ TRUTH) == pytest.approx(0.5, abs=ROUNDING_PX)
    assert error_px(-2.0 * TRUTH) == pytest.approx(0, abs=ROUNDING_PX)
    horizon = TRUTH + np.array(
        [[0, 0, 0], [0, 0, 0], [-0.01, 0, 0]]
    )  # within the image
    assert error_px(horizon) == error_px(None) == math.inf


def test_pairs_are_counted_below_each_limit() -> None:
    results = [PairResult(error, 9, 9, name="p") for error in (0.5, 3.0, math.inf)]
    counts = homography_columns(results)
    assert list(counts.values()) == [1, 1, 1, 2, 2, 2]
    assert list(counts)[2] == "< 3 px"


def homography_score(points1: np.ndarray, points2: np.ndarray) -> PairScore:
    return TrueHomography(TRUTH, SIZE1, SIZE2).score(points1, points2, OPTIONS)


def test_matches_of_which_half_are_wrong_give_the_homography() -> None:
    rng = np.random.default_rng(5)
    points1 = rng.uniform(0, SIZE1, (60, 2))
    points2 = cv2.perspectiveTransform(points1[:, None], TRUTH)[:, 0]
    points2[::2] += rng.uniform(30, 60, (30, 2))
    found = homography_score(points1, points2)
    assert found.error < 1e-3
    assert (found.num_inliers, found.num_correct, found.solved) == (30, 30, 1.0)
    turned = homography_score(points2, points1)
    assert (turned.error > 10.0, turned.solved) == (True, 0.0)
    four = homography_score(points1[1:8:2], points2[1:8:2])
    assert (four.num_inliers, four.solved) == (4, 1.0)
    none = homography_score(points1[:3], points1[:3])
    assert none == PairScore(math.inf, 0, 0, kind="homographies")


@pytest.mark.parametrize(
    ("offset_px", "num_correct", "solved"),
    [(2.9, 40, 1.0), (3.1, 0, 1.0), (4.9, 0, 1.0), (5.1, 0, 0.0)],
)
def test_matches_are_correct_within_3_px_and_a_pair_is_solved_within_5_px(
    offset_px: float, num_correct: int, solved: float
) -> None:
    points1 = np.random.default_rng(5).uniform(0, SIZE1, (40, 2))
    points2 = cv2.perspectiveTransform(points1[:, None], TRUTH)[:, 0]
    found = homography_score(points1, points2 + np.array([0.0, offset_px]))
    assert found.error == pytest.approx(offset_px, abs=1e-3)
    assert (found.num_correct, found.solved) == (num_correct, solved)


def test_error_of_a_homography_is_a_mean_over_every_fourth_pixel() -> None:
    visible = TrueHomography(np.eye(3), SIZE1, SIZE1).visible
    np.testing.assert_array_equal(np.unique(visible[:, 0]), np.arange(0, SIZE1[0], 4))
    np.testing.assert_array_equal(np.unique(visible[:, 1]), np.arange(0, SIZE1[1], 4))


def turn(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    unit = np.array(axis) / np.linalg.norm(axis)
    return cv2.Rodrigues(np.radians(degrees) * unit)[0]


POSE1 = (turn((1, 2, 3), 25), np.array([0.3, -0.2, 4.0]))
POSE2 = (turn((-1, 2, 0.5), 40), np.array([-1.1, 0.4, 5.0]))
CAMERA1 = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=900, height=700, params=[800.0, 460, 340, 0.15]
)
CAMERA2 = pycolmap.Camera(
    model="PINHOLE", width=640, height=800, params=[600.0, 650, 300, 420]
)


def pose_score(points: tuple[np.ndarray, np.ndarray], pose2: Pose = POSE2) -> PairScore:
    truth = TruePose((CAMERA1, CAMERA2), relative_pose(POSE1, pose2))
    return truth.score(*points, OPTIONS)


def project(camera: pycolmap.Camera, pose: Pose, points: np.ndarray) -> np.ndarray:
    in_camera = points @ pose[0].T + pose[1]
    return pixel_from_colmap(np.asarray(camera.img_from_cam(in_camera)))


def matches(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions of points in a cube, pixel-centre px of both images."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return project(CAMERA1, POSE1, points), project(CAMERA2, POSE2, points)


def test_exact_matches_give_the_pose() -> None:
    score = pose_score(matches(60))
    errors = [score.error, score.direction_error_deg]
    assert errors == pytest.approx([0.0] * 2, abs=1e-4)
    assert (score.num_inliers, score.num_correct) == (60, 60)


@pytest.mark.parametrize("degrees", [3.0, 6.0, 77.0])
def test_wrong_true_rotation_is_the_rotation_error(degrees: float) -> None:
    # The second camera is turned about its own centre: the direction in its frame turns along.
    wrong = turn((0, 0, 1), degrees)
    score = pose_score(matches(60), (wrong @ POSE2[0], wrong @ POSE2[1]))
    assert score.error == pytest.approx(degrees, abs=1e-4)
    assert score.solved == (degrees < 5.0)


def test_wrong_true_position_is_the_direction_error() -> None:
    baseline = relative_pose(POSE1, POSE2)[1]
    across = np.cross(baseline, (0, 0, 1))
    across *= np.linalg.norm(baseline) / np.linalg.norm(across)
    moved = POSE2[1] - baseline + math.cos(0.2) * baseline + math.sin(0.2) * across
    score = pose_score(matches(60), (POSE2[0], moved))
    assert score.error == pytest.approx(0, abs=1e-4)
    assert score.direction_error_deg == pytest.approx(math.degrees(0.2), abs=1e-4)
    assert score.num_correct < 60


def test_points_that_give_no_pose() -> None:
    for count in (0, 5):
        score = pose_score(matches(count))
        assert (score.error, score.num_inliers, score.solved) == (math.inf, 0, 0.0)
    points1, points2 = matches(60)
    points1[3] = np.nan
    assert pose_score((points1, points2)).num_inliers == 59


def pose_result(category: str, error: float, direction_error: float) -> PairResult:
    return PairResult(
        error, 50, None, direction_error, kind="poses", name="p", category=category
    )


def test_pose_columns_are_shares_by_category_and_count_failures() -> None:
    results = [
        pose_result("20°", 4.9, 7.5),
        pose_result("20°", 5.0, 1.0),
        pose_result("20°", 15.0, 1.0),
        pose_result("100°", math.inf, math.inf),
    ]
    summary = pose_columns(results)
    names = ["20°", "100°", "all", "pose AUC 10°"]
    assert list(summary) == names
    expected = [1 / 3, 0, 1 / 4, (0.25 + 0.5) / 4]
    assert list(summary.values()) == pytest.approx(expected)
    failed = PairResult(math.inf, 0, name="q", category="20°", failure="damaged")
    assert pose_columns([*results, failed])["20°"] == 1 / 4


SHIFT_X = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Fundamental matrix of a camera that moved along x: y stays the same."""


def test_epipolar_distances_by_hand() -> None:
    points1 = np.array([[5.0, 7.0], [5.0, 7.0]])
    points2 = np.array([[90.0, 7.0], [90.0, 10.0]])
    distances = symmetric_epipolar_distances(SHIFT_X, points1, points2)
    np.testing.assert_allclose(distances, [0.0, 3.0 * np.sqrt(2.0)])
    assert np.isinf(symmetric_epipolar_distances(None, points1, points2)).all()
    # Image 2 three times as large: 3 px off there are 1 px in image 1.
    larger = np.diag([1 / 3, 1 / 3, 1.0]) @ SHIFT_X
    distances = symmetric_epipolar_distances(
        larger, points1[:1], np.array([[90.0, 24.0]])
    )
    np.testing.assert_allclose(distances, [np.hypot(3.0, 1.0)])


def test_score_of_wxbs_is_the_mean_recall_over_thresholds() -> None:
    distances_px = np.array([0.0, 1.0, 18.5, 40.0])
    assert wxbs_score(distances_px) == pytest.approx((20 + 19 + 1) / (4 * 20))


def test_matches_of_another_geometry_score_worse() -> None:
    points1, points2 = matches(200)
    truth = Correspondences(np.hstack([points1[:30], points2[:30]]))
    right = truth.score(points1[30:], points2[30:], OPTIONS)
    assert right.error < truth.score(points2[30:], points1[30:], OPTIONS).error
    assert right.solved > 0.5  # the lens of image 1 distorts
    assert math.isfinite(truth.score(points1[30:38], points2[30:38], OPTIONS).error)
    none = truth.score(points1[:7], points2[:7], OPTIONS)
    assert (none.error, none.solved) == (math.inf, 0.0)


def test_of_five_fundamental_matrices_the_one_of_median_error_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The error of a matrix that shifts lines by some px in image 2 is that in both images."""
    offsets_px = (9.0, 1.0, 5.0, 3.0, 7.0)

    def estimate(*, options: ScoreOptions, **_: Any) -> tuple[np.ndarray, int]:
        seed = options.random_seed
        return SHIFT_X @ shift(0.0, offsets_px[seed]), seed

    monkeypatch.setattr(truths, "estimate_matrix", estimate)
    points = np.random.default_rng(0).uniform(0, 300, (9, 2))
    score = Correspondences(np.hstack([points, points])).score(
        points, points, ScoreOptions()
    )
    assert score.error == pytest.approx(np.sqrt(2.0) * 5.0)
    assert score.num_inliers == 2


def test_inliers_of_a_fundamental_matrix_are_within_some_px_of_their_lines() -> None:
    points1, points2 = matches(120)
    points2[80:, 1] += 8.0
    truth = Correspondences(np.hstack([points1[:30], points2[:30]]))
    assert 60 <= truth.score(points1, points2, OPTIONS).num_inliers <= 90


def test_tables_are_by_kind_of_truth() -> None:
    nothing = np.zeros((0, 2))
    kinds = (TrueHomography(TRUTH, SIZE1, SIZE2), Correspondences(np.ones((2, 4))))
    scores = [truth.score(nothing, nothing, OPTIONS) for truth in kinds]
    results = [PairResult(**vars(score), name="p") for score in scores]
    results += [PairResult(math.inf, 0, name="bad"), pose_result("indoors", 4.0, 1.0)]
    found = columns(results)
    assert found["poses"] == {
        "indoors": 1.0,
        "all": 1.0,
        "pose AUC 10°": pytest.approx(0.6),
    }
    assert found["correspondences"] == {"WxBS score": 0.0}
    assert set(found["homographies"].values()) == {0.0}
    assert columns([]) == {}
