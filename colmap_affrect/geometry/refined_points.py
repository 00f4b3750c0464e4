"""Points that many views see, moved to where their errors are smallest; the views stay.

Each point is refined by itself, all of them at once, by steps of Levenberg and Marquardt on robust
errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Indices

MAX_ITERATIONS = 20
MIN_DECREASE = 1e-5  # of the cost of a point, in a step after which it is left where it is
FIRST_DAMPING = 1e-4  # of the diagonal of the normal equations
DAMPING_FACTOR = 10.0  # less after a step that helps, more after one that does not
MIN_CURVATURE = 1e-12  # of the largest: along parallel rays a point is held by nothing
MIN_DEPTH = 1e-6  # in front of a view, of the distance between a point and the view


@dataclass(frozen=True)
class Observations:
    """What views see of points, sorted by point; each point has one observation at least."""

    points: Indices  # (O,) rows of the points
    rotations: Array  # (O, 3, 3) of views, from the world
    translations: Array  # (O, 3) of views, from the world
    rays: Array  # (O, 2) normalized image coordinates at which a point is seen
    px_per_ray: Array  # (O, 2, 2) derivatives of px by normalized image coordinates, at these

    def of(self, chosen: Bools) -> Self:
        """Return those of chosen points, (P,), with the rows that these have among themselves."""
        kept = chosen[self.points]
        rows = np.cumsum(chosen) - 1
        return type(self)(
            rows[self.points[kept]],
            self.rotations[kept],
            self.translations[kept],
            self.rays[kept],
            self.px_per_ray[kept],
        )

    @property
    def starts(self) -> Indices:
        """(P,) index of the first observation of each point."""
        return np.flatnonzero(np.diff(self.points, prepend=-1))

    def in_views(self, points: Array) -> Array:
        """Return points, (P, 3), in the coordinates of the views that see them, (O, 3)."""
        own = points[self.points]
        turned: Array = np.einsum("oij,oj->oi", self.rotations, own)
        return turned + self.translations

    def errors(self, inside: Array) -> Array:
        """Return the errors in px, (O, 2), of points in the coordinates of views, (O, 3)."""
        difference: Array = inside[:, :2] / inside[:, 2:] - self.rays
        return np.asarray(np.einsum("oij,oj->oi", self.px_per_ray, difference))

    def derivatives(self, inside: Array) -> Array:
        """Return the derivatives, (O, 2, 3), of the errors by the places of the points."""
        depths = inside[:, 2]
        of_ray = np.zeros((len(inside), 2, 3))
        of_ray[:, 0, 0] = 1.0 / depths
        of_ray[:, 1, 1] = 1.0 / depths
        of_ray[:, :, 2] = -inside[:, :2] / depths[:, None] ** 2
        return np.asarray(self.px_per_ray @ of_ray @ self.rotations)


def refined_points(points: Array, seen: Observations, noise_px: float) -> Array:
    """Return points where the robust errors of all that is seen of them are smallest.

    Args:
        points: (P, 3) places in the world, to begin with.
        seen: What is seen of them, of each at least once.
        noise_px: Scale of Cauchy's loss; what is not finite in ``seen`` keeps its point in place.

    Returns:
        (P, 3) places, none with a larger cost than before, nor behind a view that it was in front
        of.
    """
    found = points.copy()
    with np.errstate(all="ignore"):  # of points in the plane of a camera
        costs = _costs(found, seen, noise_px)
        moving = np.isfinite(costs)
        dampings = np.full(len(points), FIRST_DAMPING)
        for _ in range(MAX_ITERATIONS):
            if not moving.any():
                break
            own = seen.of(moving)
            moved = found[moving] + _steps(found[moving], own, dampings[moving], noise_px)
            before, after = costs[moving], _costs(moved, own, noise_px)
            is_better = after < before
            rows = np.flatnonzero(moving)
            found[rows[is_better]] = moved[is_better]
            costs[rows[is_better]] = after[is_better]
            dampings[rows] *= np.where(is_better, 1.0 / DAMPING_FACTOR, DAMPING_FACTOR)
            moving[rows[is_better & (before - after <= MIN_DECREASE * before)]] = False
    return found


def _costs(points: Array, seen: Observations, noise_px: float) -> Array:
    """Return the cost of each point, (P,), infinite behind a view that sees it."""
    inside = seen.in_views(points)
    squares = (seen.errors(inside) ** 2).sum(axis=1)
    costs = np.log1p(squares / noise_px**2)
    is_behind = inside[:, 2] <= MIN_DEPTH * np.linalg.norm(inside, axis=1)
    costs[is_behind | ~np.isfinite(costs)] = np.inf
    return np.asarray(np.add.reduceat(costs, seen.starts))


def _steps(points: Array, seen: Observations, dampings: Array, noise_px: float) -> Array:
    """Return a step of each point, (P, 3), for which weights of the robust loss are held."""
    inside = seen.in_views(points)
    errors, derivatives = seen.errors(inside), seen.derivatives(inside)
    weights = 1.0 / (1.0 + (errors**2).sum(axis=1) / noise_px**2)
    weighted = derivatives * weights[:, None, None]
    normal = np.add.reduceat(weighted.transpose(0, 2, 1) @ derivatives, seen.starts)
    slopes = np.add.reduceat(np.einsum("oij,oi->oj", weighted, errors), seen.starts)
    diagonal = np.einsum("pii->pi", normal)  # a view into it
    smallest = MIN_CURVATURE * diagonal.sum(axis=1, keepdims=True)
    diagonal *= 1.0 + dampings[:, None]
    diagonal += smallest
    return -np.asarray(np.linalg.solve(normal, slopes[..., None])[..., 0])
