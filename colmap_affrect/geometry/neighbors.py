"""Points near each other, by a grid of cells, and matches that confirm each other.

A match of two frames is a local affine map from image 1 to image 2, which roughly carries the right
matches beside it too. So a handful of them can be counted among hundreds of wrong ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices

NUM_NEIGHBORS = 8  # matches nearest to one in image 1, and in image 2, that may confirm it
NUM_CONFIRMING = 2  # must do so, in both images: one does for some wrong matches, two hardly
MAX_RELATIVE_ERROR = 0.5  # of a neighbour's place by the map, in distances of the two matches
MIN_DISTANCE_PX = 4.0  # nearer matches are those of one place, in several orientations or warps
ROWS_AT_ONCE = 512  # matches that are compared with all others at a time, which bounds memory


def num_consistent_matches(frames1: Floats, frames2: Floats) -> int:
    """Return how many of (M, 2, 3) matched frames their neighbours in both images confirm."""
    if len(frames1) <= NUM_CONFIRMING:
        return 0
    shapes1, shapes2 = (frames[:, :, :2].astype(np.float64) for frames in (frames1, frames2))
    points1, points2 = (frames[:, :, 2].astype(np.float64) for frames in (frames1, frames2))
    forth = _num_confirming(points1, points2, shapes2 @ np.linalg.inv(shapes1))
    back = _num_confirming(points2, points1, shapes1 @ np.linalg.inv(shapes2))
    return int(np.count_nonzero(np.minimum(forth, back) >= NUM_CONFIRMING))


def _num_confirming(points1: Array, points2: Array, maps: Array) -> Indices:
    """Count, for each match, the neighbours in image 1 that its (2, 2) map carries near enough."""
    count = min(NUM_NEIGHBORS, len(points1) - 1)
    confirming = np.zeros(len(points1), np.int64)
    for begin in range(0, len(points1), ROWS_AT_ONCE):
        rows = np.arange(begin, min(begin + ROWS_AT_ONCE, len(points1)))
        distances = np.minimum(*(_distances(points, rows) for points in (points1, points2)))
        in_first = _distances(points1, rows)
        in_first[distances < MIN_DISTANCE_PX] = np.inf  # also the match itself
        nearest = np.argpartition(in_first, count - 1, axis=1)[:, :count]
        is_other = np.isfinite(np.take_along_axis(in_first, nearest, axis=1))
        offsets1 = points1[nearest] - points1[rows, None]
        offsets2 = points2[nearest] - points2[rows, None]
        carried = np.einsum("nij,nkj->nki", maps[rows], offsets1)
        errors = np.linalg.norm(carried - offsets2, axis=2)
        is_near = errors < MAX_RELATIVE_ERROR * np.linalg.norm(carried, axis=2)
        confirming[rows] = np.count_nonzero(is_near & is_other, axis=1)
    return confirming


def _distances(points: Array, rows: Indices) -> Array:
    return np.asarray(np.linalg.norm(points[rows, None] - points, axis=2))


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
    near &= rows < others
    better, worse = rows[near], others[near]  # ``better`` rises
    starts = np.searchsorted(better, np.arange(len(points1) + 1))
    keep = np.ones(len(points1), dtype=bool)
    for row in np.unique(better):
        if keep[row]:
            keep[worse[starts[row] : starts[row + 1]]] = False
    return keep


def _expand(begin: NDArray[np.integer], end: NDArray[np.integer]) -> tuple[Indices, Indices]:
    """Return for ranges [begin_k, end_k) the k of each element and the elements."""
    lengths = end - begin
    rows = np.repeat(np.arange(len(begin)), lengths)
    first = np.repeat(begin - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return rows, np.arange(len(rows)) + first
