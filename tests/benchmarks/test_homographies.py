"""Tests of the metrics of the benchmark of image pairs, and of its ground truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from homographies import (
    CORRECT_PX,
    counts_below,
    homography_error,
    transfer_errors,
    visible_points,
)
from pair_data import SETS, HomographyPair, load_pairs

from colmap_affrect.extraction import extract_image
from colmap_affrect.imaging import read_gray, warp
from colmap_affrect.matching.nearest import match_features, matchable
from colmap_affrect.recipes import load_recipe
from colmap_affrect.types import Rectification

PAIRS_PATH = Path(__file__).resolve().parents[3] / "shared" / "pairs"

TRUTH = np.array([[0.9, 0.2, 30.0], [-0.1, 1.1, -20.0], [3e-4, -1e-4, 1.0]])
SIZE1, SIZE2 = (320, 200), (240, 260)
ROUNDING_PX = 1e-9
"""Double precision on coordinates of some hundred px."""

GROSS_ERROR_PX = 10.0
"""Median distance of matches that only a wrong homography leaves: random ones are 100 px apart."""


def shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def test_transfer_error_of_one_match_by_hand() -> None:
    points1 = np.array([[100.0, 50.0]])
    exact = np.array([(90 + 10 + 30) / 1.025, (-10 + 55 - 20) / 1.025])
    errors = transfer_errors(TRUTH, points1, exact[None] + [3.0, 4.0])
    np.testing.assert_allclose(errors, [5.0], atol=ROUNDING_PX)


def test_transfer_error_is_measured_in_image_2() -> None:
    doubling = np.diag([2.0, 2.0, 1.0])
    errors = transfer_errors(doubling, np.array([[11.0, 5.0]]), np.array([[20.0, 10.0]]))
    np.testing.assert_allclose(errors, [2.0], atol=ROUNDING_PX)


def test_points_behind_the_camera_are_never_correct() -> None:
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])
    points = np.array([[200.0, 40.0], [100.0, 7.0]])
    assert np.isinf(transfer_errors(behind, points, np.array([[-200.0, -40.0], [0.0, 0.0]]))).all()


def test_visible_points_are_those_that_land_in_image_2() -> None:
    points = visible_points(shift(-100.0, 40.0), SIZE1, SIZE2)
    assert (points.min(axis=0) == [100, 0]).all()
    assert (points.max(axis=0) == [316, 196]).all()
    assert len(points) == 55 * 50


def test_visible_points_end_with_image_2() -> None:
    points = visible_points(shift(0.0, 100.0), SIZE1, SIZE2)
    assert (points.max(axis=0) == [236, 156]).all()


def test_nothing_behind_the_camera_is_visible() -> None:
    behind = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])
    assert visible_points(behind, SIZE1, (10_000, 10_000))[:, 0].max() == 96


def test_error_of_a_shift_is_its_length() -> None:
    error = homography_error(shift(0.3, -0.4) @ TRUTH, TRUTH, SIZE1, SIZE2)
    assert error == pytest.approx(0.5, abs=ROUNDING_PX)


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
    measured = homography_error(estimate, TRUTH, SIZE1, SIZE2)
    assert expected > 1.0
    assert measured == pytest.approx(expected, rel=0.02)  # every 16th pixel, and the border


@pytest.mark.parametrize("scale", [1.0, -2.0])
def test_scale_and_sign_of_an_estimate_do_not_matter(scale: float) -> None:
    assert homography_error(scale * TRUTH, TRUTH, SIZE1, SIZE2) == pytest.approx(0, abs=ROUNDING_PX)


def test_estimate_with_its_horizon_in_the_image_has_infinite_error() -> None:
    estimate = TRUTH + np.array([[0, 0, 0], [0, 0, 0], [-0.01, 0, 0]])
    assert homography_error(estimate, TRUTH, SIZE1, SIZE2) == float("inf")


def test_counts_below() -> None:
    assert counts_below([0.5, 2.9, 3.0, None, 12.0, float("inf")]) == [1, 1, 2, 3, 3, 4]


def test_layouts_of_the_sets(tmp_path: Path) -> None:
    (tmp_path / "evd_sample" / "h").mkdir(parents=True)
    np.savetxt(tmp_path / "evd_sample" / "h" / "cafe.txt", TRUTH)
    (tmp_path / "oxford_wall").mkdir()
    for number in (3, 2):
        np.savetxt(tmp_path / "oxford_wall" / f"H_wall_1_{number}.txt", shift(number, 7))
    (pair,) = load_pairs(tmp_path, "evd_sample")
    assert (pair.name, pair.path2) == ("cafe", tmp_path / "evd_sample" / "2" / "cafe.png")
    np.testing.assert_allclose(pair.truth, TRUTH)
    wall = load_pairs(tmp_path, "oxford_wall")
    assert [(pair.name, pair.path2.name) for pair in wall] == [
        ("1-2", "wall_2.png"),
        ("1-3", "wall_3.png"),
    ]
    np.testing.assert_array_equal(wall[1].truth, shift(3, 7))


@pytest.mark.shared
@pytest.mark.parametrize("set_name", SETS)
def test_features_agree_with_the_truth_after_rectification_by_it(set_name: str) -> None:
    pairs = load_pairs(PAIRS_PATH, set_name)
    assert len(pairs) == (7 if set_name == "evd_sample" else 5)
    medians_px = [median_error_after_rectification(pair) for pair in pairs]
    assert max(medians_px) < GROSS_ERROR_PX, dict(zip(pairs, medians_px, strict=True))
    assert min(medians_px) < CORRECT_PX


def median_error_after_rectification(pair: HomographyPair) -> float:
    """Match image 1, warped by the truth, with image 2; measure against the truth."""
    gray1, gray2 = (read_gray(path) for path in (pair.path1, pair.path2))
    size2 = (gray2.shape[1], gray2.shape[0])
    warped = warp(gray1, Rectification(pair.truth, size2, None, 1.0, 0.0))
    recipe = load_recipe("unrectified-rootsift")
    features = [extract_image(gray, recipe.extraction) for gray in (warped, gray2)]
    images = [matchable(part.descriptors, part.keypoints, recipe.matching) for part in features]
    rows1, rows2 = match_features(images[0], images[1], recipe.matching).indices.T
    distances_px = features[0].keypoints[rows1] - features[1].keypoints[rows2]
    return float(np.median(np.linalg.norm(distances_px, axis=1)))
