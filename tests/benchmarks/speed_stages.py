"""Which functions of the package belong to which stage, and what they cannot do without.

The work is that of the algorithm as it is, at its least: separable filters count all their taps,
each input is read once and each output written once, scale spaces are written and read once.
What has no useful count (entropy decoding of a JPEG, RANSAC) has none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stage_clock import Timed, Work

from colmap_affrect.features.registry import uses_networks
from colmap_affrect.features.rootsift import RootSift
from colmap_affrect.features.second_moment import SecondMoment
from colmap_affrect.geometry.shapes import STEP_PX
from colmap_affrect.geometry.tilts import Cover, ball_threshold, covering_grid
from colmap_affrect.imaging import ANTI_ALIASING_SIGMA
from colmap_affrect.options import DogOptions, ExtractionOptions
from colmap_affrect.types import GrayImage, LocalFeatures, Rectification, ShapeGrid, View

FLOAT_BYTES = 4
BILINEAR_TAPS = 4
IMAGE_STAGES = (
    "decode", "shapes", "cover", "warp", "detect", "shape/orientation", "describe",
    "de-duplicate", "other", "write",
)  # fmt: skip
PAIR_STAGES = ("prepare", "match", "prepare, 8 bit", "match, 8 bit", "verify")

OCTAVES = 4.0 / 3.0
"""Pixels of all octaves in those of the first."""
DOUBLED = 4.0
"""Pixels of SIFT's first octave in those of the image."""
EXTREMUM_NEIGHBORS = 26
DESCRIPTOR_SAMPLES = 1300
"""Pixels under the window of a SIFT descriptor, a square of 15 sigma; in the octave of a feature
sigma is 2 to 3.2 px, mostly the smaller ones."""
DESCRIPTOR_OPERATIONS = 30
"""Of a sample: gradient, its angle and length, Gauss, and eight shares of the histogram."""


def timed_functions(options: ExtractionOptions) -> list[Timed]:
    """Return the functions to watch while images are extracted by these options."""
    here = "colmap_affrect"
    functions = [
        Timed("decode", f"{here}.extraction.read_gray", decode_work),
        Timed("decode", f"{here}.extraction.shrink_to"),
        Timed("shapes", f"{here}.features.second_moment.SecondMoment.grid", second_moment_work),
        Timed("cover", f"{here}.extraction.ImageExtractor.plan"),
        Timed("cover", f"{here}.rectifiers.dense_shapes.cover_shapes", cover_work),
        Timed("cover", f"{here}.rectifiers.covers.cover_shapes", cover_work),
        Timed("warp", f"{here}.rectified.warp", warp_work),
        Timed("warp", f"{here}.rectified.warp_mask", mask_work),
        Timed("detect", f"{here}.features.rootsift.RootSift.detect", rootsift_work),
        Timed("describe", f"{here}.features.rootsift.RootSift.describe", sift_description_work),
        Timed("de-duplicate", f"{here}.extraction.extract_rectified"),
    ]
    if not uses_networks(options):
        return functions
    learned = f"{here}.features.affnet_hardnet.AffNetHardNet"
    return [
        *functions,
        Timed("shapes", f"{here}.features.affnet.AffNet.grid"),
        Timed("shapes", f"{here}.features.affnet.AffNet.samples"),
        Timed("detect", f"{learned}.detect", learned_detection_work),
        Timed("describe", f"{learned}.describe", description_work),
        Timed("shape/orientation", f"{here}.features.networks.AffineShapes.forward", network_work),
        Timed("shape/orientation", "kornia.feature.OriNet.forward", network_work),
    ]


def gaussian_taps(sigma_px: float) -> int:
    """Return the taps of OpenCV's filter of float images along one axis."""
    return round(8.0 * sigma_px + 1.0) | 1


def decode_work(image: GrayImage, path: Path) -> Work:
    """Read the file, write the image."""
    return Work(num_bytes=path.stat().st_size + image.size)


def second_moment_work(grid: ShapeGrid, source: SecondMoment, image: GrayImage) -> Work:
    """Blur, gradients, products and their means; then three channels of blocks at each scale."""
    options = source.options
    per_pixel = 2 * gaussian_taps(options.derivative_sigma_px) + 2 + 3 + 3
    scales_px = [sigma / STEP_PX for sigma in options.integration_sigmas_px]
    per_block = 3 * 2 * sum(gaussian_taps(sigma) for sigma in scales_px)
    blocks = grid.textured.size
    return Work(
        image.size * per_pixel + blocks * per_block,
        image.size + FLOAT_BYTES * grid.metrics.size,
    )


