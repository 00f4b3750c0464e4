"""Reading of image files, by header before pixels, and encoding of pictures, through OpenCV."""

import io
import math
import os
import re
import struct
import warnings
from collections.abc import Callable
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

from colmap_affrect.data import ColorImage, GrayImage
from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.images.few_reads import FewReads
from colmap_affrect.images.pnm import (
    MAX_HEADER,
    pnm_header,
    with_line_end,
    with_usual_white,
)
from colmap_affrect.images.tiff import stand_upright
from colmap_affrect.project.image_failures import (
    NO_IMAGE,
    ImageFailure,
    UnusableImageError,
    unusable,
)
from colmap_affrect.project.regular_files import (
    NotAFileError,
    open_regular,
    require_regular,
)

# Of a photograph; those of the largest cameras have 400 megapixels; damage
MAX_NUM_PX = 1 << 29
MAX_NUM_BYTES = 12 * MAX_NUM_PX  # of its file: three channels of four bytes; damage
USUAL_BYTES = 1 << 26  # Resource
"""Of a photograph, with all that cameras put beside its pixels, as short films; 64 MiB. Only longer
files are compared with their pixels."""
MAX_BYTES_PER_PX = 16  # four channels of four bytes; format
# Filters of warnings are of the process: threads would mix them up
ONE_AT_A_TIME = Lock()
JPEG = b"\xff\xd8"
PNG = b"\x89PNG\r\n\x1a\n"
PNM = b"P"
READERS = {
    JPEG: jpeg_factory,
    PNG: PngImageFile,
    b"II": TiffImageFile,
    b"MM": TiffImageFile,
    b"BM": BmpImageFile,
    PNM: PpmImageFile,
}
"""Pillow's by the first bytes: ``Image.open`` has a limit of pixels that photographs exceed."""
NEW_SUBFILE_TYPE = 254  # TIFF's tag of what a page is; format
REDUCED = 1  # its bit of a smaller copy of another page; format

Found = TypeVar("Found")


def read_header(path: Path, read: Callable[[BinaryIO], Found]) -> Found | None:
    """Return what a function reads of a file, None if that fails in any way, or for a pipe."""
    try:
        with ONE_AT_A_TIME, warnings.catch_warnings(), open_regular(path) as file:
            warnings.simplefilter("ignore")  # Pillow warns of broken EXIF
            return read(file)
    except Exception:  # noqa: BLE001 - damaged files raise nearly anything in Pillow
        return None


def open_image(file: BinaryIO) -> Image.Image:
    """Open an image by its header; what is damaged raises nearly anything."""
    start = file.read(len(PNG))
    file.seek(0)
    source: Any = file
    if start.startswith(PNM):  # whose header Pillow reads byte by byte
        source = io.BytesIO(file.read(MAX_HEADER))
    if start.startswith((JPEG, PNG)):
        source = FewReads(file)
    for magic, reader in READERS.items():
        if start.startswith(magic):
            return reader(source, "")
    raise ValueError(NO_IMAGE)


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
    image = open_image(file)
    found = []
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
    return stored_size(open_image(file))


def why_unusable(path: Path) -> ImageFailure | None:
    """Return why a file should not even be opened as a photograph; None if it may be one.

    What is no regular file, claims more pixels than photographs have or is longer than any: for
    readers that open files by their names and take what these claim.
    """
    try:
        _require_photograph(path)
        require_possible(path)
    except UnusableImageError as error:
        return error.failure
    return None


def _require_photograph(path: Path) -> int:
    """Return the size of a file in bytes; ImageError for what cannot be one of a photograph."""
    try:
        require_regular(path)
        num_bytes = path.stat().st_size
    except OSError as error:
        raise cannot_read(path, error) from error
    if num_bytes > MAX_NUM_BYTES:
        most = MAX_NUM_BYTES / 1e9
        gigabytes = num_bytes / 1e9
        raise unusable("too_long", path, gigabytes=gigabytes, most_gigabytes=most)
    return num_bytes


