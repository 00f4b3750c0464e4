"""Reading of image files, by header before pixels, and encoding of pictures, through OpenCV."""

import math
import re
import struct
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import jpeg_factory
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import TiffImageFile

from colmap_affrect.data import ColorImage, GrayImage, Mask
from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.arrays import Bytes

MAX_NUM_PX = 1 << 29  # of a photograph; those of the largest cameras have 400 megapixels
ONE_AT_A_TIME = Lock()  # filters of warnings are of the process: threads would mix them up
PNG = b"\x89PNG\r\n\x1a\n"
READERS = {
    b"\xff\xd8": jpeg_factory,
    PNG: PngImageFile,
    b"II": TiffImageFile,
    b"MM": TiffImageFile,
    b"BM": BmpImageFile,
    b"P": PpmImageFile,
}
"""Pillow's by the first bytes: ``Image.open`` has a limit of pixels that photographs exceed."""
NEW_SUBFILE_TYPE, REDUCED = 254, 1  # TIFF's tag, and its bit of a smaller copy of another page

Found = TypeVar("Found")


def read_header(path: Path, read: Callable[[BinaryIO], Found]) -> Found | None:
    """Return what a function reads of a file, None if that fails in any way, or for a pipe."""
    if not path.is_file():  # a pipe would wait for ever
        return None
    try:
        with ONE_AT_A_TIME, warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # Pillow warns of broken EXIF
            return read(file)
    except Exception:  # noqa: BLE001 - damaged files raise nearly anything in Pillow
        return None


def opened(file: BinaryIO) -> Image.Image:
    """Open an image by its header; what is damaged raises nearly anything."""
    start = file.read(len(PNG))
    file.seek(0)
    return next(read for magic, read in READERS.items() if start.startswith(magic))(file, "")


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Return the (width, height) of the stored pixels; of TIFF Pillow turns what says so."""
    if isinstance(image, TiffImageFile):
        tags = image.tag_v2
        return int(tags[ExifTags.Base.ImageWidth]), int(tags[ExifTags.Base.ImageLength])
    return image.size


def pages(path: Path) -> list[int]:
    """Return the numbers of the pages of a TIFF without its previews; [0] of other files."""
    return read_header(path, _tiff_pages) or [0]


def _tiff_pages(file: BinaryIO) -> list[int]:
    image, found = opened(file), []
    if isinstance(image, TiffImageFile):
        for page in range(image.n_frames):
            image.seek(page)
            if not image.tag_v2.get(NEW_SUBFILE_TYPE, 0) & REDUCED:
                found.append(page)
    return found


def header_size(path: Path) -> tuple[int, int] | None:
    """Return the (width, height) that a file claims; None if it has no readable header."""
    return read_header(path, _claimed_size)


def _claimed_size(file: BinaryIO) -> tuple[int, int]:
    start = file.read(24)
    if start.startswith(PNG):
        return struct.unpack(">II", start[16:])
    file.seek(0)
    return stored_size(opened(file))


def is_too_large(size: tuple[int, int] | None) -> bool:
    """Return whether a header claims more pixels than photographs have."""
    return size is not None and size[0] * size[1] > MAX_NUM_PX


def require_possible(path: Path) -> None:
    """Refuse an image of more pixels than photographs have; ImageError."""
    size = header_size(path)
    if size and is_too_large(size):
        raise ImageError(
            f"{path}: claims to be {size[0]} x {size[1]} px, and {MAX_NUM_PX >> 20} megapixels are "
            "the most that are read; shrink it"
        )


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
"""First bytes of formats that OpenCV may read, whatever the suffix, and pycolmap's wheel not."""
TONE_PERCENTILES = (0.5, 99.5)  # black and white of a stretched photograph but for dust and glints
MIN_TONE_RANGE = 0.5  # a photograph whose tones fill less of the range of its file is stretched
MAX_TONE_STEP = 16  # neighbouring tones get no further apart, in steps of 8 bits: beyond is noise
NUM_TONES = 250_000  # about so many pixels are looked at
FRAME_FRAC = 0.1  # along each border is passed over: scans have frames and captions there
BIG_TIFF = 43  # what files of more than 4 GiB have in the place of 42, with offsets of 64 bits
GRAY_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
COLOR_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
EIGHTH_OF_COLOR = cv2.IMREAD_REDUCED_COLOR_8 | cv2.IMREAD_IGNORE_ORIENTATION  # fast, of JPEG


def read_gray(path: Path) -> GrayImage:
    """Read an image as 8-bit gray, without applying EXIF orientation; ImageError if it is none."""
    return in_eight_bits(decode(path))


def read_color(path: Path, max_size_px: int, *, stretch: bool = True) -> ColorImage:
    """Read an image in colour as :func:`read_gray`, shrunk to at most ``max_size_px``.

    With ``stretch`` low contrast fills the range (:func:`tones`).
    """
    size = header_size(path) if path.suffix.lower() in (".jpg", ".jpeg") else None
    is_far_larger = size is not None and max(size) >= 8 * max_size_px
    image = decode(path, EIGHTH_OF_COLOR if is_far_larger else COLOR_AS_STORED)[:, :, ::-1]
    return shrink_to(in_eight_bits(image, tones(image) if stretch else None), max_size_px)


