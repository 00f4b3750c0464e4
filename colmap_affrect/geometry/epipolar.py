"""Epipolar geometries and homographies: errors of matches, and consistency of their LAFs.

The LAFs of a right match map the direction of the epipolar line in image 1 to the one in image 2
(Barath, Hajder, Matas). All points are (N, 2) px in the convention of the fundamental matrix F,
with ``x2^T F x1 = 0``. Shapes are the (N, 2, 2) linear parts of LAFs, in the same axes.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from colmap_affrect.geometry import affine
from colmap_affrect.geometry.arrays import Array, Floats, Integers
from colmap_affrect.geometry.two_views import homogeneous

TINY = np.finfo(float).tiny


def epipolar_lines(
    fundamental: Floats, points1: Floats, points2: Floats
) -> tuple[Array, Array]:
    """Return the epipolar lines of matches.

    Args:
        fundamental: (3, 3) F.
        points1: (N, 2) px.
        points2: (N, 2) px.

    Returns:
        (N, 3) lines in image 1 of ``points2``, and (N, 3) lines in image 2 of ``points1``.
    """
    return homogeneous(points2) @ fundamental, homogeneous(points1) @ fundamental.T


def sampson_errors(fundamental: Floats, points1: Floats, points2: Floats) -> Array:
    """Return the distances of matches from an epipolar geometry, to first order (Sampson).

    Args:
        fundamental: (3, 3) F.
        points1: (N, 2) px.
        points2: (N, 2) px.

    Returns:
        (N,) px.
    """
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    products = (lines2[:, :2] * points2).sum(axis=1) + lines2[:, 2]
    squares1 = (lines1[:, :2] ** 2).sum(axis=1)
    squares2 = (lines2[:, :2] ** 2).sum(axis=1)
    lengths = np.sqrt(np.maximum(squares1 + squares2, TINY))
    return np.asarray(np.abs(products) / lengths)


def common_sign(cosines: Floats) -> float:
    """Return the sign, 1 or -1, of most of the cosines of an epipolar geometry."""
    return -1.0 if np.sign(cosines).sum() < 0 else 1.0


@dataclass(frozen=True)
class EpipolarModel:
    """A fundamental matrix, and the points of all features of both images."""

    has_sign: ClassVar[bool] = True
    """Whether cosines share one unknown sign: epipolar lines have no direction."""
    fundamental: Array  # (3, 3)
    points: tuple[Array, Array]  # (N, 2) px
    sample_size: int = 7  # matches that determine it

    def errors(self, rows1: Integers, rows2: Integers) -> Array:
        """Return the distances of matches from the geometry.

        Args:
            rows1: (M,) features of image 1.
            rows2: (M,) features of image 2.

        Returns:
            (M,) px.
        """
        return sampson_errors(
            self.fundamental, self.points[0][rows1], self.points[1][rows2]
        )

    def cosines(
        self, rows1: Integers, rows2: Integers, shapes: tuple[Array, Array]
    ) -> Array:
        """Return how well the LAFs of matches map epipolar lines of image 1 to those of image 2.

        Args:
            rows1: (M,) features of image 1.
            rows2: (M,) features of image 2.
            shapes: (N, 2, 2) of all features of both images.

        Returns:
            (M,) cosines of the angles between mapped lines and epipolar lines, up to one sign.
        """
        points1 = self.points[0][rows1]
        points2 = self.points[1][rows2]
        lines1, lines2 = epipolar_lines(self.fundamental, points1, points2)
        directions1 = np.stack([-lines1[:, 1], lines1[:, 0]], axis=1)
        directions2 = np.stack([-lines2[:, 1], lines2[:, 0]], axis=1)
        inverses1 = affine.adjugates(shapes[0][rows1])
        mapped = np.einsum("nij,njk,nk->ni", shapes[1][rows2], inverses1, directions1)
        products = (mapped * directions2).sum(axis=1)
        lengths = np.linalg.norm(mapped, axis=1) * np.linalg.norm(directions2, axis=1)
        return np.asarray(products / np.maximum(lengths, TINY))

    def scaled(self, first: float, second: float) -> Self:
        """Return the model in px of images that are smaller.

        Args:
            first: px of image 1 for each px of its smaller version.
            second: the same of image 2.

        Returns:
            The same geometry.
        """
        image1_from_smaller = np.diag([first, first, 1.0])
        image2_from_smaller = np.diag([second, second, 1.0])
        fundamental = image2_from_smaller @ self.fundamental @ image1_from_smaller
        points1, points2 = self.points
        return replace(
            self, fundamental=fundamental, points=(points1 / first, points2 / second)
        )


@dataclass(frozen=True)
class HomographyModel:
    """A homography, and the points of all features, with the methods of EpipolarModel."""

    has_sign: ClassVar[bool] = False
    sample_size: ClassVar[int] = 4
    matrix: Array  # (3, 3) image2_from_image1
    points: tuple[Array, Array]  # (N, 2) px

    def errors(self, rows1: Integers, rows2: Integers) -> Array:
        """Return the (M,) distances of matches from the homography, px.

        Args:
            rows1: (M,) features of image 1.
            rows2: (M,) features of image 2.
        """
        return affine.homography_errors(
            self.matrix, self.points[0][rows1], self.points[1][rows2]
        )

    def cosines(
        self, rows1: Integers, rows2: Integers, shapes: tuple[Array, Array]
    ) -> Array:
        """Return how well LAFs of image 1, mapped by the homography, agree with those of image 2.

        Args:
            rows1: (M,) features of image 1.
            rows2: (M,) features of image 2.
            shapes: (N, 2, 2) of all features of both images.

        Returns:
            (M,) cosines of the angles between mapped LAFs and LAFs of image 2.
        """
        points1 = self.points[0][rows1, :, None]
        lafs = np.concatenate([shapes[0][rows1], points1], axis=2)
        mapped = affine.transform_lafs(self.matrix, lafs)[:, :, :2]
        return rotation_cosines(mapped, shapes[1][rows2])

    def scaled(self, first: float, second: float) -> Self:
        """Return the model in px of images that are smaller.

        Args:
            first: px of image 1 for each px of its smaller version.
            second: the same of image 2.

        Returns:
            The same geometry.
        """
        image1_from_smaller = np.diag([first, first, 1.0])
        smaller_from_image2 = np.diag([1 / second, 1 / second, 1.0])
        matrix = smaller_from_image2 @ self.matrix @ image1_from_smaller
        points1, points2 = self.points
        return replace(self, matrix=matrix, points=(points1 / first, points2 / second))


PairModel = EpipolarModel | HomographyModel


def rotation_cosines(shapes1: Array, shapes2: Array) -> Array:
    """Return the (N,) cosines of the rotations between (N, 2, 2) shapes; -1 for mirrored ones."""
    signs = np.sign(affine.determinants(shapes1))[:, None, None]
    maps = shapes2 @ affine.adjugates(shapes1) * signs
    cosine_parts = maps[:, 0, 0] + maps[:, 1, 1]
    sine_parts = maps[:, 1, 0] - maps[:, 0, 1]
    lengths = np.hypot(cosine_parts, sine_parts)
    cosines = cosine_parts / np.maximum(lengths, TINY)
    return np.where(affine.determinants(maps) > 0.0, cosines, -1.0)
