"""Shape source ``second-moment``: affine shapes from the structure tensor; no network, no weights.

The structure tensor mu has the shape L ~ mu^(-1/2), so the rectifying map is L^-1 ~ mu^(1/2), and
its unit metric is mu / sqrt(det mu) (Lindeberg & Garding 1997; Baumberg 2000).
"""

from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from pydantic import Field

from colmap_affrect.data import GrayImage, ShapeGrid, ShapeSamples
from colmap_affrect.features.base import FeatureOptions, NetworkContext, ShapeOptions
from colmap_affrect.geometry.arrays import Singles
from colmap_affrect.geometry.conventions import grid_origin
from colmap_affrect.geometry.tilts import STEP_PX, log_metrics, metrics_from_log
from colmap_affrect.options import within


class SecondMomentOptions(ShapeOptions):
    """Shape source ``second-moment``."""

    name: Literal["second-moment"] = "second-moment"
    uses_network: ClassVar[bool] = False
    derivative_sigma_px: Annotated[float, within(0.3, 20.0)] = 1.5  # judged
    """Gaussian smoothing before the gradients."""
    integration_sigmas_px: Annotated[
        tuple[Annotated[float, within(1.0, 1000.0)], ...],
        Field(strict=False, min_length=1),
    ] = (8.0, 16.0, 32.0)  # judged
    """Windows over which the structure tensor is averaged; shapes are their log-Euclidean mean."""
    min_gradient: Annotated[float, within(0.0, 255.0)] = 1.0  # judged
    """Root mean square gradient, gray values per px, under which a block counts as flat."""


class SecondMoment:
    """Shapes of all 4 x 4 blocks from the gradients around them."""

    Options = SecondMomentOptions

    def __init__(
        self,
        options: SecondMomentOptions,
        network: NetworkContext | None = None,
        features: FeatureOptions | None = None,
    ) -> None:
        del network, features
        self.options = options

    def grid(self, image: GrayImage) -> ShapeGrid:
        """Estimate a shape per 4 x 4 block of (H, W) uint8; identity under ``min_gradient``."""
        tensor = _block_tensors(image, self.options.derivative_sigma_px)
        sigmas_px = self.options.integration_sigmas_px
        mean_log = np.zeros((*tensor.shape[:2], 2), dtype=np.float32)
        for sigma_px in sigmas_px:
            logs = log_metrics(_smoothed(tensor, sigma_px))
            mean_log += logs / len(sigmas_px)
        smallest_window = _smoothed(tensor, min(sigmas_px))
        square_gradients = smallest_window[..., 0] + smallest_window[..., 1]
        textured = square_gradients > self.options.min_gradient**2
        mean_log[~textured] = 0.0
        return ShapeGrid(
            metrics=metrics_from_log(mean_log),
            textured=textured,
            origin_px=grid_origin(STEP_PX),
            step_px=STEP_PX,
        )

    def samples(self, image: GrayImage) -> ShapeSamples:
        """Return the shapes of the textured blocks of a (H, W) uint8 image."""
        return self.grid(image).samples()


def _smoothed(tensor: Singles, sigma_px: float) -> Singles:
    """Smooth (R, C, 3) values at blocks by a Gaussian."""
    sigma_blocks = sigma_px / STEP_PX
    return np.asarray(cv2.GaussianBlur(tensor, (0, 0), sigma_blocks), dtype=np.float32)


def _block_tensors(image: GrayImage, derivative_sigma_px: float) -> Singles:
    """Return (R, C, 3) block means of (Ix^2, Iy^2, Ix Iy); gradients in gray values per px."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), derivative_sigma_px)
    # Kernel size 1 and scale 0.5 make central differences.
    gradient_x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    gradient_y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    height, width = image.shape
    bottom = -height % STEP_PX
    right = -width % STEP_PX
    num_blocks = ((width + right) // STEP_PX, (height + bottom) // STEP_PX)
    means = np.empty((num_blocks[1], num_blocks[0], 3), np.float32)
    factors = (
        (gradient_x, gradient_x),
        (gradient_y, gradient_y),
        (gradient_x, gradient_y),
    )
    for channel, (first, second) in enumerate(factors):
        padded = cv2.copyMakeBorder(
            first * second, 0, bottom, 0, right, cv2.BORDER_REPLICATE
        )
        means[..., channel] = cv2.resize(
            padded, num_blocks, interpolation=cv2.INTER_AREA
        )
    return means
