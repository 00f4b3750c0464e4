"""Affine shapes as unit metrics: from frames, and to logarithms, whose mean is a mean shape.

The logarithm of a unit metric (S11, S22, S12) is a trace-free symmetric matrix, kept as its
entries (l11, l12); its eigenvalues are +-log t. Means of shapes are means of logarithms
(log-Euclidean mean; Arsigny, Fillard, Pennec, Ayache 2007).
"""

import numpy as np

from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Array, Floats, Singles
from colmap_affrect.geometry.tilts import unit_metrics

STEP_PX = 4  # dense sources give one shape per block of 4 x 4 px, as the paper's dense AffNet
MAX_TANH = 0.999  # where logarithms end: of a metric, tilt 45
MIN_DISTINCT_SHARE = 0.5  # of frames that were measured one by one nearly all differ

SHAPE_STEP = 1e-4  # shapes of unit area that are this close are one; rounding of 32 bits is less


def frames_from_affnet(outputs: Floats) -> Array:
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


def vary_singly(shapes: Floats) -> bool:
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
