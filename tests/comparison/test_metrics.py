"""Tests of the metrics of the registration benchmark with hand-made poses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from registration_metrics import Poses, pose_from_text, pose_metrics, relative_pose_errors
from registration_report import Row, detail_table, merge, span, summary_table

SECONDS = {"extraction": 3.0, "matching": 3.0, "verification": 1.0, "mapping": 1.0}


def rotation(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """Return the rotation matrix about an axis."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return cv2.Rodrigues(np.radians(degrees) * unit)[0]


@pytest.fixture
def truth() -> Poses:
    """Five cameras on an arc, looking at its centre."""
    return {
        f"{i}.jpg": (rotation((0, 1, 0), 20 * i), np.array([0.1 * i * i, 0.3 * i, 5.0]))
        for i in range(5)
    }


def turned(poses: Poses, name: str, degrees: float) -> Poses:
    """Turn one camera about its own centre."""
    turn = rotation((1, 2, 3), degrees)
    return {**poses, name: (turn @ poses[name][0], turn @ poses[name][1])}


def moved(poses: Poses, name: str, centre: tuple[float, float, float]) -> Poses:
    """Move the centre of one camera."""
    return {**poses, name: (poses[name][0], -poses[name][0] @ np.array(centre))}


def test_pose_from_text_agrees_with_rodrigues() -> None:
    half = np.radians(70) / 2
    vector = np.sin(half) * np.array([1, 2, 3]) / np.sqrt(14)
    fields = [repr(float(v)) for v in (np.cos(half), *vector, 4, 5, 6)]
    matrix, translation = pose_from_text(fields)
    np.testing.assert_allclose(matrix, rotation((1, 2, 3), 70), atol=1e-12)
    np.testing.assert_array_equal(translation, [4, 5, 6])


def test_similarity_of_the_world_changes_nothing(truth: Poses) -> None:
    world, shift, scale = rotation((3, 1, 2), 50), np.array([7.0, -8, 9]), 0.2
    estimated = {
        name: (matrix @ world, matrix @ shift + scale * translation)
        for name, (matrix, translation) in truth.items()
    }
    num_correct, rotation_error = pose_metrics(estimated, truth)
    assert num_correct == 5
    assert rotation_error == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [1.0, 90.0, 179.0])
def test_injected_rotation_is_measured(truth: Poses, degrees: float) -> None:
    estimated = turned(truth, "4.jpg", degrees)
    assert relative_pose_errors(estimated, truth, "0.jpg", "4.jpg")[0] == pytest.approx(degrees)
    assert relative_pose_errors(estimated, truth, "0.jpg", "1.jpg") == pytest.approx((0, 0))


def test_injected_direction_is_measured() -> None:
    truth = {"a": (np.eye(3), np.zeros(3)), "b": (np.eye(3), np.array([1.0, 0, 0]))}
    estimated = {**truth, "b": (np.eye(3), np.array([0.0, 2.0, 0]))}
    assert relative_pose_errors(estimated, truth, "a", "b") == pytest.approx((0, 90))
    assert pose_metrics(estimated, truth) == (0, pytest.approx(0))


def test_one_turned_camera_is_wrong_and_the_others_right(truth: Poses) -> None:
    assert pose_metrics(turned(truth, "2.jpg", 6), truth)[0] == 4
    assert pose_metrics(turned(truth, "2.jpg", 3), truth)[0] == 5


def test_one_moved_camera_is_wrong_and_the_others_right(truth: Poses) -> None:
    assert pose_metrics(moved(truth, "2.jpg", (50, 0, 0)), truth)[0] == 4


def test_half_of_the_others_decides(truth: Poses) -> None:
    """Of five cameras two turned ones leave three right: 2 of 4 others are half."""
    estimated = turned(turned(truth, "0.jpg", 10), "1.jpg", 60)
    assert pose_metrics(estimated, truth)[0] == 3
    del estimated["4.jpg"]
    assert pose_metrics(estimated, truth)[0] == 0


@pytest.mark.parametrize("num_images", [0, 1])
def test_no_pairs(truth: Poses, num_images: int) -> None:
    estimated = dict(list(truth.items())[:num_images])
    assert pose_metrics(estimated, truth) == (0, None)


def test_images_without_truth_are_not_counted(truth: Poses) -> None:
    estimated = {**truth, "other.jpg": (np.eye(3), np.ones(3))}
    assert pose_metrics(estimated, truth)[0] == 5


def test_span() -> None:
    assert span([2, 3, 3, 3]) == "2.8 [2-3]"
    assert span([3, 3]) == "3"
    assert span([0.25, 0.75], 2) == "0.500 [0.25-0.75]"
    assert span([None, 1.5], 1) == "1.5"
    assert span([None]) == "-"


def test_tables() -> None:
    runs = [{"registered": 3, "correct": i, "points": 9, "seconds": SECONDS} for i in (2, 3)]
    results: list[Row] = []
    for method in ("ours", "sift", "ours"):
        new = {"subset": "b", "method": method, "num_images": 3, "seconds": SECONDS, "runs": runs}
        results = merge(results, new, ["a", "b"])
    assert [row["method"] for row in results] == ["sift", "ours"]
    assert "| b | 3 | 2.5 [2-3] of 3 | 2.5 [2-3] of 3 |" in summary_table(results)
    assert "| b | 3 | ours | 2.5 [2-3] | 3 | 1 of 2 | - | 9 |" in detail_table(results)
