"""TIFF, and EXIF, which is laid out as one: the tag that says how a picture lies is changed."""

import struct
from contextlib import suppress
from dataclasses import dataclass

from PIL import ExifTags

from colmap_affrect.geometry.arrays import Bytes


@dataclass(frozen=True)
class TiffLayout:
    """Where the tags of a TIFF are, in the letters of :mod:`struct`."""

    where: int  # byte at which the offset of the first page's tags is
    offset: str  # type of offsets
    count: str  # type of the number of tags
    entry_bytes: int  # length of a tag; its value is at the end


TIFF_LAYOUT = TiffLayout(where=4, offset="I", count="H", entry_bytes=12)
BIG_TIFF_LAYOUT = TiffLayout(where=8, offset="Q", count="Q", entry_bytes=20)
# What files of more than 4 GiB have in the place of 42, with offsets of 64 bits; format
BIG_TIFF = 43


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
        layout = BIG_TIFF_LAYOUT if version == BIG_TIFF else TIFF_LAYOUT
        (start,) = struct.unpack_from(order + layout.offset, content, layout.where)
        (count,) = struct.unpack_from(order + layout.count, content, start)
        first = start + struct.calcsize(layout.count)
        end = min(first + count * layout.entry_bytes, data.size)
        for entry in range(first, end, layout.entry_bytes):
            (tag,) = struct.unpack_from(f"{order}H", content, entry)
            if tag == ExifTags.Base.Orientation:
                next_entry = entry + layout.entry_bytes
                value = next_entry - struct.calcsize(layout.offset)
                struct.pack_into(f"{order}H", content, value, 1)