def _require_plausible(path: Path, num_bytes: int) -> None:
    """Refuse a long file that is no picture, or far longer than its pixels need; ImageError.

    Its header says so: the file need not be read for that.
    """
    if num_bytes <= USUAL_BYTES or path.suffix.lower() not in IMAGE_SUFFIXES:
        return
    try:
        with open_regular(path) as file:
            is_foreign = bool(foreign_format(np.frombuffer(file.read(16), np.uint8)))
    except OSError as error:
        raise cannot_read(path, error) from error
    if is_foreign:
        return
    num_px = read_header(path, _num_px_of_pages)
    if num_px is None:
        raise unusable("no_image", path)
    if num_bytes > USUAL_BYTES + MAX_BYTES_PER_PX * num_px:
        megapixels = num_px / 1e6
        gigabytes = num_bytes / 1e9
        raise unusable(
            "longer_than_its_pixels", path, gigabytes=gigabytes, megapixels=megapixels
        )


def _num_px_of_pages(file: BinaryIO) -> int:
    """Return the number of pixels of a picture, of a TIFF those of all its pages."""
    image = open_image(file)
    num = 0
    for page in range(getattr(image, "n_frames", 1)):
        image.seek(page)
        width, height = stored_size(image)
        num += width * height
    return num


def may_be_photograph(path: Path) -> bool:
    """Return whether a regular file is there that is not longer than those of photographs."""
    try:
        _require_photograph(path)
    except ImageError:
        return False
    return True


def read_photograph(path: Path) -> Bytes:
    """Return the bytes of a file, (N,) uint8; ImageError for what cannot be one of a photograph."""
    num_bytes = _require_photograph(path)
    _require_plausible(path, num_bytes)
    data = np.empty(num_bytes, np.uint8)
    try:
        with open_regular(path) as file:
            return data[: file.readinto(data.data)]
    except OSError as error:
        raise cannot_read(path, error) from error


def cannot_read(path: Path, error: OSError) -> UnusableImageError:
    """Return the error that says why a file cannot be read."""
    if isinstance(error, NotAFileError):
        return unusable("no_file", path, reason=str(error))
    return unusable("unreadable", path, reason=error.strerror or str(error))


def is_too_large(size: tuple[int, int] | None) -> bool:
    """Return whether a header claims more pixels than photographs have."""
    return size is not None and size[0] * size[1] > MAX_NUM_PX


def require_possible(path: Path) -> None:
    """Refuse an image of more pixels than photographs have; ImageError."""
    size = header_size(path)
    if size and is_too_large(size):
        raise too_many_pixels(path, size)


def too_many_pixels(path: Path, size: tuple[int, int]) -> UnusableImageError:
    """Return the error of a file whose header claims too many pixels, (width, height)."""
    width, height = size
    most = MAX_NUM_PX >> 20
    return unusable(
        "too_many_pixels", path, width=width, height=height, most_megapixels=most
    )


LIMITS_OF_OPENCV = (
    "OPENCV_IO_MAX_IMAGE_PIXELS",
    "OPENCV_IO_MAX_IMAGE_WIDTH",
    "OPENCV_IO_MAX_IMAGE_HEIGHT",
)
# OpenCV's function that compares a header with these
OPENCV_CHECKS_SIZE = "validateInputImageSize"
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
# Black and white of a stretched photograph but for dust and glints; judged
TONE_PERCENTILES = (0.5, 99.5)
# A photograph whose tones fill less of the range of its file is stretched; judged
MIN_TONE_RANGE = 0.5
# Neighbouring tones get no further apart, in steps of 8 bits: beyond is noise; judged
MAX_TONE_STEP = 16
# Of floats that are meant from 0 to 1: filters and highlights go beyond; theory
FLOAT_RANGE = (-0.5, 2.0)
NUM_TONES = 250_000  # about so many pixels are looked at; resource
# Along each border is passed over: scans have frames and captions there; judged
FRAME_FRAC = 0.1
GRAY_AS_STORED = (
    cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
)
COLOR_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
# JPEG is decoded at an eighth, a quarter or half of its size, the smallest that is large enough
PARTS_OF_COLOR = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
}


