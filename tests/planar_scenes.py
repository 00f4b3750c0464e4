"""Scenes of planes whose depth, normals and labels are known in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from synthetic import texture, write_image

from colmap_affrect.data import GrayImage, Photograph, ShapeGrid, ShapeSamples
from colmap_affrect.geometry.conventions import resized_from_original
from colmap_affrect.geometry.tilts import metrics_from_tilts

Array = NDArray[np.float64]

SUPERSAMPLING = 3
"""Samples of the texture per pixel in x and in y."""


@dataclass
class FixedDepth:
    """Depth source that returns one map."""

    values: Array

    def depth(self, _: Photograph) -> NDArray[np.float32]:
        return self.values.astype(np.float32)


@dataclass
class FixedShapes:
    """Shape source that knows its shapes beforehand, as rows (x, y, tilt, angle)."""

    rows: Array

    def grid(self, image: GrayImage) -> ShapeGrid:
        """Not for rectifiers that read samples."""
        raise NotImplementedError

    def samples(self, _: GrayImage) -> ShapeSamples:
        return ShapeSamples(
            self.rows[:, :2], metrics_from_tilts(self.rows[:, 2], self.rows[:, 3])
        )


def unit(vector: ArrayLike) -> Array:
    """Scale vectors to unit length."""
    vector = np.asarray(vector, dtype=float)
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def angles_deg(first: Array, second: Array) -> Array:
    """Angles between unit vectors, exact for small ones."""
    half_chord = np.linalg.norm(first - second, axis=-1) / 2.0
    return np.asarray(np.rad2deg(2.0 * np.arcsin(np.minimum(half_chord, 1.0))))


def rays(camera_matrix: Array, columns: Array, rows: Array) -> Array:
    """(h, w, 3) viewing rays with z = 1 of a grid of pixels."""
    points = np.stack(np.broadcast_arrays(columns, rows[:, None], 1.0), axis=-1)
    return points @ np.linalg.inv(camera_matrix).T


def nearest_planes(
    directions: Array, normals: Array, distances: Array
) -> tuple[Array, NDArray[np.intp]]:
    """(h, w) factors by which directions (h, w, 3) reach planes n . P = -d, and which planes.

    Where none is reached the factor is infinite.
    """
    facing = -directions @ normals.T
    with np.errstate(divide="ignore"):
        factors = np.where(facing > 0, distances / facing, np.inf)
    return factors.min(axis=-1), factors.argmin(axis=-1)


def look_up(
    texture: GrayImage, x: NDArray[np.floating], y: NDArray[np.floating]
) -> GrayImage:
    """Values of a texture at points of its pixel grid; its border is reflected once."""
    height, width = texture.shape
    x = np.clip(x, -width, 2 * width)
    y = np.clip(y, -height, 2 * height)
    maps = x.astype(np.float32), y.astype(np.float32)
    return cv2.remap(texture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


@dataclass(frozen=True)
class Room:
    """Planes n . P = -d before a camera, of which each pixel sees the nearest.

    Attributes:
        normals: (K, 3) unit normals that face the camera.
        distances: (K,) distances d of the planes from the camera.
        camera_matrix: (3, 3) intrinsics in pixel-centre px of the image.
        size: (width, height) of the image.
    """

    normals: Array
    distances: Array
    camera_matrix: Array
    size: tuple[int, int]

    def camera_at(self, size: tuple[int, int]) -> Array:
        """Intrinsics of the image resized to (width, height)."""
        return resized_from_original(self.size, size) @ self.camera_matrix

    def depth(self, size: tuple[int, int]) -> tuple[Array, NDArray[np.intp]]:
        """(h, w) z-depth at pixel centres, NaN where no plane is seen, and the plane's number."""
        directions = rays(self.camera_at(size), np.arange(size[0]), np.arange(size[1]))
        depth, labels = nearest_planes(directions, self.normals, self.distances)
        return np.where(np.isinf(depth), np.nan, depth), labels

    def render(self, texture: GrayImage, px_per_unit: float) -> GrayImage:
        """Image of the room with the same texture on all planes, in plane coordinates."""
        width, height = (SUPERSAMPLING * extent for extent in self.size)
        depth, labels = self.depth((width, height))
        directions = rays(
            self.camera_at((width, height)), np.arange(width), np.arange(height)
        )
        points = directions * np.nan_to_num(depth)[..., None]
        maps = np.zeros((2, height, width), np.float32)
        for label, normal in enumerate(self.normals):
            seen = labels == label
            maps[:, seen] = px_per_unit * plane_coordinates(normal, points[seen]).T
        dense = look_up(texture, maps[0], maps[1])
        return np.asarray(cv2.resize(dense, self.size, interpolation=cv2.INTER_AREA))

    def photograph(self, image: GrayImage | None = None) -> Photograph:
        """The room, or an image of it, as rectifiers see it."""
        image = np.zeros(self.size[::-1], np.uint8) if image is None else image
        return Photograph(image, "room.png", None, self.camera_matrix)


