"""Made-up scenes of straight lines, and what a camera sees of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from strategies import Array

from colmap_affrect.data import GrayImage

SIZE = (1500, 1000)  # of the images, px


def turn(axis: int, degrees: float) -> Array:
    """A (3, 3) turn about x, y or z."""
    angle = np.deg2rad(degrees)
    first = (axis + 1) % 3
    second = (axis + 2) % 3
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[first, second] = -np.sin(angle)
    matrix[second, first] = np.sin(angle)
    return matrix


@dataclass(frozen=True)
class Building:
    """A building of random straight edges, and the camera before it."""

    focal: float = 1.0  # longer sides
    shift: float = 0.0  # of the principal point, down, longer sides
    # columns are the building's right, down and ahead in the camera's frame
    rotation: Array = field(
        default_factory=lambda: turn(2, 3.0) @ turn(0, -12.0) @ turn(1, 35.0)
    )
    num_each: int = 25  # edges of each direction
    noise_px: float = 0.4  # of the ends
    directions: tuple[int, ...] = (0, 1, 2)
    # of the lens: a point at u from the middle is seen at u * (1 + distortion * |u|**2)
    distortion: float = 0.0

    def edges(self, seed: int = 0) -> Array:
        """(N, 4) ends in pixel-centre px of an image of ``SIZE``."""
        random = np.random.default_rng(seed)
        longer = max(SIZE)
        middle = np.array(SIZE) / 2.0 - 0.5
        found = []
        while len(found) < self.num_each * len(self.directions):
            direction = self.directions[len(found) % len(self.directions)]
            start = random.uniform([-4.0, -3.0, 5.0], [4.0, 3.0, 12.0])
            end = start + self.rotation[:, direction] * random.uniform(0.6, 2.0)
            ends = np.stack([start, end])
            flat = self.focal * ends[:, :2] / ends[:, 2:] + [0.0, self.shift]
            flat *= 1.0 + self.distortion * np.sum(flat**2, axis=1, keepdims=True)
            pixels = flat * longer + middle + random.normal(0.0, self.noise_px, (2, 2))
            inside = (pixels > 0.0).all() and (pixels < np.array(SIZE) - 1.0).all()
            if ends[:, 2].min() > 1.0 and inside:
                found.append(pixels.ravel())
        return np.array(found)


def chance_edges(number: int, seed: int = 0) -> Array:
    """(N, 4) ends of edges that point anywhere, px."""
    random = np.random.default_rng(seed)
    middles = random.uniform([100.0, 100.0], [1400.0, 900.0], (number, 2))
    angles = random.uniform(0.0, np.pi, number)
    halves = random.uniform(20.0, 90.0, number)[:, None] * np.stack(
        [np.cos(angles), np.sin(angles)], axis=1
    )
    return np.hstack([middles - halves, middles + halves])


def arch_edges(number: int) -> Array:
    """(N, 4) ends of chords of half circles about one another, as of a round portal, px."""
    found = []
    for radius in (200.0, 260.0, 320.0, 380.0):
        angles = np.linspace(np.pi, 2.0 * np.pi, number + 1)
        points = np.array([750.0, 700.0]) + radius * np.stack(
            [np.cos(angles), np.sin(angles)], axis=1
        )
        found.append(np.hstack([points[:-1], points[1:]]))
    return np.concatenate(found)


WALL_FOCAL = 1.0  # longer sides
WALL_TURN = turn(0, -8.0) @ turn(
    1, 42.0
)  # columns are right, down and ahead of the building


def pixels(points: Array, rotation: Array = WALL_TURN) -> Array:
    """(N, 2) pixel-centre px of (N, 3) points in the frame of the building, its corner at 0."""
    in_camera = points @ rotation.T + [0.0, 0.0, 6.0]
    return (
        WALL_FOCAL * SIZE[0] * in_camera[:, :2] / in_camera[:, 2:]
        + np.array(SIZE) / 2.0
        - 0.5
    )


def draw_wall(image: GrayImage, along: Array, rotation: Array = WALL_TURN) -> None:
    """Draw windows on a wall that runs from the corner along a direction."""
    down = np.array([0.0, 1.0, 0.0])
    for column in range(5):
        for row in range(4):
            start = along * (0.3 + 0.55 * column) + down * (0.6 * row - 1.2)
            corners = [start, start + 0.35 * along, start + 0.35 * along + 0.4 * down,
                       start + 0.4 * down]  # fmt: skip
            outline = np.rint(pixels(np.array(corners), rotation)).astype(np.int32)
            cv2.fillPoly(image, [outline], 40, cv2.LINE_AA)


def corner_of_walls() -> GrayImage:
    """Draw windows on two walls of a court that meet in the middle."""
    image = np.full(SIZE[::-1], 200, np.uint8)
    draw_wall(image, np.array([1.0, 0.0, 0.0]))
    draw_wall(image, np.array([0.0, 0.0, -1.0]))
    return image
