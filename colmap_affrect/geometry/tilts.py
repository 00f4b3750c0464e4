"""The space of tilts: classes of affine maps up to similarity, their distance and covers.

A class (t, phi) of a map M = lambda R(psi) diag(t, 1) R(phi) is represented by its unit
metric S = M^T M / det M, kept as three numbers (S11, S22, S12). Then the distance is
bilinear: cosh d = (S11 S'22 + S22 S'11 - 2 S12 S'12) / 2, the hyperboloid model of the
hyperbolic plane, and all votes of all shapes are one matrix product.

The logarithm of a unit metric is a trace-free symmetric matrix, kept as its entries (l11, l12); its
eigenvalues are +-log t. Means of shapes are means of logarithms (log-Euclidean mean; Arsigny,
Fillard, Pennec, Ayache 2007).

Source: Rodriguez, Delon, Morel, "Covering the space of tilts" (2018), and Sec. 2.4 of
the paper, whose program has t1 / t2 where 1 / (t1 t2) stands in the formula.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Array, Bools, Floats, Singles

# Dense sources give one shape per block of 4 x 4 px, as the paper's dense AffNet
STEP_PX = 4
MAX_TANH = 0.999  # where logarithms of metrics are cut off: a tilt of 45; numeric
SMALLEST_NORM = 1e-12  # of deviators that are divided by their norm; numeric
SMALLEST_LOG = 1e-9  # below it sinh(x) / x is 1 in float64; numeric
MIN_DISTINCT_RATIO = 0.5
"""Shapes that differ, as a share of all, where they were measured one by one: then nearly all do;
theory."""
# Shapes of unit area that are this close are equal; float32 rounding is less; numeric
SHAPE_STEP = 1e-4
# Candidates for 1.7-balls up to tilt 5.8 (the paper)
GRID_TILTS = np.geomspace(2.0, 6.21970, 6)
GRID_NUM_ANGLES = 32  # candidates of each tilt (the paper)
NEAR_OPTIMAL_RINGS = ((2.61757, 0.398032, 8), (5.18168, 0.198314, 16))
"""Tilts, steps of the angle in radians and numbers of maps (Rodriguez, Delon, Morel 2018, constants
for r = 1.7); paper."""
# Metrics whose distances to all centres are held at once, which stay in the cache; resource
NUM_AT_ONCE = 4096
IDENTITY_LABEL = -1  # format
UNCOVERED_LABEL = -2  # format


def unit_metrics(matrices: Floats) -> Array:
    """Return (..., 3) metrics (S11, S22, S12) of S = M^T M / |det M| for (..., 2, 2) maps."""
    gram = np.swapaxes(matrices, -1, -2) @ matrices
    entries = np.stack([gram[..., 0, 0], gram[..., 1, 1], gram[..., 0, 1]], -1)
    areas = np.abs(np.linalg.det(matrices))
    return np.asarray(entries / areas[..., None], dtype=np.float64)


def shapes_from_affnet(outputs: Floats) -> Array:
    """Return the shapes of LAFs, image from patch up to scale, of outputs of AffNet.

    (..., 3) outputs become (..., 2, 2) lower triangular shapes.
    """
    shapes = np.zeros((*outputs.shape[:-1], 2, 2))
    shapes[..., 0, 0] = 1.0 + outputs[..., 0]
    shapes[..., 1, 0] = outputs[..., 1]
    shapes[..., 1, 1] = 1.0 + outputs[..., 2]
    return shapes


def of_unit_area(shapes: Floats) -> Array:
    """Divide (N, 2, 2) shapes by the roots of their areas."""
    areas = np.maximum(np.abs(determinants(shapes)), np.finfo(float).tiny)
    return np.asarray(shapes / np.sqrt(areas)[:, None, None], np.float64)


def are_individual_shapes(shapes: Floats) -> bool:
    """Tell whether (N, 2, 2) shapes of features were measured one by one.

    Features without a shape are circles, which a warp maps to one ellipse for all of them.
    """
    rounded = np.rint(of_unit_area(shapes) / SHAPE_STEP).reshape(-1, 4)
    num_distinct = len(np.unique(rounded, axis=0))
    return num_distinct > max(1.0, MIN_DISTINCT_RATIO * len(shapes))


def rectifying_metrics(shapes: Floats) -> Array:
    """Return (..., 3) unit metrics of L^-1, the rectifying maps of (..., 2, 2) shapes L.

    The metric of L^-1 is the inverse of L L^T, which of unit determinant is its adjugate.
    """
    ellipses = unit_metrics(np.swapaxes(shapes, -1, -2))
    return np.stack([ellipses[..., 1], ellipses[..., 0], -ellipses[..., 2]], -1)


def log_metrics(metrics: Floats) -> Singles:
    """Return (..., 2) entries (l11, l12) of log(S / sqrt det S) for (..., 3) metrics of any scale.

    For S = m I + D with trace-free D the logarithm is atanh(|D| / m) D / |D|.
    """
    s11, s22, s12 = np.moveaxis(metrics, -1, 0)
    mean = (s11 + s22) / 2
    deviator = np.stack([(s11 - s22) / 2, s12], -1)
    norm = np.maximum(np.linalg.norm(deviator, axis=-1), SMALLEST_NORM)
    ratio = np.minimum(norm / np.maximum(mean, SMALLEST_NORM), MAX_TANH)
    factor = np.arctanh(ratio) / norm
    return np.asarray(factor[..., None] * deviator, dtype=np.float32)


def metrics_from_log(logs: Floats) -> Array:
    """Invert :func:`log_metrics`: (..., 3) unit metrics by the exponential."""
    logs = logs.astype(np.float64)
    norm = np.linalg.norm(logs, axis=-1)
    quotient = np.sinh(norm) / np.maximum(norm, SMALLEST_LOG)
    factor = np.where(norm > SMALLEST_LOG, quotient, 1.0)
    cosh = np.cosh(norm)
    diagonal, off_diagonal = np.moveaxis(factor[..., None] * logs, -1, 0)
    return np.stack([cosh + diagonal, cosh - diagonal, off_diagonal], -1)


def metrics_from_tilts(tilts: ArrayLike, angles_rad: ArrayLike) -> Array:
    """Return (..., 3) unit metrics of the classes (tilt, angle) of diag(t, 1) R(phi)."""
    tilts = np.asarray(tilts, np.float64)
    angles = np.asarray(angles_rad, np.float64)
    cos = np.cos(angles)
    sin = np.sin(angles)
    s11 = tilts * cos**2 + sin**2 / tilts
    s22 = tilts * sin**2 + cos**2 / tilts
    s12 = (1.0 / tilts - tilts) * cos * sin
    return np.stack([s11, s22, s12], -1)


def tilts_from_metrics(metrics: Floats) -> tuple[Array, Array]:
    """Return tilts >= 1 and angles in [0, pi) of (..., 3) unit metrics."""
    s11, s22, s12 = np.moveaxis(metrics, -1, 0)
    cosh = np.maximum((s11 + s22) / 2.0, 1.0)
    tilts = cosh + np.sqrt(cosh**2 - 1.0)
    angles = np.mod(0.5 * np.arctan2(-2.0 * s12, s11 - s22), np.pi)
    return tilts, np.where(angles >= np.pi, 0.0, angles)


def cosh_distances(metrics1: Floats, metrics2: Floats) -> Array:
    """Return the (N, M) matrix of cosh(log transition tilt) between (N, 3) and (M, 3) metrics."""
    swapped = np.stack([metrics2[:, 1], metrics2[:, 0], -2.0 * metrics2[:, 2]], -1)
    return np.asarray(metrics1 @ swapped.T) / 2.0


def ball_threshold(radius: float) -> float:
    """Return cosh(log r): a class is in the r-ball of another when cosh d is below it."""
    return (radius**2 + 1.0) / (2.0 * radius)


def covering_grid() -> Array:
    """Return the paper's 192 candidate centres as (192, 2) rows (tilt, angle_rad)."""
    ring = np.arange(GRID_NUM_ANGLES) * np.pi / GRID_NUM_ANGLES
    tilts, angles = np.meshgrid(GRID_TILTS, ring, indexing="ij")
    return np.stack([tilts.ravel(), angles.ravel()], axis=1)


