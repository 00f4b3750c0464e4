"""Neighbouring points, found by a grid of cells, and matches that their neighbours support.

The LAFs of a match make a local affine map from image 1 to image 2, which roughly maps the right
matches beside it too. So a handful of right matches can be counted among hundreds of wrong ones.
"""

from dataclasses import dataclass

import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices, Integers

# Nearest matches in each image that may support one; judged on photographs
NUM_NEIGHBORS = 8
MIN_SUPPORTING = 2
"""Neighbours that must support a match in both images; judged: one supports some wrong matches,
two hardly any."""
MAX_RELATIVE_ERROR = 0.5
"""Error of a supporting neighbour's mapped position, as a share of its distance; judged."""
MIN_DISTANCE_PX = 4.0
"""Distance of a neighbour in both images. Nearer matches are of the same point, in several
orientations or warps; judged."""
# Matches that are compared with all others at a time, which bounds memory; resource
CHUNK_ROWS = 512


def num_consistent_matches(lafs1: Floats, lafs2: Floats) -> int:
    """Return how many of (M, 2, 3) matched LAFs their neighbours in both images support."""
    if len(lafs1) <= MIN_SUPPORTING:
        return 0
    shapes1 = lafs1[:, :, :2].astype(np.float64)
    shapes2 = lafs2[:, :, :2].astype(np.float64)
    points1 = lafs1[:, :, 2].astype(np.float64)
    points2 = lafs2[:, :, 2].astype(np.float64)
    forward = _num_supporting(points1, points2, shapes2 @ np.linalg.inv(shapes1))
    backward = _num_supporting(points2, points1, shapes1 @ np.linalg.inv(shapes2))
    is_consistent = np.minimum(forward, backward) >= MIN_SUPPORTING
    return int(np.count_nonzero(is_consistent))


def _num_supporting(points1: Array, points2: Array, maps: Array) -> Indices:
    """Count the neighbours in image 1 that the local map of each match maps near enough.

    Args:
        points1: (M, 2) px.
        points2: (M, 2) px.
        maps: (M, 2, 2) linear maps from image 1 to image 2.

    Returns:
        (M,) counts.
    """
    num_neighbors = min(NUM_NEIGHBORS, len(points1) - 1)
    num_supporting = np.zeros(len(points1), np.int64)
    for begin in range(0, len(points1), CHUNK_ROWS):
        rows = np.arange(begin, min(begin + CHUNK_ROWS, len(points1)))
        distances1 = _distances(points1, rows)
        distances = np.minimum(distances1, _distances(points2, rows))
        distances1[distances < MIN_DISTANCE_PX] = np.inf  # the match itself, too
        nearest = np.argpartition(distances1, num_neighbors - 1, axis=1)[
            :, :num_neighbors
        ]
        is_neighbor = np.isfinite(np.take_along_axis(distances1, nearest, axis=1))
        offsets1 = points1[nearest] - points1[rows, None]
        offsets2 = points2[nearest] - points2[rows, None]
        mapped = np.einsum("nij,nkj->nki", maps[rows], offsets1)
        errors = np.linalg.norm(mapped - offsets2, axis=2)
        is_near = errors < MAX_RELATIVE_ERROR * np.linalg.norm(mapped, axis=2)
        num_supporting[rows] = np.count_nonzero(is_near & is_neighbor, axis=1)
    return num_supporting


def _distances(points: Array, rows: Indices) -> Array:
    """Return the (R, M) distances of some of (M, 2) points from all, faster than ``norm`` does."""
    horizontal = points[rows, None, 0] - points[:, 0]
    vertical = points[rows, None, 1] - points[:, 1]
    return np.asarray(np.sqrt(horizontal * horizontal + vertical * vertical))


@dataclass(frozen=True)
class NeighborLists:
    """Neighbours of each point, itself included, as compressed rows."""

    # (N + 1,): the neighbours of i are ``indices[starts[i]:starts[i + 1]]``
    starts: Indices
    indices: Indices  # points

    def of(self, points: Integers) -> tuple[Indices, Indices]:
        """Return (rows, neighbours): for each k in order, all neighbours of ``points[k]``."""
        rows, positions = _expand_ranges(self.starts[points], self.starts[points + 1])
        return rows, self.indices[positions]


def neighbors_within(points: Floats, radius: float) -> NeighborLists:
    """List the points at most ``radius`` away from each of (N, 2) finite points.

    Cells of the size of the radius are numbered row by row, and points sorted by cell. Candidates
    of a point are then three ranges: three cells of its own row, and of those above and below.
    """
    if not len(points):
        return NeighborLists(np.zeros(1, np.int64), np.zeros(0, np.int64))
    cells = np.floor((points - points.min(axis=0)) / radius).astype(np.int64)
    num_columns = int(cells[:, 0].max()) + 3  # an empty column on each side
    keys = (cells[:, 1] + 1) * num_columns + cells[:, 0] + 1
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    row_parts = []
    candidate_parts = []
    for offset in (-num_columns, 0, num_columns):
        begin = np.searchsorted(sorted_keys, keys + offset - 1, side="left")
        end = np.searchsorted(sorted_keys, keys + offset + 1, side="right")
        row_part, positions = _expand_ranges(begin, end)
        row_parts.append(row_part)
        candidate_parts.append(order[positions])
    rows = np.concatenate(row_parts)
    candidates = np.concatenate(candidate_parts)
    squares = ((points[rows] - points[candidates]) ** 2).sum(axis=1)
    is_near = squares <= radius**2
    rows = rows[is_near]
    candidates = candidates[is_near]
    ends = np.cumsum(np.bincount(rows, minlength=len(points)))
    starts = np.concatenate([[0], ends])
    return NeighborLists(starts, candidates[np.argsort(rows, kind="stable")])


def without_duplicates(points1: Floats, points2: Floats, radius_px: float) -> Bools:
    """Return which matches are not near a better match that stays, in both images.

    Args:
        points1: (M, 2) px of matches in image 1, the best first.
        points2: (M, 2) px of them in image 2.
        radius_px: distance up to which they are duplicates.

    Returns:
        (M,) bool.
    """
    rows, others = neighbors_within(points1, radius_px).of(np.arange(len(points1)))
    squares2 = ((points2[rows] - points2[others]) ** 2).sum(axis=1)
    is_duplicate = (squares2 <= radius_px**2) & (rows < others)
    better = rows[is_duplicate]  # which rise
    worse = others[is_duplicate]
    starts = np.searchsorted(better, np.arange(len(points1) + 1))
    keep = np.ones(len(points1), dtype=bool)
    for row in np.unique(better):
        if keep[row]:
            keep[worse[starts[row] : starts[row + 1]]] = False
    return keep


def _expand_ranges(begin: Integers, end: Integers) -> tuple[Indices, Indices]:
    """Return the elements of ranges [begin_k, end_k), and before them the k of each."""
    lengths = end - begin
    rows = np.repeat(np.arange(len(begin)), lengths)
    num_before = np.concatenate([[0], np.cumsum(lengths)[:-1]])
    shifts = np.repeat(begin - num_before, lengths)
    return rows, np.arange(len(rows)) + shifts
