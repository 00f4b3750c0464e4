"""What an epipolar geometry or a homography says of matches of two images, and of their frames.

Epipolar lines hold points, and local affine frames must carry the epipolar direction of image 1 to
that of image 2; a homography holds places, and frames must turn as it does.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import (
    adjugates,
    determinants,
    homography_errors,
    transform_frames,
)
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.epipolar import direction_cosines, sampson_errors

Points = Array
Rows = NDArray[np.integer]


@dataclass(frozen=True)
class EpipolarModel:
    """What an epipolar geometry says of matches of features ``rows1`` with features ``rows2``."""

    has_sign: ClassVar[bool] = True
    """All cosines may have the other sign."""
    fundamental: Points
    points: tuple[Points, Points]
    sample_size: int = 7

    def errors(self, rows1: Rows, rows2: Rows) -> Points:
        """Return (M,) px."""
        return sampson_errors(self.fundamental, self.points[0][rows1], self.points[1][rows2])

    def cosines(self, rows1: Rows, rows2: Rows, shapes: tuple[Points, Points]) -> Points:
        """Return (M,) cosines between what frames carry over and what the geometry does."""
        points = self.points[0][rows1], self.points[1][rows2]
        return direction_cosines(self.fundamental, *points, shapes[0][rows1], shapes[1][rows2])


@dataclass(frozen=True)
class HomographyModel:
    """As :class:`EpipolarModel`, of a homography."""

    has_sign: ClassVar[bool] = False
    sample_size: ClassVar[int] = 4
    matrix: Points
    points: tuple[Points, Points]

    def errors(self, rows1: Rows, rows2: Rows) -> Points:
        """Return (M,) px."""
        return homography_errors(self.matrix, self.points[0][rows1], self.points[1][rows2])

    def cosines(self, rows1: Rows, rows2: Rows, shapes: tuple[Points, Points]) -> Points:
        """Return (M,) cosines between what frames carry over and what the geometry does."""
        frames = np.concatenate([shapes[0][rows1], self.points[0][rows1, :, None]], axis=2)
        return turn_cosines(transform_frames(self.matrix, frames)[:, :, :2], shapes[1][rows2])


PairModel = EpipolarModel | HomographyModel


def turn_cosines(shapes1: Points, shapes2: Points) -> Points:
    """Return (N,) cosines of the angles by which frames are turned against others; -1 mirrored."""
    turns = shapes2 @ adjugates(shapes1) * np.sign(determinants(shapes1))[:, None, None]
    along, across = turns[:, 0, 0] + turns[:, 1, 1], turns[:, 1, 0] - turns[:, 0, 1]
    cosines = along / np.maximum(np.hypot(along, across), np.finfo(float).tiny)
    return np.where(determinants(turns) > 0.0, cosines, -1.0)
