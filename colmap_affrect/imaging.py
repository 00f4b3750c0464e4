"""Images: reading, and exact anti-aliased warps (the home of OpenCV's image functions)."""

from __future__ import annotations

from math import ceil, sqrt
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import ImageError
from colmap_affrect.types import GrayImage, Mask, Rectification

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")
"""Formats that both this package and pycolmap's wheel can read, lower case."""

ANTI_ALIASING_SIGMA = 0.8
"""Blur before a compression by c: sigma = 0.8 sqrt(c^2 - 1) source px (Morel & Yu, ASIFT)."""


def read_gray(path: Path) -> GrayImage:
    """Read an image as gray, as stored: EXIF orientation is not applied, 16 bit becomes 8.

    Raises:
        ImageError: when the file is missing, empty, or not an image.
    """
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise ImageError(f"{path}: not a readable image (damaged, empty, or of an unknown format)")
    if image.dtype == np.uint16:
        image = image // 257
    elif image.dtype != np.uint8:
        image = np.clip(image, 0.0, 1.0) * 255.0
    return np.ascontiguousarray(image, dtype=np.uint8)


def shrink_to(image: GrayImage, max_size_px: int) -> GrayImage:
    """Shrink an image, by area averaging, until its longer side is at most ``max_size_px``."""
    height, width = image.shape
    scale = max_size_px / max(width, height)
    if scale >= 1.0:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def warp(image: GrayImage, rectification: Rectification) -> GrayImage:
    """Render a rectification whose map is diag(sx, sy) R(phi) + translation, sx >= 1 >= sy.

    The image is resampled once, on rows that are ``ceil(1/sy)`` times denser than those
    of the result, blurred along the compressed axis and decimated by that integer. So
    rows are picked, never interpolated again, and the map is exact. Outside the image
    its border is reflected.
    """
    matrix = rectification.rectified_from_image
    width, height = rectification.canvas_size
    compression = 1.0 / float(np.hypot(*matrix[1, :2]))
    density = max(1, ceil(compression - 1e-9))
    dense_from_image = np.diag([1.0, density, 1.0]) @ matrix
    dense = cv2.warpAffine(
        image.astype(np.float32),  # rounding to 8 bits in between shifts edges by up to 0.1 px
        dense_from_image[:2],
        (width, (height - 1) * density + 1),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    sigma_px = ANTI_ALIASING_SIGMA * sqrt(max(compression**2 - 1.0, 0.0)) * density / compression
    if sigma_px > 0.0:
        dense = cv2.GaussianBlur(dense, (1, 2 * ceil(3 * sigma_px) + 1), sigma_px)
    return np.asarray(np.rint(dense[::density]), dtype=np.uint8)


def warp_mask(rectification: Rectification) -> NDArray[np.uint8]:
    """Carry the region of a rectification into its warp (nearest; 255 inside, 0 outside)."""
    image_from_mask = np.eye(3)
    image_from_mask[:2, 2] = rectification.region_origin
    rectified_from_mask = rectification.rectified_from_image @ image_from_mask
    return np.asarray(
        cv2.warpAffine(
            rectification.region.astype(np.uint8) * 255,
            rectified_from_mask[:2],
            rectification.canvas_size,
            flags=cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=0,
        ),
        dtype=np.uint8,
    )


def connected_groups(mask: Mask, gap: int) -> list[Mask]:
    """Split an (H, W) mask into groups of pixels that are at most ``gap`` - 1 px apart."""
    joined = cv2.dilate(mask.astype(np.uint8), np.ones((gap, gap), np.uint8))
    num_groups, groups = cv2.connectedComponents(joined, connectivity=8)
    return [mask & (groups == group) for group in range(1, num_groups)]
