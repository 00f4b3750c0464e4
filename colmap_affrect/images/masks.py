"""Masks: where features may be, and connected parts of an image."""

from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.data import Mask
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.images.reading import decode


def read_mask(path: Path) -> Mask:
    """Read a mask, black pixels False (COLMAP's convention); ImageError when that fails."""
    return np.asarray(decode(path) != 0)


def shrink_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """Resize an (H, W) mask to (width, height) px, each pixel from the nearest one."""
    values = mask.astype(np.uint8)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT) > 0)


def mask_values(mask: Mask) -> Bytes:
    """Return an (H, W) mask as uint8, 255 inside and 0 outside."""
    return mask.astype(np.uint8) * 255


def connected_regions(mask: Mask, min_area_px: float) -> list[tuple[Mask, tuple[int, int]]]:
    """Crop the 4-connected regions that have enough pixels; return each with its first (x, y)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    regions = []
    for label, (left, top, width, height, area) in enumerate(stats.tolist()):
        if label > 0 and area >= min_area_px:
            crop = labels[top : top + height, left : left + width] == label
            regions.append((crop, (left, top)))
    return regions


def grown(mask: Mask, num_px: int) -> Mask:
    """Add the pixels of an (H, W) mask's surroundings, so many in each direction."""
    kernel = np.ones((2 * num_px + 1, 2 * num_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def connected_groups(mask: Mask, gap: int) -> list[Mask]:
    """Split an (H, W) mask into groups of pixels that are at most ``gap`` - 1 px apart."""
    joined = cv2.dilate(mask.astype(np.uint8), np.ones((gap, gap), np.uint8))
    num_groups, groups = cv2.connectedComponents(joined, connectivity=8)
    return [mask & (groups == group) for group in range(1, num_groups)]
