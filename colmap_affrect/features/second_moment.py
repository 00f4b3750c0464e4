"""Shape source ``second-moment``: affine shapes from the structure tensor; no network, no weights.

With a shape L ~ mu^(-1/2) the rectifying map is L^-1 ~ mu^(1/2), so the unit metric of the
rectifying map is mu / sqrt(det mu) itself (Lindeberg & Garding 1997; Baumberg 2000).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import grid_origin
from colmap_affrect.options import SecondMomentOptions
from colmap_affrect.types import GrayImage, ShapeGrid

STEP_PX = 4
"""One shape per block of 4 x 4 px, as in the paper's dense AffNet."""


def second_moment_shapes(image: GrayImage, options: SecondMomentOptions) -> ShapeGrid:
    """Estimate one affine shape per 4 x 4 block.

    The tensor is averaged over blocks, then over each integration scale; the scales are
    combined by the log-Euclidean mean of the unit metrics. Blocks whose gradients stay
    under ``min_gradient`` are not textured and get the identity.
    """
    tensor = _block_tensor(image, options.derivative_sigma_px)
    mean_log = np.zeros((*tensor.shape[:2], 2), dtype=np.float32)
    for sigma_px in options.integration_sigmas_px:
        mean_log += _log_metric(_smooth(tensor, sigma_px)) / len(options.integration_sigmas_px)
    local = _smooth(tensor, min(options.integration_sigmas_px))
    textured = local[..., 0] + local[..., 1] > options.min_gradient**2
    mean_log[~textured] = 0.0
    return ShapeGrid(_metric_from_log(mean_log), textured, grid_origin(STEP_PX), STEP_PX)


def _smooth(tensor: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(tensor, (0, 0), sigma_px / STEP_PX), dtype=np.float32)


def _block_tensor(image: GrayImage, derivative_sigma_px: float) -> NDArray[np.float32]:
    """Return (R, C, 3) block means of (Ix^2, Iy^2, Ix Iy); gradients in gray values per px."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), derivative_sigma_px)
    right = cv2.copyMakeBorder(smooth, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)
    gradient_x = (right[1:-1, 2:] - right[1:-1, :-2]) / 2
    gradient_y = (right[2:, 1:-1] - right[:-2, 1:-1]) / 2
    products = np.dstack([gradient_x**2, gradient_y**2, gradient_x * gradient_y])
    height, width = image.shape
    bottom, side = -height % STEP_PX, -width % STEP_PX
    padded = np.pad(products, ((0, bottom), (0, side), (0, 0)), mode="edge")
    grid = ((width + side) // STEP_PX, (height + bottom) // STEP_PX)
    return np.asarray(cv2.resize(padded, grid, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _log_metric(tensor: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return (..., 2) entries (l11, l12) of log(mu / sqrt det mu), a trace-free symmetric matrix.

    For mu = m I + D with trace-free D the logarithm is atanh(|D| / m) D / |D|.
    """
    mean = (tensor[..., 0] + tensor[..., 1]) / 2
    deviator = np.stack([(tensor[..., 0] - tensor[..., 1]) / 2, tensor[..., 2]], -1)
    norm = np.maximum(np.linalg.norm(deviator, axis=-1), 1e-12)
    ratio = np.minimum(norm / np.maximum(mean, 1e-12), 0.999)
    return np.asarray((np.arctanh(ratio) / norm)[..., None] * deviator, dtype=np.float32)


def _metric_from_log(log_metric: NDArray[np.floating]) -> NDArray[np.float64]:
    """Invert :func:`_log_metric`: (..., 3) unit metrics by the exponential."""
    log_metric = log_metric.astype(np.float64)
    norm = np.linalg.norm(log_metric, axis=-1)
    factor = np.where(norm > 1e-9, np.sinh(norm) / np.maximum(norm, 1e-9), 1.0)
    cosh = np.cosh(norm)
    diagonal, off = factor * log_metric[..., 0], factor * log_metric[..., 1]
    return np.stack([cosh + diagonal, cosh - diagonal, off], -1)
