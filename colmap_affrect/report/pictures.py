"""Photographs as small pictures that are part of a page."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

from colmap_affrect.data import ColorImage
from colmap_affrect.errors import ImageError
from colmap_affrect.images.reading import encode_jpeg, read_color
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, Progress

JPEG_QUALITY = 70
MAX_TOTAL_PX, MAX_SIDE_PX = 12_000_000, 640  # of all thumbnails of a page, and of each
MAX_NUM_THUMBNAILS = 1000


class Picture(NamedTuple):
    """An image of some px as text: a ``data:`` address with the whole file."""

    uri: str
    width: int
    height: int

    @classmethod
    def of(cls, image: ColorImage) -> Self:
        """Encode an (H, W, 3) image."""
        data = base64_text(encode_jpeg(image, JPEG_QUALITY))
        return cls(f"data:image/jpeg;base64,{data}", image.shape[1], len(image))


def base64_text(data: bytes) -> str:
    """Return bytes as base64."""
    return base64.b64encode(data).decode("ascii")


def thumbnails(
    folder: Path, names: Sequence[str], progress: Progress = SILENT
) -> dict[str, Picture]:
    """Read photographs as stored, shrunk for a page of that many; unreadable ones are left out."""
    shown = names[:MAX_NUM_THUMBNAILS]
    size_px = int(min(MAX_SIDE_PX, (4 / 3 * MAX_TOTAL_PX / max(1, len(names))) ** 0.5))

    def picture(name: str) -> Picture | None:
        try:
            return Picture.of(read_color(folder / name, size_px))
        except ImageError:
            return None

    found = {}
    with progress.stage("pictures", len(shown), "images") as advance:
        for name, made in zip(shown, map_ordered(picture, shown, available_cores()), strict=True):
            if made:
                found[name] = made
            advance(1)
    return found
