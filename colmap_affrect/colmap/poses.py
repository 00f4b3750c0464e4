"""Camera poses of models, and how far relative poses are apart."""

from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import ComparisonError
from colmap_affrect.geometry.arrays import Array

Pose = tuple[Array, Array]  # cam_from_world: rotation matrix and translation
Poses = dict[str, Pose]  # poses by image name


def read_poses(model_path: Path) -> Poses:
    """Read the poses of a COLMAP model, text or binary; ComparisonError when it has none."""
    poses = model_poses(read_given_model(model_path, error_class=ComparisonError))
    if not poses:
        raise ComparisonError(f"{model_path}: the model has no images with poses")
    return poses


def model_poses(model: pycolmap.Reconstruction) -> Poses:
    """Return the poses of the registered images of a model."""
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    matrices = {image.name: image.cam_from_world().matrix() for image in images}
    return {name: (matrix[:, :3], matrix[:, 3]) for name, matrix in matrices.items()}


def relative_pose(pose1: Pose, pose2: Pose) -> Pose:
    """Compute cam2_from_cam1 from two cam_from_world poses."""
    rotation = pose2[0] @ pose1[0].T
    return rotation, pose2[1] - rotation @ pose1[1]


def pose_errors(estimated: Pose, truth: Pose) -> tuple[float, float]:
    """Return the angles between two relative poses, degrees: rotation, translation direction."""
    rotation, translation = estimated
    true_rotation, true_translation = truth
    difference = rotation @ true_rotation.T
    skew = difference - difference.T
    sine = np.linalg.norm([skew[2, 1], skew[0, 2], skew[1, 0]])
    rotation_error = np.degrees(np.arctan2(sine, np.trace(difference) - 1.0))
    cross = np.linalg.norm(np.cross(translation, true_translation))
    direction_error = np.degrees(np.arctan2(cross, translation @ true_translation))
    return float(rotation_error), float(direction_error)
