"""Reading of image files and encoding of pictures, through OpenCV."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect import PYCOLMAP_CAME_FIRST
from colmap_affrect.data import ColorImage, GrayImage
from colmap_affrect.errors import ImageError

IMAGE_SUFFIXES = (
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".pbm", ".pgm", ".pnm",
    ".ppm",
)  # fmt: skip
"""Formats that both this package and pycolmap's wheel can read, lower case."""

OTHER_IMAGE_SUFFIXES = (
    ".webp", ".gif", ".avif", ".heic", ".heif", ".jp2", ".jxl", ".tga", ".exr", ".hdr", ".psd",
    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2",
)  # fmt: skip
"""Formats of photographs that one of the two cannot read, lower case."""

FOREIGN_FORMATS = {
    "WebP": rb"RIFF....WEBP",
    "GIF": rb"GIF8",
    "JPEG 2000": rb"\x00\x00\x00\x0cjP  |\xff\x4f\xff\x51",
    "JPEG XL": rb"\x00\x00\x00\x0cJXL |\xff\x0a",
    "AVIF or HEIF": rb"....ftyp(avi|hei|hev|mif|msf)",
}
"""Patterns of the first bytes of formats that OpenCV may read, whatever the suffix, and pycolmap's
wheel does not."""


def read_gray(path: Path) -> GrayImage:
    """Read an image as gray, as stored: EXIF orientation is not applied, 16 bit becomes 8.

    Raises ImageError when the file is missing, empty, or not an image.
    """
    image = decode(path)
    if image.dtype == np.uint16:
        image = image // 257
    elif image.dtype != np.uint8:
        image = np.nan_to_num(np.clip(image, 0.0, 1.0)) * 255.0
    return np.ascontiguousarray(image, dtype=np.uint8)


def read_color(path: Path, max_size_px: int) -> ColorImage:
    """Read an image in colour, as stored, its longer side shrunk to at most ``max_size_px``.

    EXIF orientation is not applied. Raises ImageError as :func:`read_gray`.
    """
    image: NDArray[np.generic] = np.zeros((0, 0))
    if path.suffix.lower() in (".jpg", ".jpeg"):  # an eighth is decoded several times faster
        image = decode(path, cv2.IMREAD_REDUCED_COLOR_8 | cv2.IMREAD_IGNORE_ORIENTATION)
    if max(image.shape) < max_size_px:
        image = decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return shrink_to(np.ascontiguousarray(image[:, :, ::-1], dtype=np.uint8), max_size_px)


def encode_jpeg(image: GrayImage | ColorImage, quality: int) -> bytes:
    """Return an (H, W) or (H, W, 3) uint8 image as JPEG; quality is 0 to 100."""
    ordered = image[:, :, ::-1] if image.ndim == 3 else image
    return cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def require_png() -> None:
    """Check that this process can write PNG, before work that ends with pictures.

    ImageError when it imported pycolmap before this package: compressing would kill it.
    """
    if PYCOLMAP_CAME_FIRST:
        raise ImageError(
            "pictures cannot be written in a script that imports pycolmap first; put "
            '"import colmap_affrect" before "import pycolmap"'
        )


GRAY_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def decode(path: Path, flags: int = GRAY_AS_STORED) -> NDArray[np.generic]:
    """Read an image, by default as gray in the type it is stored in; ImageError if it is none."""
    if path.exists() and not path.is_file():
        raise ImageError(f"{path}: is not a file")
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    for name, pattern in FOREIGN_FORMATS.items():
        if re.match(pattern, data[:16].tobytes(), re.DOTALL):
            raise ImageError(
                f"{path}: is a {name} file, a format that COLMAP cannot read; convert it to PNG or "
                "JPEG"
            )
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:  # for one, of more pixels than OpenCV takes
        image = None
    if image is None:
        raise ImageError(f"{path}: not a readable image (damaged, empty, or of an unknown format)")
    return np.asarray(image)


def shrink_to(image: NDArray[np.uint8], max_size_px: int) -> NDArray[np.uint8]:
    """Shrink an (H, W) or (H, W, 3) image, by area averaging, until no side is longer."""
    height, width = image.shape[:2]
    scale = max_size_px / max(width, height)
    if scale >= 1.0:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
