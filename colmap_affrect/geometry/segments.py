"""Straight segments of a photograph, in units that do not hang on its size.

Lengths are in longer sides of the image, positions count from its middle, x right, y down.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.conventions import HALF_PIXEL

MAX_NUM_SEGMENTS = 160  # the longest are looked at; resource
# Rad, of a segment's direction: lenses distort, and walls are not quite plumb; judged
ANGLE_SIGMA = 0.008
END_SIGMA = 0.0008  # longer sides, of the ends of a segment: about one px; theory
# Longer sides; closer parallel segments are of one cornice or frame; judged
SAME_LINE_DISTANCE = 0.012
SAME_LINE_ANGLE = 0.05  # rad; judged
NUM_UNDISTORTING_STEPS = 10  # each is five times nearer at the corners; numeric


@dataclass(frozen=True)
class Segments:
    """Straight segments of a photograph.

    Attributes:
        starts: (N, 2) in longer sides from the middle of the image.
        ends: (N, 2) likewise.
    """

    starts: Floats
    ends: Floats

    @classmethod
    def of_image(cls, ends_px: Floats, image_size: tuple[int, int]) -> "Segments":
        """Return the longest segments of an image.

        Args:
            ends_px: (N, 4) x and y of start and end, pixel-centre px.
            image_size: (width, height) in px.

        Returns:
            At most ``MAX_NUM_SEGMENTS``, the longest first.
        """
        middle = np.asarray(image_size, np.float64) / 2.0 - HALF_PIXEL
        scaled = (ends_px.reshape(-1, 2, 2) - middle) / max(image_size)
        lengths = np.linalg.norm(scaled[:, 1] - scaled[:, 0], axis=1)
        longest = np.argsort(-lengths, kind="stable")[:MAX_NUM_SEGMENTS]
        return cls(scaled[longest, 0], scaled[longest, 1])

    def longest(self, number: int) -> "Segments":
        """Return the longest segments."""
        return Segments(self.starts[:number], self.ends[:number])

    def undistorted(self, distortion: float) -> "Segments":
        """Return the segments as a lens without distortion would show them.

        A point at ``u`` from the middle is seen at ``u * (1 + distortion * |u|**2)``: COLMAP's
        ``SIMPLE_RADIAL`` with ``k = distortion * f**2``, all in longer sides.
        """
        if distortion == 0.0:
            return self
        return Segments(
            _undistorted(self.starts, distortion), _undistorted(self.ends, distortion)
        )

    def __len__(self) -> int:
        return len(self.starts)

    @cached_property
    def middles(self) -> Floats:
        """(N, 2) middles."""
        return (self.starts + self.ends) / 2.0

    @cached_property
    def lengths(self) -> Floats:
        """(N,) lengths."""
        return np.asarray(np.linalg.norm(self.ends - self.starts, axis=1))

    @cached_property
    def directions(self) -> Floats:
        """(N, 2) unit vectors along the segments."""
        return np.asarray((self.ends - self.starts) / self.lengths[:, None])

    @cached_property
    def lines(self) -> Floats:
        """(N, 3) homogeneous lines through the segments, the first two numbers of unit length."""
        x, y = self.directions.T
        return np.stack(
            [y, -x, x * self.middles[:, 1] - y * self.middles[:, 0]], axis=1
        )

    @cached_property
    def sigmas(self) -> Floats:
        """(N,) deviations of the directions, rad."""
        return np.asarray(np.hypot(ANGLE_SIGMA, END_SIGMA / self.lengths))

    @cached_property
    def weights(self) -> Floats:
        """(N,) parts of a line that the segments are, so that each line counts once."""
        cosines = np.abs(self.directions @ self.directions.T)
        normals = np.stack([-self.directions[:, 1], self.directions[:, 0]], axis=1)
        offsets = self.middles[None, :, :] - self.middles[:, None, :]
        distances = np.abs(np.einsum("ijk,ik->ij", offsets, normals))
        is_same = (cosines > math.cos(SAME_LINE_ANGLE)) & (
            distances < SAME_LINE_DISTANCE
        )
        is_same |= is_same.T
        return np.asarray(self.lengths / (is_same @ self.lengths))


def _undistorted(seen: Floats, distortion: float) -> Floats:
    """Return the (N, 2) points that a lens shows at (N, 2) others."""
    points = seen
    for _ in range(NUM_UNDISTORTING_STEPS):
        squares = np.sum(points**2, axis=1, keepdims=True)
        points = seen / (1.0 + distortion * squares)
    return np.asarray(points)
