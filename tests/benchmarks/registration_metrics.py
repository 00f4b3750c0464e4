"""Metrics of the registration benchmark: camera poses against ground truth, pure numpy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""cam_from_world: rotation matrix and translation."""
Poses = dict[str, Pose]
"""Poses by image name."""
MAX_ERROR_DEG = 5.0


def read_true_poses(scene_path: Path) -> Poses | None:
    """Read (pseudo) ground truth from a text model; None where there is none."""
    for folder in ("ground_truth", "pseudo_ground_truth"):
        path = scene_path / folder / "images.txt"
        if path.exists():
            rows = [line.split() for line in path.read_text().splitlines()]
            return {row[9]: pose_from_text(row[1:8]) for row in rows if row and row[0] != "#"}
    return None


def pose_from_text(fields: Sequence[str]) -> Pose:
    """Convert QW QX QY QZ TX TY TZ to a rotation matrix and a translation."""
    quaternion = np.array(fields[:4], float)
    w, *vector = quaternion / np.linalg.norm(quaternion)
    skew = np.cross(np.eye(3), vector)
    return np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew, np.array(fields[4:7], float)


def relative_pose(pose1: Pose, pose2: Pose) -> Pose:
    """Compute cam2_from_cam1 from two cam_from_world poses."""
    rotation = pose2[0] @ pose1[0].T
    return rotation, pose2[1] - rotation @ pose1[1]


def relative_pose_errors(
    estimated: Poses, truth: Poses, name1: str, name2: str
) -> tuple[float, float]:
    """Compute the errors of the relative pose of two images.

    Args:
        estimated: poses of the model.
        truth: poses of the ground truth.
        name1: an image in both.
        name2: another image in both.

    Returns:
        The rotation angle and the angle between the translation directions, in degrees.
    """
    rotation, translation = relative_pose(estimated[name1], estimated[name2])
    true_rotation, true_translation = relative_pose(truth[name1], truth[name2])
    difference = rotation @ true_rotation.T
    skew = difference - difference.T
    sine = np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    rotation_error = np.degrees(np.arctan2(sine, np.trace(difference) - 1.0))
    cross = np.linalg.norm(np.cross(translation, true_translation))
    direction_error = np.degrees(np.arctan2(cross, translation @ true_translation))
    return float(rotation_error), float(direction_error)


def pose_metrics(estimated: Poses, truth: Poses) -> tuple[int, float | None]:
    """Count the correct images and measure the rotations.

    An image is correct if its relative poses to at least half of the other images of the model are
    within MAX_ERROR_DEG in rotation and in translation direction.

    Args:
        estimated: poses of the registered images.
        truth: poses of the ground truth; images without are left out.

    Returns:
        The number of correct images and the median rotation error over all pairs in degrees (None
        without pairs).
    """
    names = sorted(estimated.keys() & truth.keys())
    num_good = dict.fromkeys(names, 0)
    rotation_errors = []
    for i, name1 in enumerate(names):
        for name2 in names[i + 1 :]:
            errors = relative_pose_errors(estimated, truth, name1, name2)
            rotation_errors.append(errors[0])
            if max(errors) <= MAX_ERROR_DEG:
                num_good[name1] += 1
                num_good[name2] += 1
    num_correct = sum(2 * count >= len(names) - 1 > 0 for count in num_good.values())
    return num_correct, float(np.median(rotation_errors)) if rotation_errors else None
