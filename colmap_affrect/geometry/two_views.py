"""Depths of matches of two views, and the scale between depths that are known in one image.

A pose is (R, t) with ``x2 = R x1 + t`` for points in the two camera frames; rays are (N, 2)
normalized image coordinates, the point at depth z being ``z (x, y, 1)``.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices


@dataclass(frozen=True)
class Depths:
    """What a relative pose makes of matches."""

    first: Array  # (N,) depths in camera 1, in units of the length of the translation
    second: Array  # (N,) depths in camera 2
    angles_deg: Array  # (N,) angles between both rays

    @property
    def in_front(self) -> Bools:
        """(N,) whether a point is before both cameras."""
        return (self.first > 0) & (self.second > 0)


def triangulated_depths(rotation: Array, translation: Array, rays1: Array, rays2: Array) -> Depths:
    """Triangulate matches: the point where both rays are closest to each other."""
    towards1 = homogeneous(rays1) @ rotation.T
    towards2 = homogeneous(rays2)
    square1, square2 = (towards1**2).sum(axis=1), (towards2**2).sum(axis=1)
    product = (towards1 * towards2).sum(axis=1)
    along1, along2 = towards1 @ translation, towards2 @ translation
    sines = np.linalg.norm(_cross(towards1, towards2), axis=1)
    determinants = np.maximum(sines**2, np.finfo(float).tiny)
    return Depths(
        (product * along2 - square2 * along1) / determinants,
        (square1 * along2 - product * along1) / determinants,
        np.degrees(np.arctan2(sines, product)),
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
    x, y, z = translation
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation


@dataclass(frozen=True)
class ScaleEstimate:
    """Ratio of known depths to those of a pair, by places that lie beside each other."""

    scale: float  # known depth divided by depth of the pair
    num_agreeing: int  # places that agree on it
    num_ratios: int  # places that have neighbours with known depth
    error_frac: float  # standard error of the scale

    @property
    def share(self) -> float:
        """Part of the places that agree."""
        return self.num_agreeing / max(self.num_ratios, 1)


TOLERANCE = 0.08  # of logarithms of ratios that agree: neighbours are not at one depth
NUM_NEIGHBORS = 5  # known places looked at beside each place of a pair
NUM_ON_PLANE = 12  # known places to which a plane is fitted
MAX_PLANE_ERROR = 0.04  # relative, of a predicted inverse depth and of those it is fitted to
NUM_INDEPENDENT = 10  # ratios that count at most: all share the errors of the same poses


def scale_between(
    known: tuple[Array, Array], places: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale between depths in one image: (K, 2) px and (K,), and (N, 2) px and (N,).

    The ``known`` and the others, all positive, have no feature in common, so each is compared with
    known ones within a radius; most logarithms of ratios gather at the scale. None without any.
    """
    rows, columns, distances = _nearest_known(known[0], places[0], radius_px, NUM_NEIGHBORS)
    ratios = np.log(known[1][columns] / places[1][rows])
    return _densest(rows, ratios, np.exp(-((2 * distances / radius_px) ** 2)))


def scale_by_planes(
    known: tuple[Array, Array], places: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale as :func:`scale_between`, where no known depth lies beside a place.

    The inverse depth of a plane is affine in the image: it is fitted to the ``NUM_ON_PLANE`` known
    depths nearest to each place, within the radius, where these tell it well. None without any.
    """
    rows, columns, _ = _nearest_known(known[0], places[0], radius_px, NUM_ON_PLANE)
    full = np.flatnonzero(np.bincount(rows, minlength=len(places[0])) == NUM_ON_PLANE)
    columns = columns[np.isin(rows, full)].reshape(-1, NUM_ON_PLANE)
    offsets = (known[0][columns] - places[0][full, None]) / radius_px
    system = np.concatenate([np.ones((*columns.shape, 1)), offsets], axis=2)
    inverse_depths = 1.0 / known[1][columns]
    normal = system.transpose(0, 2, 1) @ system + 1e-9 * np.eye(3)
    fitted = np.linalg.solve(normal, system.transpose(0, 2, 1) @ inverse_depths[..., None])
    residuals = inverse_depths - (system @ fitted)[..., 0]
    variances = (residuals**2).sum(axis=1) / (NUM_ON_PLANE - 3)
    predicted = fitted[:, 0, 0]
    errors = np.sqrt(variances * np.linalg.inv(normal)[:, 0, 0])
    spreads = np.sqrt(variances)
    certain = (predicted > 0) & (np.maximum(errors, spreads) < MAX_PLANE_ERROR * predicted)
    ratios = -np.log(predicted[certain] * places[1][full[certain]])
    return _densest(full[certain], ratios, np.ones(len(ratios)))


def _densest(rows: Indices, ratios: Array, weights: Array) -> ScaleEstimate | None:
    """Return the scale where most weight of the logarithms of ratios is; None without any."""
    if not len(ratios):
        return None
    order = np.argsort(ratios)
    summed = np.concatenate([[0.0], np.cumsum(weights[order])])
    first = np.searchsorted(ratios[order], ratios - TOLERANCE, side="left")
    last = np.searchsorted(ratios[order], ratios + TOLERANCE, side="right")
    center = ratios[np.argmax(summed[last] - summed[first])]
    agreeing = np.abs(ratios - center) <= TOLERANCE
    num_agreeing = len(np.unique(rows[agreeing]))
    return ScaleEstimate(
        float(np.exp(np.average(ratios[agreeing], weights=weights[agreeing]))),
        num_agreeing,
        len(np.unique(rows)),
        float(np.std(ratios[agreeing]) / np.sqrt(min(num_agreeing, NUM_INDEPENDENT))),
    )


def _nearest_known(
    known: Array, places: Array, radius_px: float, count: int
) -> tuple[Indices, Indices, Array]:
    """Return (place, known point, distance) of the ``count`` nearest of each place."""
    if not len(known) or not len(places):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    distances, columns = cv2.batchDistance(
        places.astype(np.float32), known.astype(np.float32), cv2.CV_32F, K=min(count, len(known))
    )
    near = distances <= radius_px
    return np.nonzero(near)[0], columns[near].astype(np.int64), distances[near].astype(np.float64)
