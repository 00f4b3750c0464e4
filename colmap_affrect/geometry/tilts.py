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
from colmap_affrect.geometry.arrays import Array, Floats, Singles

STEP_PX = 4  # dense sources give one shape per block of 4 x 4 px, as the paper's dense AffNet
MAX_TANH = 0.999  # where logarithms end: of a metric, tilt 45
MIN_DISTINCT_SHARE = 0.5  # of frames that were measured one by one nearly all differ
SHAPE_STEP = 1e-4  # shapes of unit area that are this close are one; rounding of 32 bits is less
GRID_TILTS = np.geomspace(2.0, 6.21970, 6)  # of candidates for 1.7-balls up to tilt 5.8 (paper)
GRID_NUM_ANGLES = 32
IDENTITY_LABEL = -1
UNCOVERED_LABEL = -2


def unit_metrics(matrices: Floats) -> Array:
    """Return (..., 3) metrics (S11, S22, S12) of S = M^T M / |det M| for (..., 2, 2) maps."""
    gram = np.swapaxes(matrices, -1, -2) @ matrices
    determinant = np.abs(np.linalg.det(matrices))
    parts = np.stack([gram[..., 0, 0], gram[..., 1, 1], gram[..., 0, 1]], -1)
    return np.asarray(parts / determinant[..., None], dtype=np.float64)


def shapes_from_affnet(outputs: Floats) -> Array:
    """Return (..., 2, 2) frames, image from patch up to scale, of (..., 3) outputs of AffNet."""
    frames = np.zeros((*outputs.shape[:-1], 2, 2))
    frames[..., 0, 0] = 1.0 + outputs[..., 0]
    frames[..., 1, 0] = outputs[..., 1]
    frames[..., 1, 1] = 1.0 + outputs[..., 2]
    return frames


def of_unit_area(shapes: Floats) -> Array:
    """Divide (N, 2, 2) shapes by the roots of their areas."""
    areas = np.maximum(np.abs(determinants(shapes)), np.finfo(float).tiny)
    return np.asarray(shapes / np.sqrt(areas)[:, None, None], np.float64)


def are_individual_shapes(shapes: Floats) -> bool:
    """Whether (N, 2, 2) shapes of features were measured one by one.

    Those without a shape are circles, which a warp turns into one ellipse for all its features.
    """
    cells = np.rint(of_unit_area(shapes) / SHAPE_STEP).reshape(-1, 4)
    return len(np.unique(cells, axis=0)) > max(1.0, MIN_DISTINCT_SHARE * len(shapes))


def rectifying_metrics(shapes: Floats) -> Array:
    """Return (..., 3) unit metrics of L^-1, the rectifying maps of (..., 2, 2) frames L.

    The metric of L^-1 is the inverse of L L^T, which of unit determinant is its adjugate.
    """
    ellipses = unit_metrics(np.swapaxes(shapes, -1, -2))
    return np.stack([ellipses[..., 1], ellipses[..., 0], -ellipses[..., 2]], -1)


def log_metrics(metrics: Floats) -> Singles:
    """Return (..., 2) entries (l11, l12) of log(S / sqrt det S) for (..., 3) metrics of any scale.

    For S = m I + D with trace-free D the logarithm is atanh(|D| / m) D / |D|.
    """
    mean = (metrics[..., 0] + metrics[..., 1]) / 2
    deviator = np.stack([(metrics[..., 0] - metrics[..., 1]) / 2, metrics[..., 2]], -1)
    norm = np.maximum(np.linalg.norm(deviator, axis=-1), 1e-12)
    ratio = np.minimum(norm / np.maximum(mean, 1e-12), MAX_TANH)
    return np.asarray((np.arctanh(ratio) / norm)[..., None] * deviator, dtype=np.float32)


def metrics_from_log(logs: Floats) -> Array:
    """Invert :func:`log_metrics`: (..., 3) unit metrics by the exponential."""
    logs = logs.astype(np.float64)
    norm = np.linalg.norm(logs, axis=-1)
    factor = np.where(norm > 1e-9, np.sinh(norm) / np.maximum(norm, 1e-9), 1.0)
    cosh = np.cosh(norm)
    diagonal, off = factor * logs[..., 0], factor * logs[..., 1]
    return np.stack([cosh + diagonal, cosh - diagonal, off], -1)


def metrics_from_tilts(tilts: ArrayLike, angles_rad: ArrayLike) -> Array:
    """Return (..., 3) unit metrics of the classes (tilt, angle) of diag(t, 1) R(phi)."""
    tilts, angles = (np.asarray(values, np.float64) for values in (tilts, angles_rad))
    cos, sin = np.cos(angles), np.sin(angles)
    s11, s22 = tilts * cos**2 + sin**2 / tilts, tilts * sin**2 + cos**2 / tilts
    return np.stack([s11, s22, (1.0 / tilts - tilts) * cos * sin], -1)


