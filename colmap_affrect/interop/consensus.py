"""Which places agree with each other, where some of them may be wrong."""

import itertools
import math

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array, Bools

MAX_NUM_TRIPLES = 500  # similarities that are tried, each by three places; resource
# Times the median residual: beyond is no error of measuring any more; theory
GROSS = 5.0
# Few places fit too well by chance, of which the median says too little; theory
SMALL_SAMPLE = 5.0
# Times how far three places spread is the fourth, if these alone tell it; judged
FAR_BEYOND = 10.0


def residuals(new_from_old: pycolmap.Sim3d, before: Array, after: Array) -> Array:
    """Return how far points are from where a similarity moves them.

    Args:
        new_from_old: the similarity.
        before: (N, 3) points that it moves.
        after: (N, 3) points where they should be.

    Returns:
        (N,) distances, in the unit of ``after``.
    """
    moved = np.array([new_from_old * point for point in before])
    return np.asarray(np.linalg.norm(moved - after, axis=1))


def similarity(before: Array, after: Array) -> pycolmap.Sim3d | None:
    """Return the similarity that moves points to others, None where they lie on one line.

    pycolmap finds none for points in a plane through the origin, as places of one height often
    are: so both are moved out of such planes first.

    Args:
        before: (N, 3) points.
        after: (N, 3) where they should be.

    Returns:
        The similarity of least squares (Umeyama, PAMI 1991), after from before.
    """
    offset_before = _offset_out_of_plane(before)
    offset_after = _offset_out_of_plane(after)
    found = pycolmap.estimate_sim3d(before + offset_before, after + offset_after)
    if found is None:
        return None
    turn = pycolmap.Rotation3d()
    moved_before = pycolmap.Sim3d(1.0, turn, offset_before)
    moved_back = pycolmap.Sim3d(1.0, turn, -offset_after)
    return moved_back * found * moved_before


def _offset_out_of_plane(points: Array) -> Array:
    """Return a (3,) offset after which no plane through the origin is near to points."""
    middle = points.mean(axis=0)
    _, sizes, directions = np.linalg.svd(points - middle)
    size = sizes[0] / math.sqrt(len(points)) or 1.0
    return np.asarray(directions[2] * size - middle)


def agreeing(before: Array, after: Array, floor: float) -> Bools:
    """Return which places one similarity moves to where they should be, (N,).

    The similarity with the smallest median residual counts, so that up to half of the places may be
    wrong; but one more than the three that give it must agree. Of four places, where there is
    none, one may be wrong that is far beyond the others. Of three and fewer all agree.

    Args:
        before: (N, 3) places in a model.
        after: (N, 3) where they should be.
        floor: a residual up to which a place agrees in any case, in the unit of ``after``.
    """
    count = len(before)
    agree = np.ones(count, np.bool_)
    if count < 4:
        return agree
    rank = 2 if count == 4 else max(count // 2, 3)  # of the residual that counts
    best = np.full(count, np.inf)
    for triple in _triples(count):
        found = similarity(before[triple], after[triple])
        if found is None:
            continue
        off = residuals(found, before, after)
        if np.isfinite(off).all() and np.sort(off)[rank] < np.sort(best)[rank]:
            best = off
    median = float(np.sort(best)[rank])
    if not math.isfinite(median):
        return agree
    if count == 4:
        three = after[np.argsort(best)[:3]]
        floor = max(floor, FAR_BEYOND * float(np.ptp(three, axis=0).max()))
    most = max(floor, GROSS * median * (1.0 + SMALL_SAMPLE / (count - 3)))
    return np.asarray(best <= most)


def _triples(count: int) -> list[list[int]]:
    """Return triples of different numbers below ``count``: all, or as many by chance."""
    if math.comb(count, 3) <= MAX_NUM_TRIPLES:
        return list(map(list, itertools.combinations(range(count), 3)))
    rng = np.random.default_rng(0)
    return [
        rng.choice(count, 3, replace=False).tolist() for _ in range(MAX_NUM_TRIPLES)
    ]
