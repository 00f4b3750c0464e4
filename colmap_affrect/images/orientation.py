"""Pictures that say they lie on their side, and do not: what says so is changed in their files."""

import re
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from PIL import ExifTags

from colmap_affrect.geometry.lines import DOWN
from colmap_affrect.images.reading import PNG, open_image, read_header
from colmap_affrect.images.tiff import stand_upright
from colmap_affrect.project.atomic_files import replace_bytes

UPRIGHT = 1  # EXIF's number; format
# Downwards in the picture, in the image as stored, by EXIF's number; format
DOWN_BY_ORIENTATION = {
    1: DOWN,
    2: DOWN,
    3: (0.0, -1.0),
    4: (0.0, -1.0),
    5: (1.0, 0.0),
    6: (1.0, 0.0),
    7: (-1.0, 0.0),
    8: (-1.0, 0.0),
}
JPEG_START = b"\xff\xd8"
JPEG_EXIF = b"Exif\0\0"
JPEG_XMP = b"http://ns.adobe.com/xap/1.0/\0"
JPEG_PIXELS = 0xDA  # the segment that begins them; metadata come before; format
JPEG_LONE = {0x01, *range(0xD0, 0xD9)}  # segments without content; format
XMP_ORIENTATION = re.compile(rb"(tiff:Orientation\s*(?:=\s*[\"']|>)\s*)[2-8]")


def forget_orientation(path: Path) -> None:
    """Have a picture stand upright for every program; its pixels stay as they are."""
    data = bytearray(path.read_bytes())
    before = bytes(data)
    if data.startswith(JPEG_START):
        _change_jpeg(data)
    elif data.startswith(PNG):
        _change_png(data)
    else:
        stand_upright(np.frombuffer(data, np.uint8))
        _change_xmp(data, start=0, end=len(data))
    if data != before:
        replace_bytes(path, bytes(data))  # not what it may be linked to


def orientation(path: Path) -> int:
    """Return EXIF's or XMP's number of how a picture lies, 1 where nothing says so."""
    return read_header(path, _orientation) or UPRIGHT


def picture_down(path: Path) -> tuple[float, float]:
    """Return downwards in a picture, right and down in the image as stored, by EXIF or XMP."""
    return DOWN_BY_ORIENTATION.get(orientation(path), DOWN)


def _orientation(file: BinaryIO) -> int:
    return int(open_image(file).getexif().get(ExifTags.Base.Orientation, UPRIGHT))


def _change_xmp(data: bytearray, start: int, end: int) -> None:
    """Change what XMP says between two positions in a file, in as many bytes."""
    data[start:end] = XMP_ORIENTATION.sub(rb"\g<1>1", bytes(data[start:end]))


def _change_exif(data: bytearray, start: int, end: int) -> None:
    """Change what EXIF says between two positions in a file; it is laid out as a TIFF."""
    block = np.frombuffer(bytes(data[start:end]), np.uint8).copy()
    stand_upright(block)
    data[start:end] = block.tobytes()


def _change_jpeg(data: bytearray) -> None:
    for start, end in _jpeg_segments(data):
        if data.startswith(JPEG_EXIF, start):
            _change_exif(data, start=start + len(JPEG_EXIF), end=end)
        elif data.startswith(JPEG_XMP, start):
            _change_xmp(data, start, end)


def _jpeg_segments(data: bytearray) -> Iterator[tuple[int, int]]:
    """Yield beginning and end of the content of each segment before the pixels."""
    position = len(JPEG_START)
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == JPEG_PIXELS:
            return
        if marker in JPEG_LONE:
            position += 2
            continue
        (length,) = struct.unpack_from(">H", data, position + 2)
        yield position + 4, position + 2 + length
        position += 2 + length


def _change_png(data: bytearray) -> None:
    position = len(PNG)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        start = position + 8
        end = position + 8 + length
        if kind == b"eXIf":
            _change_exif(data, start, end)
        elif kind in (b"iTXt", b"tEXt"):
            _change_xmp(data, start, end)
        if kind in (b"eXIf", b"iTXt", b"tEXt"):
            struct.pack_into(">I", data, end, zlib.crc32(data[position + 4 : end]))
        position = end + 4