def tones(image: NDArray[Any]) -> tuple[float, float] | None:
    """Return what is to be black and white of an (H, W[, 3]) image, None to leave it as it is."""
    height, width = image.shape[:2]
    y, x = int(FRAME_FRAC * height), int(FRAME_FRAC * width)
    inner = image[y : height - y, x : width - x]
    step = max(1, round(math.sqrt(inner.size / NUM_TONES)))
    low, high = np.nanpercentile(inner[::step, ::step], TONE_PERCENTILES)
    whole_numbers = np.issubdtype(image.dtype, np.integer)
    white = np.iinfo(image.dtype).max if whole_numbers else 1.0
    finest = 255 / MAX_TONE_STEP if whole_numbers else 0.0
    if not finest < high - low < MIN_TONE_RANGE * white:
        return None
    return float(low), float(high)


def in_eight_bits(image: NDArray[Any], black_and_white: tuple[float, float] | None = None) -> Bytes:
    """Return an image of 8 or 16 bits or of floats from 0 to 1 in 8 bits."""
    if black_and_white:
        low, high = black_and_white
        values = np.clip((image.astype(np.float32) - low) * (255.0 / (high - low)), 0.0, 255.0)
        image = np.nan_to_num(values).round()
    elif image.dtype == np.uint16:
        image = image // np.uint16(257)
    elif image.dtype != np.uint8:
        image = np.nan_to_num(np.clip(image.astype(np.float32), 0.0, 1.0)) * 255.0
    return np.ascontiguousarray(image, dtype=np.uint8)


def encode_jpeg(image: GrayImage | ColorImage, quality: int) -> bytes:
    """Return an (H, W) or (H, W, 3) uint8 image as JPEG; quality is 0 to 100."""
    ordered = image[:, :, ::-1] if image.ndim == 3 else image
    return cv2.imencode(".jpg", ordered, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def decode(path: Path, flags: int = GRAY_AS_STORED) -> NDArray[Any]:
    """Read an image, by default as gray in the type it is stored in; ImageError if it is none."""
    if path.exists() and not path.is_file():
        raise ImageError(f"{path}: is not a file")
    require_possible(path)
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    if name := foreign_format(path):
        raise ImageError(
            f"{path}: is of the format {name}, which COLMAP cannot read; convert it to PNG or "
            "JPEG (colmap-affrect convert)"
        )
    stand_upright(data)
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error:  # for one, of more pixels than OpenCV takes
        image = None
    if image is None:
        raise ImageError(f"{path}: not a readable image (damaged, empty, or of an unknown format)")
    return np.asarray(image)


def foreign_format(path: Path) -> str:
    """Return the format of a file that COLMAP cannot read, whatever its suffix, else nothing."""
    with path.open("rb") as file:
        beginning = file.read(16)
    matching = (n for n, p in FOREIGN_FORMATS.items() if re.match(p, beginning, re.DOTALL))
    return next(matching, "")


def stand_upright(data: Bytes) -> None:
    """Have the first picture of a TIFF stand upright: OpenCV turns it whatever the flags say.

    EXIF is laid out as a TIFF is.
    """
    order = {b"II": "<", b"MM": ">"}.get(data[:2].tobytes())
    if not order:
        return
    content = data.data
    with suppress(struct.error):  # damaged
        (version,) = struct.unpack_from(f"{order}H", content, 2)
        where, offset, number, size = (
            (8, "Q", "Q", 20) if version == BIG_TIFF else (4, "I", "H", 12)
        )
        (start,) = struct.unpack_from(order + offset, content, where)
        (count,) = struct.unpack_from(order + number, content, start)
        first = start + struct.calcsize(number)
        for entry in range(first, min(first + count * size, data.size), size):
            if struct.unpack_from(f"{order}H", content, entry) == (ExifTags.Base.Orientation,):
                struct.pack_into(f"{order}H", content, entry + size - struct.calcsize(offset), 1)


def shrink_to(image: Bytes, max_size_px: int) -> Bytes:
    """Shrink an (H, W) or (H, W, 3) image, by area averaging, until no side is longer."""
    height, width = image.shape[:2]
    scale = max_size_px / max(width, height)
    if scale >= 1.0:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def read_mask(path: Path) -> Mask:
    """Read a mask, black pixels False (COLMAP's convention); ImageError when that fails."""
    return np.asarray(decode(path) != 0)


def shrink_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """Resize an (H, W) mask to (width, height) px, each pixel from the nearest one."""
    values = mask.astype(np.uint8)
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT) > 0)


def grown(mask: Mask, num_px: int) -> Mask:
    """Add the pixels of an (H, W) mask's surroundings, so many in each direction."""
    kernel = np.ones((2 * num_px + 1, 2 * num_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)
