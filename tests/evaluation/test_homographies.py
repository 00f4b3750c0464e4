"""Errors of homographies by hand and by the protocol in words; wrong truths are noticed."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.homographies import (
    TrueHomography,
    oriented,
    transfer_errors,
    visible_points,
)
from colmap_affrect.evaluation.protocol import EvaluationPair, PairResult, PairScore

SHARED_PAIRS = Path(__file__).resolve().parents[3] / "shared" / "pairs"

TRUTH = np.array([[0.9, 0.2, 30.0], [-0.1, 1.1, -20.0], [3e-4, -1e-4, 1.0]])
SIZE1, SIZE2 = (320, 200), (240, 260)
ROUNDING_PX = 1e-9
"""Double precision on coordinates of some hundred px."""


def shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


BEHIND = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])
"""Carries points right of x = 100 behind the camera."""


def error_px(estimate: np.ndarray | None, truth: np.ndarray = TRUTH) -> float:
    return TrueHomography(truth, SIZE1, SIZE2).error_px(estimate)


def test_transfer_error_of_one_match_by_hand() -> None:
    points1 = np.array([[100.0, 50.0]])
    exact = np.array([(90 + 10 + 30) / 1.025, (-10 + 55 - 20) / 1.025])
    errors = transfer_errors(TRUTH, points1, exact[None] + [3.0, 4.0])
    np.testing.assert_allclose(errors, [5.0], atol=ROUNDING_PX)


def test_error_in_image_2_and_never_behind_the_camera() -> None:
    doubling = np.diag([2.0, 2.0, 1.0])
    errors = transfer_errors(doubling, np.array([[11.0, 5.0]]), np.array([[20.0, 10.0]]))
    np.testing.assert_allclose(errors, [2.0], atol=ROUNDING_PX)
    points = np.array([[200.0, 40.0], [100.0, 7.0]])
    errors = transfer_errors(BEHIND, points, np.array([[-200.0, -40.0], [0.0, 0.0]]))
    assert np.isinf(errors).all()


@pytest.mark.parametrize(
    ("truth", "size2", "first", "last"),
    [
        (shift(-100.0, 40.0), SIZE2, (100, 0), (316, 196)),
        (shift(0.0, 100.0), SIZE2, (0, 0), (236, 156)),
        (BEHIND, (10_000, 10_000), (0, 0), (96, 196)),
    ],
)
def test_visible_points_are_those_that_land_in_image_2(
    truth: np.ndarray, size2: tuple[int, int], first: tuple[int, int], last: tuple[int, int]
) -> None:
    points = visible_points(truth, SIZE1, size2)
    np.testing.assert_array_equal(points.min(axis=0), first)
    np.testing.assert_array_equal(points.max(axis=0), last)
    assert len(points) == np.prod((np.array(last) - first) // 4 + 1)


def test_error_of_a_shift_is_its_euclidean_length() -> None:
    assert error_px(shift(0.3, -0.4) @ TRUTH) == pytest.approx(0.5, abs=ROUNDING_PX)


def test_error_agrees_with_all_visible_pixels_carried_there_and_back() -> None:
    """The protocol in words: the mask of image 1, pushed to image 2 and back, and its pixels."""
    estimate = TRUTH @ np.array([[1.01, 0.02, 1.0], [0.0, 0.99, -2.0], [1e-5, 0.0, 1.0]])
    ones = np.ones(SIZE1[::-1], np.uint8)
    there = cv2.warpPerspective(ones, TRUTH, SIZE2, flags=cv2.INTER_NEAREST)
    back = cv2.warpPerspective(there, np.linalg.inv(TRUTH), SIZE1, flags=cv2.INTER_NEAREST)
    rows, columns = np.nonzero(back)
    points = np.stack([columns, rows], axis=1).astype(np.float64)[:, None]
    carried = [cv2.perspectiveTransform(points, matrix)[:, 0] for matrix in (estimate, TRUTH)]
    expected = np.linalg.norm(carried[0] - carried[1], axis=1).mean()
    assert expected > 1.0
    assert error_px(estimate) == pytest.approx(expected, rel=0.02)  # every 16th pixel, the border


@pytest.mark.parametrize("scale", [1.0, -2.0])
def test_scale_and_sign_of_estimate_and_truth_do_not_matter(scale: float) -> None:
    assert error_px(scale * TRUTH) == pytest.approx(0, abs=ROUNDING_PX)
    truth = oriented(scale * TRUTH, SIZE1, SIZE2)
    assert error_px(shift(0, 2) @ TRUTH, truth) == pytest.approx(2.0, abs=ROUNDING_PX)


def test_estimate_with_its_horizon_in_the_image_has_infinite_error() -> None:
    estimate = TRUTH + np.array([[0, 0, 0], [0, 0, 0], [-0.01, 0, 0]])
    assert error_px(estimate) == error_px(None) == float("inf")


def test_counts_are_of_both_estimators() -> None:
    errors = [(0.5, 4.0), (3.0, 2.9), (float("inf"), 12.0)]
    results = [
        PairResult(error, 9, 9, {"magsac_error": other}, name=str(error)) for error, other in errors
    ]
    failed = PairResult(float("inf"), 0, name="failed", failure="unreadable")
    counts = Evd().summarize([*results, failed])
    assert list(counts.values()) == [1, 1, 1, 2, 2, 2, 0, 0, 1, 2, 2, 3]
    assert list(counts)[2:7:4] == ["< 3 px", "MAGSAC: < 1 px"]


def score(points1: np.ndarray, points2: np.ndarray) -> PairScore:
    pair = EvaluationPair("", (None, None), truth=TrueHomography(TRUTH, SIZE1, SIZE2))
    return Evd().score(pair, points1, points2, 3)


def test_matches_of_which_half_are_wrong_give_the_homography() -> None:
    rng = np.random.default_rng(5)
    points1 = rng.uniform(0, SIZE1, (60, 2))
    points2 = cv2.perspectiveTransform(points1[:, None], TRUTH)[:, 0]
    points2[::2] += rng.uniform(30, 60, (30, 2))
    found = score(points1, points2)
    assert found.error < 1e-3
    assert found.details["magsac_error"] < 1e-2
    assert (found.num_inliers, found.num_correct) == (30, 30)
    assert score(points2, points1).error > 10.0


def test_too_few_matches_give_no_homography() -> None:
    three = np.array([[1.0, 2.0], [30.0, 4.0], [5.0, 60.0]])
    found = score(three, three)
    assert (found.error, found.num_inliers) == (float("inf"), 0)
    assert found.details == {"magsac_error": float("inf"), "magsac_num_inliers": 0}
