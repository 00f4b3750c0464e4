"""Straight segments of a photograph, by OpenCV's line segment detector (von Gioi et al., 2010)."""

from typing import Any

import cv2
import numpy as np

from colmap_affrect.data import GrayImage, Mask
from colmap_affrect.geometry.arrays import Bools, Floats
from colmap_affrect.geometry.conventions import colmap_from_pixel
from colmap_affrect.geometry.lines import Lines, measure_lines
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.images.reading import shrink_to

# Longest side that photographs are shrunk to: lines stay, and grain goes; resource
MAX_SIZE_PX = 1024
MIN_LENGTH = 0.02  # longer sides; judged
# Longer sides; segments along the image's border and closer are of its frame; judged
BORDER = 0.025
ALONG = 0.05  # rad, of a segment that runs along the border; theory


def lines_of(image: GrayImage, mask: Mask | None = None) -> Lines:
    """Return the straight lines of a photograph and what they say of its camera.

    Args:
        image: (H, W) gray values.
        mask: (H', W') where segments may be; None: everywhere.
    """
    return measure_lines(segments_of(image, mask))


def segments_of(image: GrayImage, mask: Mask | None = None) -> Segments:
    """Find the straight segments of a photograph, without frames at its border.

    Args:
        image: (H, W) gray values.
        mask: (H', W') where segments may be; None: everywhere.

    Returns:
        The longest segments.
    """
    small = shrink_to(image, MAX_SIZE_PX)
    height, width = small.shape
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(small)[0]
    if found is None:
        return Segments.of_image(np.zeros((0, 4)), (width, height))
    ends = found.reshape(-1, 4).astype(np.float64)
    longer_side = max(width, height)
    lengths = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    keep = lengths > MIN_LENGTH * longer_side
    keep &= ~_on_frame(ends, lengths, size=(width, height))
    if mask is not None:
        keep &= _in_mask(ends, mask, size=(width, height))
    return Segments.of_image(ends[keep], (width, height))


def _on_frame(ends: Floats, lengths: Floats, size: tuple[int, int]) -> Bools:
    """Return which (N, 4) segments run along the border of the image, close to it."""
    margin = BORDER * max(size)
    is_on_frame = np.zeros(len(ends), np.bool_)
    for axis, length in enumerate(size):
        across = ends[:, [axis, axis + 2]]
        is_along = np.abs(across[:, 1] - across[:, 0]) < ALONG * lengths
        is_near = (across.max(axis=1) < margin) | (
            across.min(axis=1) > length - 1 - margin
        )
        is_on_frame |= is_along & is_near
    return is_on_frame


def _in_mask(ends: Floats, mask: Mask, size: tuple[int, int]) -> Bools:
    """Return which (N, 4) segments have their middle where the mask allows."""
    middles = (ends[:, :2] + ends[:, 2:]) / 2.0
    scale = np.array([mask.shape[1], mask.shape[0]]) / size
    places = np.floor(colmap_from_pixel(middles) * scale).astype(np.int64)
    places = np.clip(places, 0, [mask.shape[1] - 1, mask.shape[0] - 1])
    return mask[places[:, 1], places[:, 0]]
