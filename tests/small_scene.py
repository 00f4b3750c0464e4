"""Photographs of a small room corner, rendered fast: enough for a COLMAP model of all images."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from synthetic import texture, write_image

from colmap_affrect.data import GrayImage

Array = NDArray[np.float64]

IMAGE_SIZE = (320, 240)
FOCAL_PX = 300.0
INTRINSICS = f"{FOCAL_PX},{FOCAL_PX},{IMAGE_SIZE[0] / 2},{IMAGE_SIZE[1] / 2}"
"""Value of --camera-params for a PINHOLE camera."""

NAMES = ["a.png", "b c.png", "side/č.png", "side/d.png"]

TEXTURE_PX = 400

# Textured rectangles: origin and the two edges, far ones first.
FACES = (
    ((-3.0, -2.0, 7.0), (6.0, 0.0, 0.0), (0.0, 4.0, 0.0)),  # wall behind
    ((-3.0, -2.0, 7.0), (0.0, 0.0, -4.0), (0.0, 4.0, 0.0)),  # wall on the left
    ((-3.0, 1.4, 7.0), (6.0, 0.0, 0.0), (0.0, 0.0, -4.5)),  # floor
    ((-0.7, 0.2, 5.0), (1.4, 0.0, 0.0), (0.0, 1.2, 0.0)),  # box, front
)


cached_texture = cache(texture)


def world_to_camera(yaw_deg: float) -> Array:
    """(3, 3) rotation of a camera that is turned about its y axis."""
    yaw = np.deg2rad(yaw_deg)
    return np.array(
        [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
    )


def photograph(
    position: tuple[float, float, float], yaw_deg: float, first_seed: int = 0
) -> GrayImage:
    """Render the faces, each over those before it; another seed makes another room."""
    width, height = IMAGE_SIZE
    camera = np.array(
        [[FOCAL_PX, 0, width / 2 - 0.5], [0, FOCAL_PX, height / 2 - 0.5], [0, 0, 1]]
    )
    image = np.full((height, width), 90, np.uint8)
    size = (TEXTURE_PX, TEXTURE_PX)
    for seed, (origin, edge1, edge2) in enumerate(FACES, first_seed):
        plane = np.column_stack([edge1, edge2, np.subtract(origin, position)])
        plane = (
            camera
            @ world_to_camera(yaw_deg)
            @ plane
            @ np.diag([1 / TEXTURE_PX] * 2 + [1])
        )
        warped = cv2.warpPerspective(cached_texture(size, seed), plane, IMAGE_SIZE)
        covered = cv2.warpPerspective(np.full(size, 255, np.uint8), plane, IMAGE_SIZE)
        image = np.where(covered > 127, warped, image)
    return image


def place_of(index: int) -> tuple[tuple[float, float, float], float]:
    """Return the position and the yaw in degrees of one of the photographs."""
    position = (0.55 * (index - 1.5), -0.1 * index, 0.1 * index)
    return position, -5.0 * (index - 1.5)


def write_photographs(
    folder: Path, count: int = len(NAMES), first_seed: int = 0
) -> list[str]:
    """Write the first ``count`` photographs below ``folder`` and return their names."""
    for index, name in enumerate(NAMES[:count]):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, photograph(*place_of(index), first_seed))
    return NAMES[:count]
