"""PBM, PGM and PPM: what OpenCV does not do for them.

White is any number up to 65535 there, which OpenCV leaves as it is but in text of small numbers, so
that a picture whose white is 1 is nearly black. Of text it misses the last number where nothing
follows it.
"""

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Bytes

MAX_HEADER = 1 << 16  # bytes, with comments; the pixels follow; damage
MAX_WHITE_OF_A_BYTE = 255  # format
MAX_WHITE = 65535  # of two bytes; format
TEXT_KINDS = b"123"
_SPACE = rb"(?:\s|#[^\n\r]*[\n\r])+"
_HEADER = re.compile(rb"P([2356])" + 3 * (_SPACE + rb"(\d{1,9})") + rb"\s")  # format


@dataclass(frozen=True)
class PnmHeader:
    """The first numbers of a file of gray tones or colours."""

    white: int
    is_text: bool

    @property
    def is_scaled(self) -> bool:
        """Whether OpenCV makes the largest number of its type of white."""
        return self.is_text and self.white <= MAX_WHITE_OF_A_BYTE


def pnm_header(data: Bytes) -> PnmHeader | None:
    """Return the header of a picture with tones; None of bitmaps, and of other formats."""
    found = _HEADER.match(data[:MAX_HEADER].tobytes())
    if not found:
        return None
    kind, _, _, white = found.groups()
    if not 0 < int(white) <= MAX_WHITE:
        return None
    return PnmHeader(int(white), kind in TEXT_KINDS)


def with_line_end(data: Bytes) -> Bytes:
    """Return the (N,) bytes of a picture that is written as text, with a line's end after it."""
    return np.append(data, np.uint8(ord("\n")))


def with_usual_white(image: NDArray[Any], white: int) -> NDArray[Any]:
    """Return an image whose white is the largest number of its type.

    Args:
        image: (H, W) or (H, W, 3), uint8 or uint16, as OpenCV decodes it.
        white: the number that means white in the file; larger ones are white, too.

    Returns:
        An image of the same shape and type.
    """
    full = np.iinfo(image.dtype).max
    if white == full:
        return image
    values = np.arange(full + 1, dtype=np.float64)
    scaled = np.minimum(np.rint(values * (full / white)), full)
    return np.asarray(scaled.astype(image.dtype)[image])