def plane_coordinates(normal: Array, points: Array) -> Array:
    """(N, 2) coordinates in a plane of (N, 3) points on it."""
    right = unit(np.cross([0.2, -1.0, 0.1], normal))
    return points @ np.stack([right, np.cross(normal, right)], axis=1)


def corner_room() -> Room:
    """Back wall, left wall and floor at right angles, seen off-centre by a camera looking down.

    The camera's pixels are not square.
    """
    floor = unit([0.05, -0.87, -0.49])
    left = np.array([0.8, 0.0, -0.6])
    left = unit(left - (left @ floor) * floor)
    back = np.cross(left, floor)
    camera = np.array([[300.0, 0.0, 190.0], [0.0, 330.0, 120.0], [0.0, 0.0, 1.0]])
    distances = np.array([3.3, 2.2, 2.1])
    return Room(np.stack([back, left, floor]), distances, camera, (400, 300))


def slanted_wall(normal: ArrayLike, size: tuple[int, int] = (400, 300)) -> Room:
    """One plane at distance 2, seen off-centre by a camera with square pixels."""
    camera = np.array([[340.0, 0.0, 215.0], [0.0, 340.0, 130.0], [0.0, 0.0, 1.0]])
    return Room(unit(normal)[None], np.array([2.0]), camera, size)


BOX_SIZE = np.array([6.0, 4.0, 8.0])
"""Width, height and length of the box whose inside panoramas show."""
PANORAMA_SIZE = (1024, 512)


def write_panoramas(folder: Path, count: int) -> None:
    """Write panoramas (equirectangular) of the inside of a textured box along a curve."""
    faces = [texture((1024, 1024), seed, 2.0) for seed in range(6)]
    normals = np.concatenate([np.eye(3), -np.eye(3)])  # inwards
    width, height = PANORAMA_SIZE
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    yaw = (2 * x / width - 1) * np.pi
    pitch = (2 * y / height - 1) * np.pi / 2
    towards = [np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)]
    directions = np.stack(towards, axis=-1)
    for index in range(count):
        position = np.array([0.5 * index - 0.5, 0.15 * index, 0.35 * index**1.5 - 0.6])
        distances = np.concatenate([BOX_SIZE, BOX_SIZE]) / 2 + normals @ position
        factors, labels = nearest_planes(directions, normals, distances)
        places = (position + directions * factors[..., None]) / BOX_SIZE + 0.5  # 0 to 1
        image = np.zeros((height, width), np.uint8)
        for label, face in enumerate(faces):
            u, v = np.moveaxis(np.delete(places, label % 3, axis=-1), -1, 0) * 1023
            image = np.where(labels == label, look_up(face, u, v), image)
        write_image(folder / f"{index}.png", np.dstack([image] * 3))
