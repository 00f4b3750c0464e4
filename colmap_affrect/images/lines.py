"""Straight segments of a photograph, by OpenCV's line segment detector (von Gioi et al., 2010)."""

from typing import Any

import cv2
import numpy as np

from colmap_affrect.data import GrayImage, Mask
from colmap_affrect.geometry.arrays import Bools, Floats
from colmap_affrect.geometry.conventions import colmap_from_pixel
from colmap_affrect.geometry.lines import DOWN, Lines, measure_lines
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.images.reading import shrink_to

# Longest side that photographs are shrunk to: lines stay, and grain goes; resource
MAX_SIZE_PX = 1024
MIN_LENGTH = 0.02  # longer sides; judged
# Longer sides; segments along the image's border and closer are of its frame; judged
BORDER = 0.025
ALONG = 0.05  # rad, of a segment that runs along the border; theory


def lines_of(
    image: GrayImage, mask: Mask | None = None, down: tuple[float, float] = DOWN
) -> Lines:
    """Return the straight lines of a photograph and what they say of its camera.

    Args:
        image: (H, W) gray values.
        mask: (H', W') where segments may be; None: everywhere.
        down: downwards in the picture, right and down in the image as stored.
    """
    return measure_lines(segments_of(image, mask), down)


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
    across = ends[:, 2] - ends[:, 0]
    down = ends[:, 3] - ends[:, 1]
    lengths = np.hypot(across, down)
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
        starts = ends[:, axis]
        stops = ends[:, axis + 2]
        is_along = np.abs(stops - starts) < ALONG * lengths
        is_near_first = np.maximum(starts, stops) < margin
        is_near_last = np.minimum(starts, stops) > length - 1 - margin
        is_on_frame |= is_along & (is_near_first | is_near_last)
    return is_on_frame


def _in_mask(ends: Floats, mask: Mask, size: tuple[int, int]) -> Bools:
    """Return which (N, 4) segments have their middle where the mask allows."""
    middles = (ends[:, :2] + ends[:, 2:]) / 2.0
    height, width = mask.shape
    scale = np.array([width, height]) / size
    pixels = np.floor(colmap_from_pixel(middles) * scale).astype(np.int64)
    columns = np.clip(pixels[:, 0], 0, width - 1)
    rows = np.clip(pixels[:, 1], 0, height - 1)
    return mask[rows, columns]
