"""Features of one image file by the options of a recipe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import resized_from_original
from colmap_affrect.features.rootsift import extract_rootsift
from colmap_affrect.features.second_moment import second_moment_shapes
from colmap_affrect.geometry.affine import transform_frames
from colmap_affrect.imaging import read_gray, shrink_to
from colmap_affrect.options import ExtractionOptions
from colmap_affrect.rectified import extract_rectified
from colmap_affrect.rectifiers.dense_shapes import plan_dense_shapes
from colmap_affrect.types import GrayImage, LocalFeatures, RectificationPlan

MIN_RECTIFIABLE_PX = 32
"""Images with a shorter side are not rectified: no block would see its surroundings."""


def extract_file(path: Path, options: ExtractionOptions) -> tuple[LocalFeatures, tuple[int, int]]:
    """Read an image and extract its features.

    Returns:
        Features with frames in px of the stored image, and its (width, height).

    Raises:
        ImageError: when the file cannot be read.
    """
    image = read_gray(path)
    original_size = (image.shape[1], image.shape[0])
    image = shrink_to(image, options.max_image_size_px)
    features = extract_image(image, options)
    size = (image.shape[1], image.shape[0])
    if size != original_size:
        original_from_resized = np.linalg.inv(resized_from_original(original_size, size))
        lafs = transform_frames(original_from_resized, features.lafs)
        features = features.with_frames(lafs)
    return features.select(features.inside(original_size)), original_size


def extract_image(image: GrayImage, options: ExtractionOptions) -> LocalFeatures:
    """Plan the rectifications of a (H, W) uint8 image and extract its features."""

    def extract(view: GrayImage, mask: NDArray[np.uint8] | None) -> LocalFeatures:
        return extract_rootsift(view, options.features, mask)

    plan = plan_rectifications(image, options)
    return extract_rectified(image, plan, extract, options.features.max_num_rectified_features)


def plan_rectifications(image: GrayImage, options: ExtractionOptions) -> RectificationPlan:
    """Decide which warps of a (H, W) uint8 image to look at."""
    size = (image.shape[1], image.shape[0])
    if options.rectifier.name == "identity" or min(size) < MIN_RECTIFIABLE_PX:
        return RectificationPlan(size, ())
    shapes = second_moment_shapes(image, options.second_moment)
    return plan_dense_shapes(shapes, size, options.rectifier)
