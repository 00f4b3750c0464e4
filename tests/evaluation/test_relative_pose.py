"""Relative poses from matches: made-up cameras and points with known errors."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.conventions import pixel_from_colmap
from colmap_affrect.evaluation.posed_scenes import Imc
from colmap_affrect.evaluation.protocol import EvaluationPair, PairResult
from colmap_affrect.evaluation.relative_pose import (
    posed_image,
    posed_pair,
    rays,
    rotation_angle_deg,
    true_pose,
)
from colmap_affrect.evaluation.two_views import (
    Ransac,
    sampson_distances,
)


def turn(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    unit = np.array(axis) / np.linalg.norm(axis)
    return cv2.Rodrigues(np.radians(degrees) * unit)[0]


POSE1 = (turn((1, 2, 3), 25), np.array([0.3, -0.2, 4.0]))
POSE2 = (turn((-1, 2, 0.5), 40), np.array([-1.1, 0.4, 5.0]))
CAMERA1 = pycolmap.Camera(
    model="SIMPLE_RADIAL", width=900, height=700, params=[800.0, 460, 340, 0.15]
)
CAMERA2 = pycolmap.Camera(model="PINHOLE", width=640, height=800, params=[600.0, 650, 300, 420])


def make_pair(pose1=POSE1, pose2=POSE2) -> EvaluationPair:
    return posed_pair(
        posed_image("s/a", Path("a"), CAMERA1, pose1),
        posed_image("s/b", Path("b"), CAMERA2, pose2),
        "10°",
    )


def project(camera, pose, points: np.ndarray) -> np.ndarray:
    in_camera = points @ pose[0].T + pose[1]
    return pixel_from_colmap(np.asarray(camera.img_from_cam(in_camera)))


def matches(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions of points in a cube, pixel-centre px of both images."""
    points = np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    return project(CAMERA1, POSE1, points), project(CAMERA2, POSE2, points)


def test_exact_matches_give_the_pose() -> None:
    score = Imc().score(make_pair(), *matches(60), 0)
    assert score.error == pytest.approx(0, abs=1e-4)
    assert score.details["direction_error_deg"] == pytest.approx(0, abs=1e-4)
    assert (score.num_inliers, score.num_correct) == (60, 60)
    assert score.details["gc_error"] == pytest.approx(0, abs=1e-4)
    assert score.details["gc_direction_error_deg"] == pytest.approx(0, abs=1e-4)
    assert score.details["gc_num_inliers"] == 60


@pytest.mark.parametrize("degrees", [3.0, 77.0])
def test_wrong_true_rotation_is_the_rotation_error(degrees: float) -> None:
    # The second camera is turned about its own centre: the direction in its frame turns along.
    wrong = turn((0, 0, 1), degrees)
    pair = make_pair(pose2=(wrong @ POSE2[0], wrong @ POSE2[1]))
    score = Imc().score(pair, *matches(60), 0)
    assert score.error == pytest.approx(degrees, abs=1e-4)


def test_wrong_true_position_is_the_direction_error() -> None:
    baseline = true_pose(make_pair())[1]
    across = np.cross(baseline, (0, 0, 1))
    across *= np.linalg.norm(baseline) / np.linalg.norm(across)
    moved = POSE2[1] - baseline + math.cos(0.2) * baseline + math.sin(0.2) * across
    score = Imc().score(make_pair(pose2=(POSE2[0], moved)), *matches(60), 0)
    assert score.error == pytest.approx(0, abs=1e-4)
    assert score.details["direction_error_deg"] == pytest.approx(math.degrees(0.2), abs=1e-4)
    assert score.num_correct < 60


def test_distortion_is_respected_unless_switched_off() -> None:
    points = matches(200)
    straight = Imc(threshold_px=0.2)
    bent = straight.changed(use_distortion=False)
    assert straight.score(make_pair(), *points, 0).num_inliers == 200
    score = bent.score(make_pair(), *points, 0)
    assert score.num_inliers < 150
    assert score.error > 1


def test_threshold_is_in_pixels_of_the_mean_focal_length() -> None:
    points1, points2 = matches(300)
    noise = np.random.default_rng(1).uniform(-0.6, 0.6, points1.shape)
    counts = [
        Imc(threshold_px=threshold_px, max_num_iterations=1000)
        .score(make_pair(), points1 + noise, points2, 0)
        .num_inliers
        for threshold_px in (0.1, 2.0)
    ]
    assert counts[0] < 150
    assert counts[1] > 280


