"""Epipolar geometry of two views, and what local affine frames say about it.

A match of two frames gives the local affine map from image 1 to image 2. It must carry the
direction of the epipolar line in image 1 to the one in image 2 (Barath, Hajder, Matas: epipolar
geometry from affine correspondences): one more check of a match, which the positions do not make.

All points are (N, 2) px of any one convention, the one of the fundamental matrix F with
``x2^T F x1 = 0``; shapes are the (N, 2, 2) linear parts of frames, in the same axes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.two_views import homogeneous

Array = NDArray[np.float64]


def epipolar_lines(
    fundamental: NDArray[np.floating], points1: NDArray[np.floating], points2: NDArray[np.floating]
) -> tuple[Array, Array]:
    """Return (N, 3) lines in image 1 of ``points2``, and in image 2 of ``points1``."""
    return homogeneous(points2) @ fundamental, homogeneous(points1) @ fundamental.T


def sampson_errors(
    fundamental: NDArray[np.floating], points1: NDArray[np.floating], points2: NDArray[np.floating]
) -> Array:
    """Return (N,) distances of matches from an epipolar geometry, px, to first order."""
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    products = (lines2[:, :2] * points2).sum(axis=1) + lines2[:, 2]
    squares = (lines1[:, :2] ** 2).sum(axis=1) + (lines2[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs(products) / np.sqrt(np.maximum(squares, np.finfo(float).tiny)))


def direction_cosines(
    fundamental: NDArray[np.floating],
    points1: NDArray[np.floating],
    points2: NDArray[np.floating],
    shapes1: NDArray[np.floating],
    shapes2: NDArray[np.floating],
) -> Array:
    """Compare the epipolar direction of image 2 with that of image 1, carried over by the frames.

    Returns:
        (N,) cosines of the angle between both. Lines have no direction, so that all signs may be
        turned; they are the same for all right matches of a pair (see :func:`common_sign`).
    """
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    along1 = np.stack([-lines1[:, 1], lines1[:, 0]], axis=1)
    along2 = np.stack([-lines2[:, 1], lines2[:, 0]], axis=1)
    # the inverse of a matrix with positive determinant, up to a factor: its adjugate
    adjugates = np.empty(shapes1.shape)
    adjugates[:, 0, 0], adjugates[:, 1, 1] = shapes1[:, 1, 1], shapes1[:, 0, 0]
    adjugates[:, 0, 1], adjugates[:, 1, 0] = -shapes1[:, 0, 1], -shapes1[:, 1, 0]
    carried = np.einsum("nij,njk,nk->ni", shapes2, adjugates, along1)
    lengths = np.linalg.norm(carried, axis=1) * np.linalg.norm(along2, axis=1)
    return np.asarray((carried * along2).sum(axis=1) / np.maximum(lengths, np.finfo(float).tiny))


def common_sign(cosines: NDArray[np.floating]) -> float:
    """Return the sign, 1 or -1, that most of the :func:`direction_cosines` of a pair have."""
    return -1.0 if np.sign(cosines).sum() < 0 else 1.0