def read_gray(path: Path) -> GrayImage:
    """Read an image as 8-bit gray, without applying EXIF orientation; ImageError if it is none."""
    return in_eight_bits(decode(path))


def read_color(
    path: Path, max_size_px: int, *, stretch: bool = True, is_shown: bool = False
) -> ColorImage:
    """Read an image in colour, without applying EXIF orientation.

    Args:
        path: the file.
        max_size_px: longest side that the image is shrunk to.
        stretch: whether low contrast fills the range (:func:`tones`).
        is_shown: people look at it, and nothing is measured in it.

    Returns:
        (H, W, 3) uint8, RGB.

    Raises:
        ImageError: it is no image.
    """
    try:
        flags = _color_flags(path, max_size_px, is_shown=is_shown)
        image = decode(path, flags)[:, :, ::-1]
    except ImageError:  # OpenCV makes no colour of one channel of floats
        image = np.repeat(decode(path)[:, :, None], 3, axis=2)
    black_and_white = tones(image) if stretch else None
    return shrink_to(in_eight_bits(image, black_and_white), max_size_px)


def _color_flags(path: Path, max_size_px: int, *, is_shown: bool) -> int:
    """Return OpenCV's flags, see :func:`read_color`: what is far larger is read as a part."""
    is_jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    size = header_size(path) if is_jpeg else None
    if size:
        for divisor, part in PARTS_OF_COLOR.items():
            is_enough = max(size) >= divisor * max_size_px
            if is_enough and (is_shown or divisor == max(PARTS_OF_COLOR)):
                return part | cv2.IMREAD_IGNORE_ORIENTATION
    return COLOR_AS_STORED


def tones(image: NDArray[Any]) -> tuple[float, float] | None:
    """Return what is to be black and white of an (H, W[, 3]) image, None to leave it as it is."""
    if range_of_floats(image):
        return None  # these fill the range anyway
    sample = _sample(image)
    values = sample[np.isfinite(sample)]
    if not values.size:
        return None
    low, high = np.percentile(values, TONE_PERCENTILES)
    whole_numbers = np.issubdtype(image.dtype, np.integer)
    white = np.iinfo(image.dtype).max if whole_numbers else 1.0
    finest = 255 / MAX_TONE_STEP if whole_numbers else 0.0
    if not finest < high - low < MIN_TONE_RANGE * white:
        return None
    return float(low), float(high)


def _sample(image: NDArray[Any]) -> NDArray[Any]:
    """Return some pixels of an (H, W[, 3]) image, from all over it but its frame."""
    height, width = image.shape[:2]
    y = int(FRAME_FRAC * height)
    x = int(FRAME_FRAC * width)
    inner = image[y : height - y, x : width - x]
    step = max(1, round(math.sqrt(inner.size / NUM_TONES)))
    return inner[::step, ::step]


def range_of_floats(image: NDArray[Any]) -> tuple[float, float] | None:
    """Return what is black and white of floats that are not from 0 to 1; None for all else.

    Programs of measurement write floats of any range, and an image that is clipped to 0 to 1 would
    be black or white all over. So do they with integers that are signed, or of 32 bits.
    """
    if image.dtype in (np.uint8, np.uint16):
        return None
    sample = _sample(image)
    values = sample[np.isfinite(sample)]
    if not values.size:
        return None
    low, high = np.percentile(values, TONE_PERCENTILES)
    is_float = np.issubdtype(image.dtype, np.floating)
    if is_float and low >= FLOAT_RANGE[0] and high <= FLOAT_RANGE[1]:
        return None
    least = low + np.finfo(np.float32).eps * max(abs(low), 1.0)
    return float(low), float(max(high, least))


