"""Depths of matches of two views, and the scale between depths that are known in one image.

A pose is (R, t) with ``x2 = R x1 + t`` for points in the two camera frames; rays are (N, 2)
normalized image coordinates, the point at depth z being ``z (x, y, 1)``.
"""

from dataclasses import dataclass, replace

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
    sines = np.linalg.norm(np.cross(towards1, towards2), axis=1)
    determinants = np.maximum(sines**2, np.finfo(float).tiny)
    return Depths(
        (product * along2 - square2 * along1) / determinants,
        (square1 * along2 - product * along1) / determinants,
        np.degrees(np.arctan2(sines, product)),
    )


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
NUM_INDEPENDENT = 10  # ratios that count at most: all share the errors of the same poses
NUM_ON_PLANE = 12  # known places to which a plane is fitted
MAX_PLANE_ERROR = 0.04  # relative, of a predicted inverse depth and of those it is fitted to
MIN_KNOWN = 20  # known depths that a depth map is fitted to
MAX_FITTED = 500  # known depths of which pairs are tried and counted; more are thinned

MAX_UNEXPLAINED = 0.5  # part of the spread of known depths that a depth map may leave unexplained


def scale_between(
    known: tuple[Array, Array], places: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale between depths in one image: (K, 2) px and (K,), and (N, 2) px and (N,).

    The ``known`` and the others, all positive, have no feature in common, so each is compared with
    known ones within a radius; the scale is where most logarithms of ratios gather. None without
    neighbours.
    """
    rows, columns, distances = _nearest_known(known[0], places[0], radius_px, NUM_NEIGHBORS)
    ratios = np.log(known[1][columns] / places[1][rows])
    return _densest(rows, ratios, np.exp(-((2 * distances / radius_px) ** 2)))


def scale_by_planes(
    known: tuple[Array, Array], places: tuple[Array, Array], radius_px: float
) -> ScaleEstimate | None:
    """Estimate the scale as :func:`scale_between`, where no known depth lies beside a place.

    The inverse depth of a plane is affine in the image: it is fitted to the ``NUM_ON_PLANE`` known
    depths nearest to each place, within the radius, and taken where it is certain enough. None
    where no place counts.
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


def scale_by_depth_map(
    known: tuple[Array, Array], places: tuple[Array, Array]
) -> ScaleEstimate | None:
    """Estimate the scale as :func:`scale_between`, by a depth map where nothing else is near.

    Inverse depths of the map are those of the model up to scale and shift, which are fitted to the
    known depths robustly, and hold between the nearest and the farthest of these only. Both
    arguments have depths of the map, NaN where it has none, (K,) and (N,), and then the known ones
    or, all positive, those of the pair.
    """
    known_map, known_inverse = (1.0 / part[np.isfinite(known[0])] for part in known)
    fitted = _fitted_to(known_map, known_inverse)
    if fitted is None:
        return None
    (slope, shift), errors = fitted
    agreeing = errors <= TOLERANCE
    with np.errstate(invalid="ignore"):
        inverse_depths = 1.0 / places[0]
        inside = (inverse_depths >= known_map[agreeing].min()) & (
            inverse_depths <= known_map[agreeing].max()
        )
    rows = np.flatnonzero(inside)
    ratios = -np.log((slope * inverse_depths[rows] + shift) * places[1][rows])
    found = _densest(rows, ratios, np.ones(len(rows)))
    if found is None:
        return None
    of_fit = np.sqrt(np.mean(errors[agreeing] ** 2) / min(int(agreeing.sum()), NUM_INDEPENDENT))
    return replace(found, error_frac=float(np.hypot(found.error_frac, of_fit)))


def _fitted_to(values: Array, inverse_depths: Array) -> tuple[Array, Array] | None:
    """Fit ``slope * value + shift`` to inverse depths that may be wrong, up to half of them.

    Returns both, and (K,) errors of the logarithm; None where values do not explain the depths.
    """
    if len(values) < MIN_KNOWN:
        return None
    some = np.argsort(values)[:: -(-len(values) // MAX_FITTED)]
    half = len(some) // 2
    starts, ends = np.meshgrid(some[:half], some[half :: max(1, half // 10)], indexing="ij")
    runs = values[ends] > values[starts]
    first, second = starts[runs], ends[runs]
    slopes = (inverse_depths[second] - inverse_depths[first]) / (values[second] - values[first])
    lines = np.stack([slopes, inverse_depths[first] - slopes * values[first]], axis=1)
    if not len(lines):
        return None
    errors = _log_errors(lines, values[some], inverse_depths[some])
    line = lines[np.argmin(np.median(errors, axis=1))]
    for _ in range(3):
        agrees = _log_errors(line[None], values, inverse_depths)[0] <= TOLERANCE
        if agrees.sum() < MIN_KNOWN:
            return None
        system = np.stack([values, np.ones(len(values))], axis=1) / inverse_depths[:, None]
        line = np.linalg.lstsq(system[agrees], np.ones(int(agrees.sum())), rcond=None)[0]
    errors = _log_errors(line[None], values, inverse_depths)[0]
    logs = np.log(inverse_depths)
    spread = np.median(np.abs(logs - np.median(logs)))
    if line[0] <= 0 or np.median(errors) > min(TOLERANCE, MAX_UNEXPLAINED * spread):
        return None
    return line, errors


def _log_errors(lines: Array, values: Array, inverse_depths: Array) -> Array:
    """Return (L, K) errors of the logarithms that (L, 2) lines predict; infinite if negative."""
    predicted = lines[:, :1] * values + lines[:, 1:]
    ratios = np.maximum(predicted, 0.0) / inverse_depths
    with np.errstate(divide="ignore"):
        return np.abs(np.log(ratios))


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
