"""Rays that are nearly parallel tell no depth: their matches agree with a pose all the same."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.pair_graph import compared_with_pose

FOCAL_PX = 1000.0
CAMERA = pycolmap.Camera.create_from_model_name(
    1, "SIMPLE_PINHOLE", FOCAL_PX, 1000, 800
)
MIDDLE = np.array([[500.0, 400.0]])
TO_THE_RIGHT = np.eye(3), np.array([1.0, 0.0, 0.0])  # of points in the second camera


@pytest.mark.parametrize(
    ("angle_deg", "agrees"),
    [
        (3.0, True),
        (0.5, True),
        (-0.5, True),  # a far point, and noise
        (-2.0, False),  # behind both cameras
        (-8.0, False),
    ],
)
def test_rays_that_part_agree_with_a_pose_up_to_one_degree(
    angle_deg: float, *, agrees: bool
) -> None:
    shift_px = FOCAL_PX * np.tan(np.radians(angle_deg))
    points = MIDDLE, MIDDLE + np.array([shift_px, 0.0])
    found = compared_with_pose(TO_THE_RIGHT, (CAMERA, CAMERA), points)
    assert found.depths.angles_deg == pytest.approx(abs(angle_deg))
    assert found.depths.in_front.tolist() == [angle_deg > 0.0]
    assert found.agrees.tolist() == [agrees]
