"""Camera poses against ground truth: hand-made poses with known errors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from colmap_affrect.colmap.model_files import Poses, read_poses
from colmap_affrect.comparison.results import (
    PoseScores,
    correct_images,
    pair_errors,
    pose_scores,
)
from colmap_affrect.errors import AffrectError


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


def num_correct(estimated: Poses, truth: Poses) -> int:
    return len(correct_images(pair_errors(estimated, truth)))


def test_similarity_of_the_world_changes_nothing(truth: Poses) -> None:
    world = rotation((3, 1, 2), 50)
    shift = np.array([7.0, -8, 9])
    estimated = {}
    for name, (matrix, translation) in truth.items():
        estimated[name] = (matrix @ world, matrix @ shift + 0.2 * translation)
    scores = pose_scores(estimated, truth, list(truth))
    assert scores.correct_names == tuple(truth)
    assert scores.median_rotation_error_deg == pytest.approx(0, abs=1e-6)
    assert scores.wrong_names == ()


@pytest.mark.parametrize("degrees", [1.0, 90.0, 179.0])
def test_injected_rotation_is_measured(truth: Poses, degrees: float) -> None:
    errors = pair_errors(turned(truth, "4.jpg", degrees), truth)
    assert errors["0.jpg", "4.jpg"][0] == pytest.approx(degrees)
    assert errors["0.jpg", "1.jpg"] == pytest.approx((0, 0))


def test_half_of_the_others_decides(truth: Poses) -> None:
    """Of five cameras two turned ones leave three right: 2 of 4 others are half."""
    estimated = turned(turned(truth, "0.jpg", 10), "1.jpg", 60)
    assert num_correct(estimated, truth) == 3
    del estimated["4.jpg"]
    assert num_correct(estimated, truth) == 0


@pytest.mark.parametrize(("degrees", "expected"), [(4.9, 5), (5.1, 4)])
def test_poses_are_correct_within_5_degrees(
    truth: Poses, degrees: float, expected: int
) -> None:
    assert num_correct(turned(truth, "4.jpg", degrees), truth) == expected


@pytest.mark.parametrize("num_images", [0, 1])
def test_no_pairs(truth: Poses, num_images: int) -> None:
    estimated = dict(list(truth.items())[:num_images])
    scores = pose_scores(estimated, truth, list(truth))
    assert scores == PoseScores((), (), None)


def test_only_images_that_are_given_and_have_truth_are_judged(truth: Poses) -> None:
    given = ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    names = ("0.jpg", "1.jpg", "2.jpg", "4.jpg")
    estimated = turned({name: truth[name] for name in names}, "2.jpg", 20)
    estimated["without truth.jpg"] = truth["0.jpg"]
    scores = pose_scores(estimated, truth, given)
    assert (scores.correct_names, scores.wrong_names) == (
        ("0.jpg", "1.jpg"),
        ("2.jpg",),
    )


@pytest.mark.parametrize("content", [None, "nothing of COLMAP\n"])
def test_folder_without_a_model_is_refused(tmp_path: Path, content: str | None) -> None:
    if content:
        for name in ("cameras.txt", "images.txt", "points3D.txt"):
            (tmp_path / name).write_text(content)
    with pytest.raises(AffrectError, match="not a COLMAP model"):
        read_poses(tmp_path)