def cover_work(
    cover: Cover,
    metrics: NDArray[np.floating],
    weights: NDArray[np.floating],
    *,
    radius: float,
    max_tilt: float,
    **_: Any,
) -> Work:
    """Distances of the voters to all candidates, their votes for each centre, labels of all."""
    cosh = metrics[:, :2].sum(axis=1) / 2.0
    voting = (cosh >= ball_threshold(radius)) & (cosh <= ball_threshold(max_tilt)) & (weights > 0)
    voters, candidates, centers = np.count_nonzero(voting), len(covering_grid()), len(cover.centers)
    return Work(
        voters * candidates * (3 + centers) + len(metrics) * 3 * (centers + 1),
        metrics.nbytes + cover.labels.nbytes,
    )


def warp_work(warped: GrayImage, image: GrayImage, rectification: Rectification) -> Work:
    """Interpolate as many rows as the compressed axis has px, and blur along it."""
    del image
    compression = rectification.tilt if rectification.is_affine else 1.0
    density = math.ceil(compression - 1e-9)
    sigma_px = ANTI_ALIASING_SIGMA * math.sqrt(max(compression**2 - 1.0, 0.0))
    blur_taps = 2 * math.ceil(3.0 * sigma_px * density / compression) + 1 if sigma_px else 0
    shrinking = abs(np.linalg.det(rectification.rectified_from_image[:2, :2]))
    return Work(
        warped.size * (BILINEAR_TAPS * density + blur_taps),
        warped.size * (1.0 + 1.0 / shrinking),
    )


def mask_work(mask: NDArray[np.uint8], *_: Any) -> Work:
    """Pick and write a byte per pixel."""
    return Work(num_bytes=2.0 * mask.size)


def scale_space_work(num_pixels: int, options: DogOptions) -> Work:
    """Blur each level of a doubled image from the last, subtract, look for extrema."""
    layers = options.num_octave_layers
    factor = 2.0 ** (1.0 / layers)
    sigmas_px = [options.sigma_px * factor**k for k in range(layers + 2)]
    steps_px = [sigma * math.sqrt(factor**2 - 1.0) for sigma in sigmas_px]
    per_pixel = sum(2 * gaussian_taps(step) for step in steps_px)
    per_pixel += layers + 2 + layers * EXTREMUM_NEIGHBORS
    pixels = DOUBLED * OCTAVES * num_pixels
    num_levels = (layers + 3) + (layers + 2)
    return Work(pixels * per_pixel, pixels * num_levels * 2 * FLOAT_BYTES)


def rootsift_work(found: LocalFeatures, profile: RootSift, view: View) -> Work:
    """Search the scale space."""
    del found
    return scale_space_work(view[0].size, profile.options)


def sift_description_work(described: Sequence[LocalFeatures], *_: Any) -> Work:
    """Histograms of the gradients under the windows of the features that stay."""
    count = sum(len(features) for features in described)
    return Work(count * DESCRIPTOR_SAMPLES * DESCRIPTOR_OPERATIONS)


def learned_detection_work(found: LocalFeatures, profile: Any, view: View) -> Work:
    """Scale space; the detectors of kornia are not counted."""
    del found
    if profile.options.detector != "dog":
        return Work()
    return scale_space_work(view[0].size, profile.options)


def network_work(_: Any, network: Any, patches: Any) -> Work:
    """Run a network on (N, 1, 32, 32) patches."""
    per_patch = convolution_multiply_adds(network, patches.shape[-1])
    return Work(len(patches) * per_patch, FLOAT_BYTES * patches.numel())


def description_work(
    described: Sequence[LocalFeatures], profile: Any, images: Sequence[GrayImage], *_: Any
) -> Work:
    """Run the descriptor on a patch of 32 x 32 px for each feature."""
    del images
    count = sum(len(features) for features in described)
    per_patch = convolution_multiply_adds(profile.descriptor, 32)
    return Work(count * per_patch, count * 32 * 32 * FLOAT_BYTES)


def convolution_multiply_adds(network: Any, size_px: int) -> int:
    """Count the multiply-adds of the convolutions of a network without branches.

    Args:
        network: torch module whose layers come in the order in which they run.
        size_px: side of its square input.
    """
    from torch import nn

    total = 0
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            kernel = layer.kernel_size[0]
            size_px = (size_px + 2 * int(layer.padding[0]) - kernel) // layer.stride[0] + 1
            per_pixel = layer.out_channels * layer.in_channels // layer.groups * kernel**2
            total += per_pixel * size_px**2
        elif isinstance(layer, nn.MaxPool2d):
            size_px //= int(layer.stride)
    return total


def matching_work(num_features1: int, num_features2: int, descriptor_size: int) -> Work:
    """All products of two sets of descriptors, which need not leave the cache."""
    return Work(
        float(num_features1) * num_features2 * descriptor_size,
        FLOAT_BYTES * descriptor_size * (num_features1 + num_features2),
    )