def asift_covering() -> Array:
    """Return the 60 maps of ASIFT beside the identity as (60, 2) rows (tilt, angle_rad).

    Tilts 2^(k/2), k = 1...6; 4, 5, 7, 10, 14, 20 angles (Morel & Yu 2009, whose program rounds
    5 t to an even number and halves it; Sec. 2.3 of the paper counts 61 with the identity).
    """
    rows = []
    for level in range(1, 7):
        tilt = 2.0 ** (level / 2.0)
        num_angles = (round(5.0 * tilt) + 1) // 2
        rows += [(tilt, index * np.pi / num_angles) for index in range(num_angles)]
    return np.array(rows)


def near_optimal_covering() -> Array:
    """Return the 24 maps that, with the identity, cover all tilts to 5.8 by 1.7-balls.

    They are (24, 2) rows (tilt, angle_rad). Both rings of :data:`NEAR_OPTIMAL_RINGS` show 6.1 image
    areas together.
    """
    rows = []
    for tilt, angle_step, num_angles in NEAR_OPTIMAL_RINGS:
        rows += [(tilt, angle_step * index) for index in range(num_angles)]
    return np.array(rows)


@dataclass(frozen=True)
class Cover:
    """Covering centres of a set of shapes and the centre nearest to each shape."""

    centers: Array  # (K, 2) rows (tilt, angle_rad) in order of choice; K may be 0
    # (N,) index of the nearest centre, IDENTITY_LABEL, UNCOVERED_LABEL
    labels: NDArray[np.int32]


