"""Headers of image files: what they are of, before memory is taken for pixels."""

import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, TypeVar

from PIL import ExifTags, Image
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import jpeg_factory
from PIL.PngImagePlugin import PngImageFile
from PIL.PpmImagePlugin import PpmImageFile
from PIL.TiffImagePlugin import TiffImageFile

from colmap_affrect.errors import ImageError

MAX_NUM_PX = 1 << 29  # of a photograph; those of the largest cameras have 400 megapixels

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
        with warnings.catch_warnings(), path.open("rb") as file:
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