def in_eight_bits(
    image: NDArray[Any], black_and_white: tuple[float, float] | None = None
) -> Bytes:
    """Return an image of integers or of floats in 8 bits.

    Floats are from 0 to 1; those of another range are stretched (:func:`range_of_floats`), and so
    are integers that are signed or of 32 bits.
    """
    black_and_white = black_and_white or range_of_floats(image)
    if black_and_white:
        low, high = black_and_white
        with np.errstate(all="ignore"):  # floats may be anything
            values = (image.astype(np.float32) - low) * (255.0 / (high - low))
            image = np.nan_to_num(np.clip(values, 0.0, 255.0)).round()
    elif image.dtype == np.uint16:
        image = image // np.uint16(257)
    elif image.dtype != np.uint8:
        image = np.nan_to_num(np.clip(image.astype(np.float32), 0.0, 1.0)) * 255.0
    return np.ascontiguousarray(image, dtype=np.uint8)


def encode_jpeg(image: GrayImage | ColorImage, quality: int) -> bytes:
    """Return an (H, W) or (H, W, 3) uint8 image as JPEG; quality is 0 to 100."""
    ordered = image[:, :, ::-1] if image.ndim == 3 else image
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality]
    return cv2.imencode(".jpg", ordered, parameters)[1].tobytes()


def decode(
    path: Path, flags: int = GRAY_AS_STORED, *, keeps_numbers: bool = False
) -> NDArray[Any]:
    """Read an image, by default as gray in the type it is stored in.

    Args:
        path: the file.
        flags: OpenCV's.
        keeps_numbers: numbers are no tones, but depths: white is not made that of the type.

    Returns:
        (H, W) or (H, W, channels).

    Raises:
        ImageError: it is no image.
    """
    require_possible(path)
    return decode_bytes(read_photograph(path), path, flags, keeps_numbers=keeps_numbers)


def decode_bytes(
    data: Bytes,
    path: Path,
    flags: int = GRAY_AS_STORED,
    *,
    keeps_numbers: bool = False,
) -> NDArray[Any]:
    """Decode the bytes of a photograph, which may change them.

    Args:
        data: (N,) bytes of the file.
        path: of the file, for errors.
        flags: OpenCV's.
        keeps_numbers: see :func:`decode`.

    Returns:
        (H, W) or (H, W, channels).

    Raises:
        ImageError: it is no image.
    """
    name = foreign_format(data)
    if name:
        raise unusable("foreign_format", path, format=name)
    stand_upright(data)
    header = pnm_header(data)
    if header and header.is_text:
        data = with_line_end(data)
    try:
        image = cv2.imdecode(data, flags) if data.size else None
    except cv2.error as error:
        raise _not_decoded(path, error) from error
    if image is None:
        raise unusable("no_image", path)
    image = np.asarray(image)
    if header and not (header.is_scaled or keeps_numbers):
        image = with_usual_white(image, header.white)
    return image


def _not_decoded(path: Path, error: cv2.error) -> UnusableImageError:
    """Return why OpenCV refuses an image: the system's settings may let it read fewer pixels."""
    limits = [name for name in LIMITS_OF_OPENCV if name in os.environ]
    if error.func == OPENCV_CHECKS_SIZE and limits:
        settings = ", ".join(f"{name}={os.environ[name]}" for name in limits)
        return unusable("limit_of_opencv", path, settings=settings)
    return unusable("no_image", path)


def foreign_format(data: Bytes) -> str:
    """Return the format of data that COLMAP cannot read, whatever the suffix, else nothing."""
    beginning = data[:16].tobytes()
    for name, pattern in FOREIGN_FORMATS.items():
        if re.match(pattern, beginning, re.DOTALL):
            return name
    return ""


def shrink_to(image: Bytes, max_size_px: int) -> Bytes:
    """Shrink an (H, W) or (H, W, 3) image, by area averaging, until no side is longer."""
    height, width = image.shape[:2]
    scale = max_size_px / max(width, height)
    if scale >= 1.0:
        return image
    return np.asarray(
        cv2.resize(
            image,
            dsize=(max(1, round(width * scale)), max(1, round(height * scale))),
            interpolation=cv2.INTER_AREA,
        ),
        dtype=np.uint8,
    )