def cover_shapes(
    metrics: Floats,
    weights: Floats,
    *,
    radius: float,
    max_tilt: float,
    covered_frac: float,
    max_num_centers: int,
) -> Cover:
    """Choose centres greedily until their r-balls hold enough shapes, then partition the shapes.

    Candidates are those of :func:`covering_grid`. Shapes in the r-ball of the identity are covered
    from the start. In the end every shape belongs to the nearest of the centres and the identity,
    if it lies in that r-ball (Sec. 2.4 of the paper).

    Args:
        metrics: (N, 3) metrics of the rectifying maps of the shapes.
        weights: (N,) votes >= 0.
        radius: r > 1, a tilt ratio.
        max_tilt: shapes of a larger tilt neither vote nor need to be covered.
        covered_frac: share of the votes that are to be covered.
        max_num_centers: centres, at most.

    Returns:
        The centres, and to which of them each shape belongs.
    """
    candidates = covering_grid()
    threshold = ball_threshold(radius)
    identity_cosh = metrics[:, :2].sum(axis=1) / 2.0
    votes = np.where(identity_cosh <= ball_threshold(max_tilt), weights, 0.0)
    max_uncovered = (1.0 - covered_frac) * votes.sum()
    votes = np.where(identity_cosh < threshold, 0.0, votes)
    voters = np.flatnonzero(votes)
    votes = votes[voters].astype(np.float32)
    candidate_metrics = metrics_from_tilts(candidates[:, 0], candidates[:, 1])
    in_ball = _in_balls(candidate_metrics, metrics[voters], threshold)
    ballots = in_ball.astype(np.float32)
    chosen: list[int] = []
    while votes.sum() > max_uncovered and len(chosen) < max_num_centers:
        totals = ballots @ votes
        best = int(np.argmax(totals))
        if totals[best] <= 0.0:
            break
        chosen.append(best)
        votes = np.where(in_ball[best], np.float32(0), votes)
    centers = np.asarray(candidates[chosen], dtype=np.float64)
    return Cover(centers, nearest_centers(metrics, centers, radius))


def _in_balls(centers: Floats, metrics: Floats, threshold: float) -> Bools:
    """Return which metrics are in the balls of centres.

    Args:
        centers: (K, 3) metrics.
        metrics: (N, 3).
        threshold: as :func:`ball_threshold` has it.

    Returns:
        (K, N) bool.
    """
    in_ball = np.empty((len(centers), len(metrics)), np.bool_)
    for begin in range(0, len(metrics), NUM_AT_ONCE):
        part = slice(begin, begin + NUM_AT_ONCE)
        distances = cosh_distances(centers, metrics[part])
        np.less(distances, threshold, out=in_ball[:, part])
    return in_ball


def nearest_centers(
    metrics: Floats, centers: Floats, radius: float
) -> NDArray[np.int32]:
    """Label metrics with the nearest of the centres and the identity.

    Args:
        metrics: (N, 3).
        centers: (K, 2) rows (tilt, angle_rad).
        radius: a tilt ratio; metrics outside of all balls of this radius are uncovered.

    Returns:
        (N,) labels as in :class:`Cover`.
    """
    identity = [[1.0, 0.0]]
    tilts, angles = np.concatenate([identity, centers]).T
    distances = cosh_distances(metrics_from_tilts(tilts, angles), np.asarray(metrics))
    nearest = np.argmin(distances, axis=0)
    labels = np.where(nearest == 0, IDENTITY_LABEL, nearest - 1)
    is_inside = distances.min(axis=0) < ball_threshold(radius)
    return np.where(is_inside, labels, UNCOVERED_LABEL).astype(np.int32)
