"""Depths of matches of two views, and the scale between depths that are known in one image.

A pose is (R, t) with ``x2 = R x1 + t`` for points in the two camera frames. Rays are (N, 2)
normalized image coordinates: the point at depth z is ``z (x, y, 1)``.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices

MAX_LOG_DIFFERENCE = 0.08
"""Difference of the logarithms of depth ratios that agree; judged: neighbours in the image are not
at one depth."""
NUM_NEIGHBORS = 5  # known depths that are compared with the depth of a match; judged
NUM_ON_PLANE = 12  # known depths to which a plane is fitted; judged
NUM_PLANE_PARAMETERS = 3  # theory
MAX_PLANE_ERROR = 0.04
"""Relative standard deviation of a predicted inverse depth, and of those a plane is fitted to;
half of ``MAX_LOG_DIFFERENCE``."""
# Added to normal equations, which twelve points on a line leave singular; numeric
PLANE_DAMPING = 1e-9
NUM_INDEPENDENT = 10
"""Ratios that make the scale more certain, at most: all share the errors of the same poses; so
many, too, must agree with the scale of a bridge (judged)."""


@dataclass(frozen=True)
class Depths:
    """Triangulated depths of the matches of two views."""

    first: Array  # (N,) depths in camera 1, in units of the length of the translation
    second: Array  # (N,) depths in camera 2
    angles_deg: Array  # (N,) triangulation angles

    @property
    def in_front(self) -> Bools:
        """(N,) whether a point is in front of both cameras."""
        return (self.first > 0) & (self.second > 0)


def triangulated_depths(
    rotation: Array, translation: Array, rays1: Array, rays2: Array
) -> Depths:
    """Triangulate matches: the points on both rays that are closest to each other.

    Args:
        rotation: (3, 3) R.
        translation: (3,) t.
        rays1: (N, 2) normalized coordinates in image 1.
        rays2: (N, 2) normalized coordinates in image 2.

    Returns:
        The depths of both points.
    """
    directions1 = homogeneous(rays1) @ rotation.T
    directions2 = homogeneous(rays2)
    squares1 = (directions1**2).sum(axis=1)
    squares2 = (directions2**2).sum(axis=1)
    products = (directions1 * directions2).sum(axis=1)
    along1 = directions1 @ translation
    along2 = directions2 @ translation
    sines = np.linalg.norm(_cross(directions1, directions2), axis=1)
    determinants = np.maximum(sines**2, np.finfo(float).tiny)
    return Depths(
        first=(products * along2 - squares2 * along1) / determinants,
        second=(squares1 * along2 - products * along1) / determinants,
        angles_deg=np.degrees(np.arctan2(sines, products)),
    )


def _cross(first: Array, second: Array) -> Array:
    """Return the cross products of (N, 3) vectors: ``np.cross`` takes twice as long for few."""
    x1, y1, z1 = first.T
    x2, y2, z2 = second.T
    return np.stack([y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2], axis=1)


def homogeneous(points: Floats) -> Array:
    """Append a column of ones to (N, 2) points."""
    return np.hstack([points, np.ones((len(points), 1))])


def essential_matrix(rotation: Array, translation: Array) -> Array:
    """Return E with ``x2^T E x1 = 0`` for homogeneous rays."""
    return cross_product_matrix(translation) @ rotation


def cross_product_matrix(vector: Array) -> Array:
    """Return the (3, 3) matrix that maps others to the cross product of a (3,) vector with them."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True)
class ScaleEstimate:
    """Ratio of known depths to the depths of a pair, at neighbouring positions."""

    scale: float  # known depth divided by depth of the pair
    num_agreeing: int  # positions whose ratio agrees with the scale
    num_ratios: int  # positions that have neighbours of known depth
    error_frac: float  # standard error of the scale, as a share of it

    @property
    def share(self) -> float:
        """Share of the positions that agree."""
        return self.num_agreeing / max(self.num_ratios, 1)


