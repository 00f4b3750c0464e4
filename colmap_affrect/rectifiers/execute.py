"""Execute a rectification plan: warp, detect, carry back, choose, describe, unite."""

from dataclasses import replace

import numpy as np

from colmap_affrect.data import (
    ColorImage,
    GrayImage,
    LocalFeatures,
    Mask,
    Rectification,
    RectificationPlan,
    View,
    in_mask,
    union,
)
from colmap_affrect.features.base import FeatureExtractor
from colmap_affrect.geometry.affine import ellipse_extents, transform_lafs
from colmap_affrect.geometry.arrays import Singles
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS, is_inside
from colmap_affrect.geometry.neighbors import neighbors_within
from colmap_affrect.images.warping import mask_values, warp, warp_mask

DUPLICATE_RADIUS_SIGMAS = 0.5
MAX_DUPLICATE_RADIUS_PX = 4.0
SAME_SCALE_RATIO = 2 ** (1 / 3)  # one layer of a scale space with three layers per octave


def extract_rectified(
    image: GrayImage | ColorImage,
    plan: RectificationPlan,
    extractor: FeatureExtractor,
    max_num_rectified: int,
    *,
    with_original: bool = True,
    mask: Mask | None = None,
) -> LocalFeatures:
    """Return the features of the image and of all planned warps, frames in image px.

    Of the features in warps the ``max_num_rectified`` strongest are kept, and those of the image
    itself only ``with_original``. Only what stays is described, and all of it in one call. The
    image is (H, W[, 3]) uint8, as the extractor asks; the mask (H, W) bool, where features may be.
    """
    rectifications: list[Rectification | None] = [None] if with_original else []
    rectifications += plan.items
    if not rectifications:
        return LocalFeatures.empty(extractor.descriptor_size)
    whole = image, None if mask is None else mask_values(mask)
    source = image.astype(np.float32)
    views = [whole if item is None else _warped(source, item, mask) for item in rectifications]
    detected = [extractor.detect(view) for view in views]
    carried = [_carried(*pair) for pair in zip(detected, rectifications, strict=True)]
    keep = [_usable(*pair, plan) for pair in zip(carried, rectifications, strict=True)]
    first_id = 0 if with_original else 1
    _keep_strongest(keep[1 - first_id :], carried[1 - first_id :], max_num_rectified)
    if with_original and plan.replaces_original and plan.items:
        kept = [part.select(mask) for part, mask in zip(carried, keep, strict=True)]
        keep[0] &= ~found_again(carried[0], union(kept[1:]))
    chosen = [features.select(kept) for features, kept in zip(detected, keep, strict=True)]
    described = extractor.describe([view[0] for view in views], chosen)
    carried = [_carried(*pair) for pair in zip(described, rectifications, strict=True)]
    numbered = enumerate(carried, first_id)
    return union([features.with_rectification_id(number) for number, features in numbered])


def _warped(source: Singles, rectification: Rectification, mask: Mask | None) -> View:
    size = (source.shape[1], source.shape[0])
    inside = warp_mask(rectification, size)
    if mask is not None:
        unmasked = replace(rectification, region=mask, region_origin=(0, 0))
        inside = np.minimum(inside, warp_mask(unmasked, size))
    return warp(source, rectification), inside


def _carried(features: LocalFeatures, rectification: Rectification | None) -> LocalFeatures:
    if rectification is None:
        return features
    lafs = transform_lafs(rectification.image_from_rectified, features.lafs)
    return replace(features, lafs=lafs)


def _usable(
    features: LocalFeatures, rectification: Rectification | None, plan: RectificationPlan
) -> Mask:
    """Return which features, frames in image px, belong to their part of the image.

    Measurement regions of a warp's must be inside: what lies outside is invented by the warp.
    """
    if rectification is None:
        if plan.original_region is None:
            return np.ones(len(features), dtype=bool)
        return in_mask(plan.original_region, features.keypoints)
    extents = ellipse_extents(features.lafs[:, :, :2])
    inside = is_inside(features.keypoints, plan.image_size, extents)
    return np.asarray(inside & rectification.in_region(features.keypoints))


def _keep_strongest(keep: list[Mask], features: list[LocalFeatures], limit: int) -> None:
    """Clear in ``keep`` all but the ``limit`` strongest of the features of several views."""
    if not keep:
        return
    responses = np.concatenate([part.responses for part in features])
    candidates = np.flatnonzero(np.concatenate(keep))
    weak = np.zeros(len(responses), dtype=bool)
    weak[candidates[np.argsort(-responses[candidates], kind="stable")[limit:]]] = True
    for mask, part in zip(keep, np.split(weak, np.cumsum(list(map(len, keep)))[:-1]), strict=True):
        mask[part] = False


def found_again(original: LocalFeatures, rectified: LocalFeatures) -> Mask:
    """Return which features of the image itself a warp shows at the same place and scale.

    Centres are within half a sigma and scales within ``SAME_SCALE_RATIO``, whatever the
    orientation. The rectified one stays: in its region its residual tilt is smaller.
    """
    scales1, scales2 = original.scales, rectified.scales
    radius = DUPLICATE_RADIUS_SIGMAS / MEASUREMENT_SIGMAS * scales1
    again = np.zeros(len(original), dtype=bool)
    if not len(original) or not len(rectified):
        return again
    points = np.concatenate([original.keypoints, rectified.keypoints])
    # Larger frames than this have no counterpart worth the search for it.
    neighbors = neighbors_within(points, min(float(radius.max()), MAX_DUPLICATE_RADIUS_PX))
    rows, others = neighbors.of(np.arange(len(original)))
    between = others >= len(original)
    rows, others = rows[between], others[between] - len(original)
    distances = np.linalg.norm(original.keypoints[rows] - rectified.keypoints[others], axis=1)
    same_scale = np.abs(np.log(scales1[rows] / scales2[others])) < np.log(SAME_SCALE_RATIO)
    again[rows[(distances < radius[rows]) & same_scale]] = True
    return again
