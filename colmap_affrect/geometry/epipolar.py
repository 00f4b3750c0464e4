"""Epipolar geometries and homographies: what they say of matches, and of their local affine frames.

A match of two frames must carry the direction of the epipolar line in image 1 to the one in image 2
(Barath, Hajder, Matas). All points are (N, 2) px of the convention of the fundamental matrix F with
``x2^T F x1 = 0``; shapes are the (N, 2, 2) linear parts of frames, in the same axes.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry import affine
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.two_views import homogeneous

Points = Array
Rows = NDArray[np.integer]


def epipolar_lines(fundamental: Floats, points1: Floats, points2: Floats) -> tuple[Array, Array]:
    """Return (N, 3) lines in image 1 of ``points2``, and in image 2 of ``points1``."""
    return homogeneous(points2) @ fundamental, homogeneous(points1) @ fundamental.T


def sampson_errors(fundamental: Floats, points1: Floats, points2: Floats) -> Array:
    """Return (N,) distances of matches from an epipolar geometry, px, to first order."""
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    products = (lines2[:, :2] * points2).sum(axis=1) + lines2[:, 2]
    squares = (lines1[:, :2] ** 2).sum(axis=1) + (lines2[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs(products) / np.sqrt(np.maximum(squares, np.finfo(float).tiny)))


def common_sign(cosines: Floats) -> float:
    """Return the sign, 1 or -1, that most of the cosines of an epipolar geometry have."""
    return -1.0 if np.sign(cosines).sum() < 0 else 1.0


@dataclass(frozen=True)
class EpipolarModel:
    """What an epipolar geometry says of matches of features ``rows1`` with features ``rows2``."""

    has_sign: ClassVar[bool] = True  # cosines are up to one sign of all: lines have no direction
    fundamental: Points
    points: tuple[Points, Points]
    sample_size: int = 7

    def errors(self, rows1: Rows, rows2: Rows) -> Points:
        """Return (M,) px."""
        return sampson_errors(self.fundamental, self.points[0][rows1], self.points[1][rows2])

    def cosines(self, rows1: Rows, rows2: Rows, shapes: tuple[Points, Points]) -> Points:
        """Return (M,) cosines between what frames carry over and what the geometry does."""
        points = self.points[0][rows1], self.points[1][rows2]
        lines1, lines2 = epipolar_lines(self.fundamental, *points)
        along1 = np.stack([-lines1[:, 1], lines1[:, 0]], axis=1)
        along2 = np.stack([-lines2[:, 1], lines2[:, 0]], axis=1)
        maps = shapes[1][rows2], affine.adjugates(shapes[0][rows1])
        carried = np.einsum("nij,njk,nk->ni", *maps, along1)
        lengths = np.linalg.norm(carried, axis=1) * np.linalg.norm(along2, axis=1)
        cosines = (carried * along2).sum(axis=1) / np.maximum(lengths, np.finfo(float).tiny)
        return np.asarray(cosines)

    def scaled(self, first: float, second: float) -> Self:
        """Return the same in px of images that are smaller by these factors."""
        matrix = np.diag([second, second, 1.0]) @ self.fundamental @ np.diag([first, first, 1.0])
        points = self.points[0] / first, self.points[1] / second
        return replace(self, fundamental=matrix, points=points)


@dataclass(frozen=True)
class HomographyModel:
    """As :class:`EpipolarModel`, of a homography."""

    has_sign: ClassVar[bool] = False
    sample_size: ClassVar[int] = 4
    matrix: Points
    points: tuple[Points, Points]

    def errors(self, rows1: Rows, rows2: Rows) -> Points:
        """Return (M,) px."""
        return affine.homography_errors(self.matrix, self.points[0][rows1], self.points[1][rows2])

    def cosines(self, rows1: Rows, rows2: Rows, shapes: tuple[Points, Points]) -> Points:
        """Return (M,) cosines between what frames carry over and what the geometry does."""
        frames = np.concatenate([shapes[0][rows1], self.points[0][rows1, :, None]], axis=2)
        carried = affine.transform_lafs(self.matrix, frames)[:, :, :2]
        return rotation_cosines(carried, shapes[1][rows2])

    def scaled(self, first: float, second: float) -> Self:
        """Return the same in px of images that are smaller by these factors."""
        matrix = np.diag([1 / second, 1 / second, 1.0]) @ self.matrix @ np.diag([first, first, 1.0])
        points = self.points[0] / first, self.points[1] / second
        return replace(self, matrix=matrix, points=points)


PairModel = EpipolarModel | HomographyModel


def rotation_cosines(shapes1: Points, shapes2: Points) -> Points:
    """Return (N,) cosines of the angles by which frames are turned against others; -1 mirrored."""
    signs = np.sign(affine.determinants(shapes1))[:, None, None]
    turns = shapes2 @ affine.adjugates(shapes1) * signs
    along, across = turns[:, 0, 0] + turns[:, 1, 1], turns[:, 1, 0] - turns[:, 0, 1]
    cosines = along / np.maximum(np.hypot(along, across), np.finfo(float).tiny)
    return np.where(affine.determinants(turns) > 0.0, cosines, -1.0)
