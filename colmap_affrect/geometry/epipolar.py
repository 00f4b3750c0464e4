"""Epipolar geometry of two views, and what local affine frames say about it.

A match of two frames must carry the direction of the epipolar line in image 1 to the one in image 2
(Barath, Hajder, Matas: epipolar geometry from affine correspondences). All points are (N, 2) px of
any one convention, the one of the fundamental matrix F with ``x2^T F x1 = 0``; shapes are the
(N, 2, 2) linear parts of frames, in the same axes.
"""

import numpy as np

from colmap_affrect.geometry.affine import adjugates
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.two_views import homogeneous


def epipolar_lines(fundamental: Floats, points1: Floats, points2: Floats) -> tuple[Array, Array]:
    """Return (N, 3) lines in image 1 of ``points2``, and in image 2 of ``points1``."""
    return homogeneous(points2) @ fundamental, homogeneous(points1) @ fundamental.T


def sampson_errors(fundamental: Floats, points1: Floats, points2: Floats) -> Array:
    """Return (N,) distances of matches from an epipolar geometry, px, to first order."""
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    products = (lines2[:, :2] * points2).sum(axis=1) + lines2[:, 2]
    squares = (lines1[:, :2] ** 2).sum(axis=1) + (lines2[:, :2] ** 2).sum(axis=1)
    return np.asarray(np.abs(products) / np.sqrt(np.maximum(squares, np.finfo(float).tiny)))


def direction_cosines(
    fundamental: Floats, points1: Floats, points2: Floats, shapes1: Floats, shapes2: Floats
) -> Array:
    """Return (N,) cosines between epipolar directions of image 2 and those that frames carry over.

    Up to one sign for all right matches of a pair (:func:`common_sign`): lines have no direction.
    """
    lines1, lines2 = epipolar_lines(fundamental, points1, points2)
    along1 = np.stack([-lines1[:, 1], lines1[:, 0]], axis=1)
    along2 = np.stack([-lines2[:, 1], lines2[:, 0]], axis=1)
    carried = np.einsum("nij,njk,nk->ni", shapes2, adjugates(shapes1), along1)
    lengths = np.linalg.norm(carried, axis=1) * np.linalg.norm(along2, axis=1)
    return np.asarray((carried * along2).sum(axis=1) / np.maximum(lengths, np.finfo(float).tiny))


def common_sign(cosines: Floats) -> float:
    """Return the sign, 1 or -1, that most of the :func:`direction_cosines` of a pair have."""
    return -1.0 if np.sign(cosines).sum() < 0 else 1.0
