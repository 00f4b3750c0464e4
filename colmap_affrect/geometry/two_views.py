"""Depths of matches of two views, and the scale between depths that are known in one image.

A pose is (R, t) with ``x2 = R x1 + t`` for points in the two camera frames; rays are (N, 2)
normalized image coordinates, the point at depth z being ``z (x, y, 1)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.neighbors import neighbors_within

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Depths:
    """What a relative pose makes of matches.

    Attributes:
        first: (N,) depths in camera 1, in units of the length of the translation.
        second: (N,) depths in camera 2.
        angles_deg: (N,) angles between both rays.
    """

    first: Array
    second: Array
    angles_deg: Array

    @property
    def in_front(self) -> NDArray[np.bool_]:
        """(N,) whether a point is before both cameras."""
        return (self.first > 0) & (self.second > 0)


def triangulated_depths(rotation: Array, translation: Array, rays1: Array, rays2: Array) -> Depths:
    """Triangulate matches: the point where both rays are closest to each other."""
    towards1 = homogeneous(rays1) @ rotation.T
    towards2 = homogeneous(rays2)
    square1, square2 = (towards1**2).sum(axis=1), (towards2**2).sum(axis=1)
    product = (towards1 * towards2).sum(axis=1)
    along1, along2 = towards1 @ translation, towards2 @ translation
    sines = np.linalg.norm(np.cross(towards1, towards2), axis=1)
    determinants = np.maximum(sines**2, np.finfo(float).tiny)
    return Depths(
        (product * along2 - square2 * along1) / determinants,
        (square1 * along2 - product * along1) / determinants,
        np.degrees(np.arctan2(sines, product)),
    )


def homogeneous(points: NDArray[np.floating]) -> Array:
    """Append a column of ones to (N, 2) points."""
    return np.hstack([points, np.ones((len(points), 1))])


def essential_matrix(rotation: Array, translation: Array) -> Array:
    """Return E with ``x2^T E x1 = 0`` for homogeneous rays."""
    x, y, z = translation
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation


@dataclass(frozen=True)
class ScaleEstimate:
    """Ratio of known depths to those of a pair, by places that lie beside each other.

    Attributes:
        scale: known depth divided by depth of the pair.
        num_agreeing: places that agree on it.
        num_ratios: places that have neighbours with known depth.
        error_frac: standard error of the scale.
    """

    scale: float
    num_agreeing: int
    num_ratios: int
    error_frac: float

    @property
    def share(self) -> float:
        """Part of the places that agree."""
        return self.num_agreeing / max(self.num_ratios, 1)


TOLERANCE = 0.08
"""Largest difference of the logarithm of ratios that agree: neighbours are not at one depth."""

NUM_NEIGHBORS = 5
"""Known places looked at beside each place of a pair."""


def scale_between(
    known: tuple[Array, Array], places: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale between two sets of depths in the same image.

    The two have no feature in common, so each depth of the pair is compared with known ones
    near it in the image; the scale is where most logarithms of ratios gather.

    Args:
        known: (K, 2) px and (K,) depths that are known.
        places: (N, 2) px and (N,) depths, all positive, whose scale is wanted.
        radius_px: how far apart two places may be.

    Returns:
        None without neighbours.
    """
    rows, columns, distances = _nearest_known(known[0], places[0], radius_px)
    if not len(rows):
        return None
    ratios = np.log(known[1][columns] / places[1][rows])
    weights = np.exp(-((2 * distances / radius_px) ** 2))
    order = np.argsort(ratios)
    summed = np.concatenate([[0.0], np.cumsum(weights[order])])
    first = np.searchsorted(ratios[order], ratios - TOLERANCE, side="left")
    last = np.searchsorted(ratios[order], ratios + TOLERANCE, side="right")
    center = ratios[np.argmax(summed[last] - summed[first])]
    agreeing = np.abs(ratios - center) <= TOLERANCE
    num_agreeing = len(np.unique(rows[agreeing]))
    spread = float(np.std(ratios[agreeing]))
    return ScaleEstimate(
        float(np.exp(np.average(ratios[agreeing], weights=weights[agreeing]))),
        num_agreeing,
        len(np.unique(rows)),
        spread / np.sqrt(num_agreeing),
    )


def _nearest_known(
    known: Array, places: Array, radius_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return (place, known point, distance) of the ``NUM_NEIGHBORS`` nearest of each place."""
    neighbors = neighbors_within(np.concatenate([places, known]), radius_px)
    rows, columns = neighbors.of(np.arange(len(places)))
    is_known = columns >= len(places)
    rows, columns = rows[is_known], columns[is_known] - len(places)
    distances = np.linalg.norm(places[rows] - known[columns], axis=1)
    order = np.lexsort((distances, rows))
    rows = rows[order]
    rank = np.arange(len(rows)) - np.searchsorted(rows, rows)
    kept = order[rank < NUM_NEIGHBORS]
    return rows[rank < NUM_NEIGHBORS], columns[kept], distances[kept]
