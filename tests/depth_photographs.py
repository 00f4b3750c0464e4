"""Photographs with known depth, for tests of depth maps."""

from __future__ import annotations

import numpy as np
from planar_scenes import Room, rays, unit

from colmap_affrect.data import Photograph

FLOAT32_RTOL = 1e-6
"""Rounding to float32 after float64 arithmetic."""

CAMERA = np.array([[30.0, 0.0, 4.2], [0.0, 21.0, 2.9], [0.0, 0.0, 1.0]])
"""Of an image of 12 x 8 px: principal point off the middle, pixels not square."""


def photograph(name="a.jpg", size=(12, 8), camera_matrix=CAMERA, path=None):
    return Photograph(np.zeros(size[::-1], np.uint8), name, path, camera_matrix)


def slanted_plane(size, camera_matrix):
    """Depth along the axis and along the rays of the plane n . X = 3 seen by a camera."""
    normal = np.array([0.3, -0.5, 1.0])
    wall = Room(-unit(normal)[None], 3.0 / np.linalg.norm(normal), camera_matrix, size)
    z_depth, _ = wall.depth(size)
    directions = rays(camera_matrix, np.arange(size[0]), np.arange(size[1]))
    return z_depth, z_depth * np.linalg.norm(directions, axis=-1)