def tilts_from_metrics(metrics: Floats) -> tuple[Array, Array]:
    """Return tilts >= 1 and angles in [0, pi) of (..., 3) unit metrics."""
    s11, s22, s12 = metrics[..., 0], metrics[..., 1], metrics[..., 2]
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
    angles = np.arange(GRID_NUM_ANGLES) * np.pi / GRID_NUM_ANGLES
    tilts, angles = np.meshgrid(GRID_TILTS, angles, indexing="ij")
    return np.stack([tilts.ravel(), angles.ravel()], axis=1)


def asift_covering() -> Array:
    """Return the 60 maps of ASIFT beside the identity as (60, 2) rows (tilt, angle_rad).

    Tilts 2^(k/2), k = 1...6; 4, 5, 7, 10, 14, 20 angles (Morel & Yu 2009, whose program rounds
    5 t to an even number and halves it; Sec. 2.3 of the paper counts 61 with the identity).
    """
    tilts = [2.0 ** (level / 2.0) for level in range(1, 7)]
    counts = [(round(5.0 * tilt) + 1) // 2 for tilt in tilts]
    rings = zip(tilts, counts, strict=True)
    return np.array([(tilt, k * np.pi / count) for tilt, count in rings for k in range(count)])


def near_optimal_covering() -> Array:
    """Return the 24 maps that, with the identity, cover all tilts to 5.8 by 1.7-balls.

    As (24, 2) rows (tilt, angle_rad). Source: Rodriguez, Delon, Morel 2018, constants for
    r = 1.7: two rings of 8 and 16 maps, which together show 6.1 image areas.
    """
    rings = [(2.61757, 0.398032, 8), (5.18168, 0.198314, 16)]
    return np.array([(tilt, step * index) for tilt, step, count in rings for index in range(count)])


@dataclass(frozen=True)
class Cover:
    """Covering centres of a set of shapes and the centre nearest to each shape."""

    centers: Array  # (K, 2) rows (tilt, angle_rad) in order of choice; K may be 0
    labels: NDArray[np.int32]  # (N,) index of the nearest centre, IDENTITY_LABEL, UNCOVERED_LABEL


def cover_shapes(
    metrics: Floats,
    weights: Floats,
    *,
    radius: float,
    max_tilt: float,
    covered_frac: float,
    max_num_centers: int,
) -> Cover:
    """Choose centres greedily until their r-balls hold enough shapes, then partition.

    Shapes, (N, 3) metrics of rectifying maps with (N,) votes >= 0, count as covered from the start
    in the r-ball of the identity, r > 1 being a tilt ratio; those of a tilt above ``max_tilt``
    neither vote nor count. Every shape then goes to the nearest of the centres and the identity if
    it lies in that r-ball (Sec. 2.4 of the paper). Candidates are those of :func:`covering_grid`;
    ``covered_frac`` of the votes are to be covered.
    """
    candidates = covering_grid()
    threshold = ball_threshold(radius)
    identity_cosh = metrics[:, :2].sum(axis=1) / 2.0
    votes = np.where(identity_cosh <= ball_threshold(max_tilt), weights, 0.0)
    allowed = (1.0 - covered_frac) * votes.sum()
    votes = np.where(identity_cosh < threshold, 0.0, votes)
    open_shapes = np.flatnonzero(votes)
    votes = votes[open_shapes].astype(np.float32)
    candidate_metrics = metrics_from_tilts(candidates[:, 0], candidates[:, 1])
    in_ball = cosh_distances(candidate_metrics, metrics[open_shapes]) < threshold
    ballots = in_ball.astype(np.float32)
    chosen: list[int] = []
    while votes.sum() > allowed and len(chosen) < max_num_centers:
        totals = ballots @ votes
        best = int(np.argmax(totals))
        if totals[best] <= 0.0:
            break
        chosen.append(best)
        votes = np.where(in_ball[best], np.float32(0), votes)
    centers = np.asarray(candidates[chosen], dtype=np.float64)
    return Cover(centers, nearest_centers(metrics, centers, radius))


def nearest_centers(metrics: Floats, centers: Floats, radius: float) -> NDArray[np.int32]:
    """Label (N, 3) metrics with the nearest of the identity and (K, 2) centres, within r."""
    tilts, angles = np.concatenate([[[1.0, 0.0]], centers]).T
    distances = cosh_distances(metrics_from_tilts(tilts, angles), np.asarray(metrics))
    nearest = np.argmin(distances, axis=0)
    labels = np.where(nearest == 0, IDENTITY_LABEL, nearest - 1)
    inside = distances.min(axis=0) < ball_threshold(radius)
    return np.where(inside, labels, UNCOVERED_LABEL).astype(np.int32)
