"""Execute a rectification plan: warp, detect, map back into the image, select, describe, merge."""

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
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS, is_inside
from colmap_affrect.geometry.neighbors import neighbors_within
from colmap_affrect.images.warping import mask_values, warp, warp_mask

DUPLICATE_RADIUS_SIGMAS = 0.5
"""Distance of the same feature in the image and in a warp, in its sigmas; judged."""
MAX_DUPLICATE_RADIUS_PX = 4.0
"""Largest such distance that is searched: larger features rarely have a duplicate; resource."""
SAME_SCALE_RATIO = 2 ** (1 / 3)
"""Ratio of the scales of duplicates: one layer of a scale space with three layers per octave
(theory)."""


def extract_rectified(
    image: GrayImage | ColorImage,
    plan: RectificationPlan,
    extractor: FeatureExtractor,
    max_num_rectified: int,
    *,
    with_original: bool = True,
    mask: Mask | None = None,
) -> LocalFeatures:
    """Return the features of the image and of all planned warps, LAFs in image px.

    Only features that are kept are described, and all of them in one call.

    Args:
        image: (H, W) or (H, W, 3) uint8, as the extractor asks.
        plan: warps of the image.
        extractor: detects and describes.
        max_num_rectified: features of warps that are kept, those of the largest responses.
        with_original: whether features of the image itself are extracted.
        mask: (H, W) bool, where features may be.

    Returns:
        Described features; ``rectification_ids`` are 0 for the image, and numbers of warps from 1.
    """
    warps: list[Rectification | None] = [None] if with_original else []
    warps += plan.items
    if not warps:
        return LocalFeatures.empty(extractor.descriptor_size)
    views = _views(image, warps, mask)
    detected = [extractor.detect(view) for view in views]
    keep = _kept(detected, warps, plan, max_num_rectified)
    selected = list[LocalFeatures]()
    for features, kept in zip(detected, keep, strict=True):
        selected.append(features.select(kept))
    images = [view[0] for view in views]
    described = extractor.describe(images, selected)
    first_id = 0 if with_original else 1
    of_views = zip(described, warps, strict=True)
    parts = list[LocalFeatures]()
    for number, (features, rectification) in enumerate(of_views, first_id):
        mapped = _mapped_back(features, rectification)
        parts.append(mapped.with_rectification_id(number))
    return union(parts)


def _views(
    image: GrayImage | ColorImage, warps: list[Rectification | None], mask: Mask | None
) -> list[View]:
    """Return the image (for None) and its warps, each with its mask."""
    source = image.astype(np.float32)
    views: list[View] = []
    for item in warps:
        if item is None:
            views.append((image, None if mask is None else mask_values(mask)))
        else:
            views.append((warp(source, item), _warped_mask(item, mask, image.shape)))
    return views


def _warped_mask(
    rectification: Rectification, mask: Mask | None, image_shape: tuple[int, ...]
) -> Bytes:
    """Return where a warp shows its region, without what an (H, W) mask of the image excludes."""
    image_size = (image_shape[1], image_shape[0])
    inside = warp_mask(rectification, image_size)
    if mask is None:
        return inside
    whole_image = replace(rectification, region=mask, region_origin=(0, 0))
    return np.minimum(inside, warp_mask(whole_image, image_size))


def _mapped_back(
    features: LocalFeatures, rectification: Rectification | None
) -> LocalFeatures:
    """Map LAFs of a warp back into the image; those of the image itself (None) stay."""
    if rectification is None:
        return features
    lafs = transform_lafs(rectification.image_from_rectified, features.lafs)
    return replace(features, lafs=lafs)


def _kept(
    detected: list[LocalFeatures],
    warps: list[Rectification | None],
    plan: RectificationPlan,
    max_num_rectified: int,
) -> list[Mask]:
    """Return which features of each view are kept.

    Args:
        detected: features of each view, LAFs in its px.
        warps: that the views are of, None for the image itself.
        plan: of all warps.
        max_num_rectified: features of warps that are kept, those of the largest responses.

    Returns:
        (N,) bool for each view.
    """
    mapped = []
    keep = []
    for features, rectification in zip(detected, warps, strict=True):
        mapped.append(_mapped_back(features, rectification))
        keep.append(_is_usable(mapped[-1], rectification, plan))
    with_original = warps[0] is None
    first_warp = 1 if with_original else 0
    _keep_strongest(keep[first_warp:], mapped[first_warp:], max_num_rectified)
    if with_original and plan.replaces_original and plan.items:
        pairs = zip(mapped[1:], keep[1:], strict=True)
        rectified = union([features.select(kept) for features, kept in pairs])
        keep[0] &= ~is_in_warp(mapped[0], rectified)
    return keep


def _is_usable(
    features: LocalFeatures,
    rectification: Rectification | None,
    plan: RectificationPlan,
) -> Mask:
    """Return which features, LAFs in image px, belong to their part of the image.

    Measurement regions of features of warps must be inside the image: outside, a warp shows
    invented content.
    """
    if rectification is None:
        if plan.original_region is None:
            return np.ones(len(features), dtype=bool)
        return in_mask(plan.original_region, features.keypoints)
    extents = ellipse_extents(features.lafs[:, :, :2])
    in_image = is_inside(features.keypoints, plan.image_size, extents)
    return np.asarray(in_image & rectification.in_region(features.keypoints))


def _keep_strongest(
    keep: list[Mask], features: list[LocalFeatures], limit: int
) -> None:
    """Clear in ``keep`` all but the ``limit`` strongest features of several views.

    Args:
        keep: (N,) bool for each view, which are changed.
        features: of each view.
        limit: features that are kept of all views together.
    """
    if not keep:
        return
    responses = np.concatenate([part.responses for part in features])
    candidates = np.flatnonzero(np.concatenate(keep))
    order = np.argsort(-responses[candidates], kind="stable")
    is_weak = np.zeros(len(responses), dtype=bool)
    is_weak[candidates[order[limit:]]] = True
    begin = 0
    for kept in keep:
        kept[is_weak[begin : begin + len(kept)]] = False
        begin += len(kept)


def is_in_warp(original: LocalFeatures, rectified: LocalFeatures) -> Mask:
    """Return which features of the image itself a warp has too, at the same position and scale.

    Centres are within half a sigma and scales within ``SAME_SCALE_RATIO``, whatever the
    orientation. The feature of the warp is the better one: its residual tilt is smaller.
    """
    found = np.zeros(len(original), dtype=bool)
    if not len(original) or not len(rectified):
        return found
    points = np.concatenate([original.keypoints, rectified.keypoints])
    radii = DUPLICATE_RADIUS_SIGMAS / MEASUREMENT_SIGMAS * original.scales
    search_radius = min(float(radii.max()), MAX_DUPLICATE_RADIUS_PX)
    rows, others = neighbors_within(points, search_radius).of(np.arange(len(original)))
    is_rectified = others >= len(original)
    rows = rows[is_rectified]
    others = others[is_rectified] - len(original)
    offsets = original.keypoints[rows] - rectified.keypoints[others]
    is_near = np.linalg.norm(offsets, axis=1) < radii[rows]
    log_ratios = np.log(original.scales[rows] / rectified.scales[others])
    is_same_scale = np.abs(log_ratios) < np.log(SAME_SCALE_RATIO)
    found[rows[is_near & is_same_scale]] = True
    return found
