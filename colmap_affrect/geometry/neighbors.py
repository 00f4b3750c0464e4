"""Fixed-radius neighbours of 2-D points through a grid of cells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bools, Floats, Indices


@dataclass(frozen=True)
class NeighborLists:
    """Neighbours of each point, itself included, as compressed rows."""

    starts: Indices  # (N + 1,) int64; the neighbours of i are ``indices[starts[i]:starts[i + 1]]``
    indices: Indices  # int64 indices of points

    def of(self, points: NDArray[np.integer]) -> tuple[Indices, Indices]:
        """Return (rows, neighbours): for each k in order, all neighbours of ``points[k]``."""
        rows, positions = _expand(self.starts[points], self.starts[points + 1])
        return rows, self.indices[positions]


def neighbors_within(points: Floats, radius: float) -> NeighborLists:
    """List, for each of (N, 2) finite points, the points at most ``radius`` away."""
    if not len(points):
        return NeighborLists(np.zeros(1, np.int64), np.zeros(0, np.int64))
    cells = np.floor((points - points.min(axis=0)) / radius).astype(np.int64)
    width = int(cells[:, 0].max()) + 3
    keys = (cells[:, 1] + 1) * width + cells[:, 0] + 1
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    rows, candidates = [], []
    for offset in (-width, 0, width):
        begin = np.searchsorted(ordered, keys + offset - 1, side="left")
        end = np.searchsorted(ordered, keys + offset + 1, side="right")
        row, position = _expand(begin, end)
        rows.append(row)
        candidates.append(order[position])
    row, candidate = np.concatenate(rows), np.concatenate(candidates)
    near = ((points[row] - points[candidate]) ** 2).sum(axis=1) <= radius**2
    row, candidate = row[near], candidate[near]
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(points)))])
    return NeighborLists(starts, candidate[np.argsort(row, kind="stable")])


def without_duplicates(points1: Floats, points2: Floats, radius_px: float) -> Bools:
    """Return whether (M, 2) matches, best first, are not near a better one, kept, at both ends."""
    rows, others = neighbors_within(points1, radius_px).of(np.arange(len(points1)))
    near = ((points2[rows] - points2[others]) ** 2).sum(axis=1) <= radius_px**2
    near &= others < rows
    keep = np.ones(len(points1), dtype=bool)
    for row, other in zip(rows[near], others[near], strict=True):
        if keep[other]:
            keep[row] = False
    return keep


def _expand(begin: NDArray[np.integer], end: NDArray[np.integer]) -> tuple[Indices, Indices]:
    """Return for ranges [begin_k, end_k) the k of each element and the elements."""
    lengths = end - begin
    rows = np.repeat(np.arange(len(begin)), lengths)
    first = np.repeat(begin - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return rows, np.arange(len(rows)) + first
