"""Execute a rectification plan: warp, detect, describe, carry back, unite."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import MEASUREMENT_SIGMAS, is_inside
from colmap_affrect.geometry.affine import ellipse_extents, transform_frames
from colmap_affrect.geometry.neighbors import neighbors_within
from colmap_affrect.imaging import warp, warp_mask
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Rectification,
    RectificationPlan,
    union,
)

Extractor = Callable[[GrayImage, NDArray[np.uint8] | None], LocalFeatures]
"""Detect and describe in an image, where the mask is not 0 (everywhere if it is None)."""

DUPLICATE_RADIUS_SIGMAS = 0.5
MAX_DUPLICATE_RADIUS_PX = 4.0
SAME_SCALE_RATIO = 2 ** (1 / 3)
"""One layer of a scale space with three layers per octave."""


def extract_rectified(
    image: GrayImage, plan: RectificationPlan, extract: Extractor, max_num_rectified: int
) -> LocalFeatures:
    """Return the features of the image and of all planned warps, frames in image px.

    Of the features in warps the ``max_num_rectified`` strongest are kept. A feature of
    the image that a warp found again gives way to it.
    """
    original = extract(image, None)
    warped = [
        _extract_in_warp(image, rectification, index + 1, extract)
        for index, rectification in enumerate(plan.items)
    ]
    if not warped:
        return original
    rectified = _strongest(union(warped), max_num_rectified)
    return union([original.select(~found_again(original, rectified)), rectified])


def found_again(original: LocalFeatures, rectified: LocalFeatures) -> NDArray[np.bool_]:
    """Tell which features of the image itself a warp shows at the same place and scale.

    Same means centres within half a sigma and scales within ``SAME_SCALE_RATIO`` in the
    image, whatever the orientation. A warp's region holds just those pixels whose shape is
    nearer to the class of the warp than to the identity, so of the two the residual tilt of
    the rectified feature is the smaller one, and the one to keep.
    """
    scales1, scales2 = original.scales, rectified.scales
    radius = DUPLICATE_RADIUS_SIGMAS / MEASUREMENT_SIGMAS * scales1
    again = np.zeros(len(original), dtype=bool)
    if not len(original) or not len(rectified):
        return again
    points = np.concatenate([original.keypoints, rectified.keypoints])
    # Larger frames than this have no counterpart worth the search for it.
    search_px = min(float(radius.max()), MAX_DUPLICATE_RADIUS_PX)
    neighbors = neighbors_within(points, search_px)
    rows, others = neighbors.of(np.arange(len(original)))
    between = others >= len(original)
    rows, others = rows[between], others[between] - len(original)
    distances = np.linalg.norm(original.keypoints[rows] - rectified.keypoints[others], axis=1)
    same_scale = np.abs(np.log(scales1[rows] / scales2[others])) < np.log(SAME_SCALE_RATIO)
    again[rows[(distances < radius[rows]) & same_scale]] = True
    return again


def _strongest(features: LocalFeatures, limit: int) -> LocalFeatures:
    best = np.argsort(-features.responses, kind="stable")[:limit]
    return features.select(np.sort(best))


def _extract_in_warp(
    image: GrayImage, rectification: Rectification, rectification_id: int, extract: Extractor
) -> LocalFeatures:
    mask = warp_mask(rectification)
    features = extract(warp(image, rectification), mask)
    lafs = transform_frames(rectification.image_from_rectified, features.lafs)
    size = (image.shape[1], image.shape[0])
    keep = is_inside(lafs[:, :, 2], size, ellipse_extents(lafs[:, :, :2]))
    keep &= rectification.in_region(lafs[:, :, 2])
    return features.with_frames(lafs, rectification_id).select(keep)
