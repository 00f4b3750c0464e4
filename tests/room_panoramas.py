"""Panoramas of the inside of a textured box."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from synthetic import texture, write_image

HALF_SIZES = np.array([3.0, 2.0, 4.0])
WIDTH_PX = 1024
TEXTURE_PX = 1024


def write_panoramas(folder: Path, count: int) -> None:
    """Write panoramas (equirectangular, twice as wide as high) along a curve."""
    faces = [texture((TEXTURE_PX, TEXTURE_PX), seed, 2.0) for seed in range(6)]
    for index in range(count):
        position = np.array([0.5 * index - 0.5, 0.15 * index, 0.35 * index**1.5 - 0.6])
        write_image(folder / f"{index}.png", np.dstack([_panorama(position, faces)] * 3))


def _panorama(position: np.ndarray, faces: list[np.ndarray]) -> np.ndarray:
    height = WIDTH_PX // 2
    x, y = np.meshgrid(np.arange(WIDTH_PX) + 0.5, np.arange(height) + 0.5)
    yaw, pitch = (2 * x / WIDTH_PX - 1) * np.pi, (2 * y / height - 1) * np.pi / 2
    rays = np.stack(
        [np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], axis=-1
    )
    with np.errstate(divide="ignore"):
        distances = (np.sign(rays) * HALF_SIZES - position) / rays
    axes = distances.argmin(axis=-1)
    points = position + rays * distances.min(axis=-1, keepdims=True)
    image = np.zeros((height, WIDTH_PX), np.uint8)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        maps = [
            ((points[..., k] / HALF_SIZES[k] + 1) / 2 * (TEXTURE_PX - 1)).astype(np.float32)
            for k in (u, v)
        ]
        for side in (-1, 1):
            seen = (axes == axis) & (np.sign(rays[..., axis]) == side)
            face = cv2.remap(faces[2 * axis + (side > 0)], *maps, cv2.INTER_LINEAR)
            image[seen] = face[seen]
    return image
