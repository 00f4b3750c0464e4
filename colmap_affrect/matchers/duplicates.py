"""Matches that several features found at one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.neighbors import neighbors_within


def without_duplicates(
    points1: NDArray[np.floating], points2: NDArray[np.floating], radius_px: float
) -> NDArray[np.bool_]:
    """Tell which of (M, 2) matching points, the best first, to keep.

    Those within ``radius_px`` of a better one that is kept, at both ends, go.
    """
    rows, others = neighbors_within(points1, radius_px).of(np.arange(len(points1)))
    near = ((points2[rows] - points2[others]) ** 2).sum(axis=1) <= radius_px**2
    near &= others < rows
    keep = np.ones(len(points1), dtype=bool)
    for row, other in zip(rows[near], others[near], strict=True):
        if keep[other]:
            keep[row] = False
    return keep