@pytest.mark.long
def test_hundred_thousand_iterations_find_what_a_thousand_do_not() -> None:
    points1, points2 = matches(120)
    points2[30:] = np.random.default_rng(5).uniform(0, 600, (90, 2))
    # A quarter of the matches is right: a thousand samples miss a good one four times in ten.
    many = Imc(confidence=0.99)
    few = many.changed(max_num_iterations=1_000)
    assert few.score(make_pair(), points1, points2, 1).error > 5
    score = many.score(make_pair(), points1, points2, 1)
    assert score.error < 0.1
    assert score.num_inliers == 30


def test_seed_decides_the_result() -> None:
    points1, points2 = matches(100)
    points2 = points2 + np.random.default_rng(2).normal(0, 1, points2.shape)
    protocol = Imc(max_num_iterations=100)
    first, again, other = (
        protocol.score(make_pair(), points1, points2, seed) for seed in (0, 0, 1)
    )
    assert first == again
    assert first != other


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_matches_are_a_failure(count: int) -> None:
    score = Imc().score(make_pair(), *matches(count), 0)
    assert (score.error, score.num_inliers) == (math.inf, 0)
    assert Imc().success(score) == 0


def test_all_matches_in_one_place_never_count_as_a_right_pose() -> None:
    points = np.full((20, 2), 100.0)
    score = Imc().score(make_pair(), points, points, 0)
    assert Imc().success(score) == 0


def test_points_that_are_not_finite_are_never_inliers() -> None:
    points1, points2 = matches(60)
    points1[3] = np.nan
    ransac = Ransac(cv2.RANSAC, 1e-3, 0.9999, 1000)
    pose, inliers = ransac.relative_pose(rays(CAMERA1, points1), rays(CAMERA2, points2))
    assert pose is not None
    assert np.flatnonzero(~inliers).tolist() == [3]


def test_sampson_distance_by_hand() -> None:
    # Sideways motion: epipolar lines are rows, and two images share an offset of 0.3 equally.
    pose = (np.eye(3), np.array([2.0, 0, 0]))
    found = sampson_distances(pose, np.array([[0.1, 0.2]]), np.array([[-0.4, 0.5]]))
    assert found == pytest.approx([0.3 / math.sqrt(2)])
    nowhere = sampson_distances((np.eye(3), np.zeros(3)), np.zeros((1, 2)), np.zeros((1, 2)))
    assert nowhere == [math.inf]


def test_angle_of_a_rotation() -> None:
    assert rotation_angle_deg(turn((1, -2, 0.5), 133)) == pytest.approx(133)


def result(category: str, error: float, direction_error: float) -> PairResult:
    details = {
        "direction_error_deg": direction_error,
        "gc_error": error / 2,
        "gc_direction_error_deg": 0.0,
    }
    return PairResult(error, 50, None, details, name="p", category=category)


def test_summary_has_shares_by_category_in_order_and_counts_failures() -> None:
    results = [
        result("100°", math.inf, math.inf),
        result("20°", 4.9, 7.5),
        result("20°", 5.0, 1.0),
        result("20°", 15.0, 1.0),
    ]
    summary = Imc().summarize(results)
    names = ["20°", "100°", "all", "all < 10°", "all < 20°", "pose AUC 10°"]
    assert list(summary) == [*names, *(f"GC-RANSAC: {name}" for name in names)]
    expected = [1 / 3, 0, 1 / 4, 2 / 4, 3 / 4, (0.25 + 0.5) / 4]
    refined = [2 / 3, 0, 2 / 4, 3 / 4, 3 / 4, (0.755 + 0.75 + 0.25) / 4]
    assert list(summary.values()) == pytest.approx([*expected, *refined])


def test_refinement_on_all_inliers_beats_one_sample_of_them() -> None:
    points1, points2 = matches(300)
    noise = np.random.default_rng(4).normal(0, 1.0, (2, *points1.shape))
    score = Imc(max_num_iterations=500).score(
        make_pair(), points1 + noise[0], points2 + noise[1], 0
    )
    assert score.details["gc_error"] < 0.7 * score.error
