"""Masks: where photographs count, from files, from transparency; shrunk and grown."""

from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags

from colmap_affrect.data import Mask
from colmap_affrect.images.reading import decode, open_image, read_header

MODES_WITH_ALPHA = ("RGBA", "RGBa", "LA", "La", "PA")  # Pillow's


def read_mask(path: Path) -> Mask:
    """Read a mask, black pixels False (COLMAP's convention); ImageError when that fails."""
    return np.asarray(decode(path) != 0)


def alpha_mask(path: Path) -> Mask | None:
    """Return where a photograph is not transparent, (H, W); None where it is nowhere, or all over.

    Half transparent is transparent: edges are mixed with what was cut off. An alpha channel that is
    0 all over is one that a program has left empty. ImageError when the file cannot be read.
    """
    if not read_header(path, _has_alpha):
        return None
    image = decode(path, cv2.IMREAD_UNCHANGED)
    is_there = image.ndim == 3 and image.shape[2] == 4
    alpha = image[:, :, 3] if is_there else read_header(path, _alpha_beside_gray)
    if alpha is None:
        return None
    is_integer = np.issubdtype(alpha.dtype, np.integer)
    half = np.iinfo(alpha.dtype).max / 2 if is_integer else 0.5
    mask = np.asarray(alpha > half)
    return mask if mask.any() and not mask.all() else None


def _alpha_beside_gray(file: BinaryIO) -> NDArray[Any] | None:
    """Read the alpha channel of a gray TIFF, which OpenCV drops; None of one that Pillow turns."""
    image = open_image(file)
    if image.getexif().get(ExifTags.Base.Orientation, 1) != 1:
        return None
    return np.asarray(image.convert("RGBA").getchannel("A"))


def _has_alpha(file: BinaryIO) -> bool:
    image = open_image(file)
    return image.mode in MODES_WITH_ALPHA or "transparency" in image.info


def encode_mask(mask: Mask) -> bytes:
    """Return an (H, W) mask as PNG, white where it is True."""
    return cv2.imencode(".png", mask.astype(np.uint8) * np.uint8(255))[1].tobytes()


def shrink_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """Resize an (H, W) mask to (width, height) px, each pixel from the nearest one."""
    resized = cv2.resize(
        mask.astype(np.uint8),
        dsize=size,
        interpolation=cv2.INTER_NEAREST_EXACT,
    )
    return np.asarray(resized > 0)


def grow_mask(mask: Mask, num_px: int) -> Mask:
    """Add the pixels of an (H, W) mask's surroundings, so many in each direction."""
    kernel = np.ones((2 * num_px + 1, 2 * num_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)
