"""Which matches of a pair confirm each other, before any geometry of the pair is known.

A match of two frames is a local affine map from image 1 to image 2, which roughly carries the right
matches beside it too. So a handful of them can be counted among hundreds of wrong ones.
"""

import numpy as np

from colmap_affrect.geometry.arrays import Array, Floats, Indices

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
