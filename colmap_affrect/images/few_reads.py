"""Headers that are damaged in such a way that Pillow reads them byte by byte, for minutes."""

import io
import os
from typing import BinaryIO

from colmap_affrect.project.image_failures import NO_IMAGE

USUAL_READS = 10_000  # of a file, beside those that its length lets expect; damage
# Of markers of JPEG and chunks of PNG, on average over a long file; damage
BYTES_PER_READ = 8


class FewReads(io.BufferedIOBase):
    """A file that may be read as often as its length lets expect, and then raises ValueError."""

    def __init__(self, file: BinaryIO) -> None:
        num_bytes = file.seek(0, os.SEEK_END)
        file.seek(0)
        self._file = file
        self._num_left = USUAL_READS + num_bytes // BYTES_PER_READ

    def read(self, size: int | None = -1, /) -> bytes:
        """Read as :class:`io.BufferedReader` does."""
        self._num_left -= 1
        if self._num_left < 0:
            raise ValueError(NO_IMAGE)
        return self._file.read(-1 if size is None else size)

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go to a place in the file."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """Return where the next byte is read."""
        return self._file.tell()