def scale_between(
    known: tuple[Array, Array], observed: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale between two sets of positive depths in one image.

    They have no feature in common, so each depth is compared with known ones beside it. Most
    logarithms of ratios gather at the scale.

    Args:
        known: (K, 2) px and (K,) known depths.
        observed: (N, 2) px and (N,) depths of a pair.
        radius_px: distance up to which depths are compared.

    Returns:
        The scale; None without any known depth within the radius.
    """
    known_points, known_depths = known
    points, depths = observed
    neighbors = _nearest_known(
        known=known_points,
        points=points,
        radius_px=radius_px,
        count=NUM_NEIGHBORS,
    )
    log_ratios = np.log(known_depths[neighbors.known] / depths[neighbors.rows])
    weights = np.exp(-((2 * neighbors.distances / radius_px) ** 2))
    return _densest_scale(neighbors.rows, log_ratios, weights)


def scale_by_planes(
    known: tuple[Array, Array], observed: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale as :func:`scale_between`, where no known depth lies beside a position.

    The inverse depth of a plane is an affine function of the pixel. It is fitted to the
    ``NUM_ON_PLANE`` known depths nearest to each position; where it fits, it predicts the depth.

    Args:
        known: (K, 2) px and (K,) known depths.
        observed: (N, 2) px and (N,) depths of a pair.
        radius_px: distance up to which known depths count.

    Returns:
        The scale; None without any plane.
    """
    known_points, known_depths = known
    points, depths = observed
    neighbors = _nearest_known(
        known=known_points,
        points=points,
        radius_px=radius_px,
        count=NUM_ON_PLANE,
    )
    counts = np.bincount(neighbors.rows, minlength=len(points))
    rows = np.flatnonzero(counts == NUM_ON_PLANE)
    chosen = neighbors.known[np.isin(neighbors.rows, rows)].reshape(-1, NUM_ON_PLANE)
    offsets = (known_points[chosen] - points[rows, None]) / radius_px
    system = np.concatenate([np.ones((*chosen.shape, 1)), offsets], axis=2)
    transposed = system.transpose(0, 2, 1)
    inverse_depths = 1.0 / known_depths[chosen]
    normal_matrices = transposed @ system + PLANE_DAMPING * np.eye(NUM_PLANE_PARAMETERS)
    planes = np.linalg.solve(normal_matrices, transposed @ inverse_depths[..., None])
    residuals = inverse_depths - (system @ planes)[..., 0]
    variances = (residuals**2).sum(axis=1) / (NUM_ON_PLANE - NUM_PLANE_PARAMETERS)
    predicted = planes[:, 0, 0]
    errors = np.sqrt(variances * np.linalg.inv(normal_matrices)[:, 0, 0])
    largest_errors = np.maximum(errors, np.sqrt(variances))
    is_certain = (predicted > 0) & (largest_errors < MAX_PLANE_ERROR * predicted)
    rows = rows[is_certain]
    log_ratios = -np.log(predicted[is_certain] * depths[rows])
    return _densest_scale(rows, log_ratios, np.ones(len(log_ratios)))


def _densest_scale(
    rows: Indices, log_ratios: Array, weights: Array
) -> ScaleEstimate | None:
    """Return the scale with most weight of ratios around it.

    Args:
        rows: (M,) position that each ratio is of.
        log_ratios: (M,) logarithms of known depths over depths.
        weights: (M,) of the ratios.

    Returns:
        The scale; None without any ratio.
    """
    if not len(log_ratios):
        return None
    order = np.argsort(log_ratios)
    ordered = log_ratios[order]
    summed = np.concatenate([[0.0], np.cumsum(weights[order])])
    first = np.searchsorted(ordered, log_ratios - MAX_LOG_DIFFERENCE, side="left")
    last = np.searchsorted(ordered, log_ratios + MAX_LOG_DIFFERENCE, side="right")
    center = log_ratios[np.argmax(summed[last] - summed[first])]
    is_agreeing = np.abs(log_ratios - center) <= MAX_LOG_DIFFERENCE
    agreeing = log_ratios[is_agreeing]
    num_agreeing = len(np.unique(rows[is_agreeing]))
    num_independent = min(num_agreeing, NUM_INDEPENDENT)
    return ScaleEstimate(
        scale=float(np.exp(np.average(agreeing, weights=weights[is_agreeing]))),
        num_agreeing=num_agreeing,
        num_ratios=len(np.unique(rows)),
        error_frac=float(np.std(agreeing) / np.sqrt(num_independent)),
    )


@dataclass(frozen=True)
class _KnownNeighbors:
    """Positions and the known points near them, one of each in M pairs."""

    rows: Indices  # (M,) positions
    known: Indices  # (M,) known points
    distances: Array  # (M,) px


def _nearest_known(
    known: Array, points: Array, radius_px: float, count: int
) -> _KnownNeighbors:
    """Find the ``count`` known points that are nearest to each of (N, 2) points, in a radius."""
    if not len(known) or not len(points):
        nothing = np.zeros(0, np.int64)
        return _KnownNeighbors(nothing, nothing, np.zeros(0))
    distances, columns = cv2.batchDistance(
        points.astype(np.float32),
        known.astype(np.float32),
        cv2.CV_32F,
        K=min(count, len(known)),
    )
    is_near = distances <= radius_px
    rows, _ = np.nonzero(is_near)
    nearest = columns[is_near].astype(np.int64)
    return _KnownNeighbors(rows, nearest, distances[is_near].astype(np.float64))
