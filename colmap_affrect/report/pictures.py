"""Photographs as small pictures that are part of a page."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from colmap_affrect.data import ColorImage
from colmap_affrect.errors import ImageError
from colmap_affrect.images.reading import encode_jpeg, read_color
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, Progress

# Chosen so that a page of 40 photographs has at most 3 MB, and of 1000 a few more.
JPEG_QUALITY = 70
# Of all thumbnails of a page, as long as these stay large enough
MAX_TOTAL_PX = 5_500_000
MAX_SIDE_PX = 640  # longer side of a thumbnail
MIN_SIDE_PX = 126  # of a thumbnail in which one recognises the photograph
MAX_NUM_THUMBNAILS = 1000
ASPECT_RATIO = 4 / 3  # of usual photographs


@dataclass(frozen=True)
class Picture:
    """An image as text."""

    uri: str  # a ``data:`` address with the whole file
    width: int  # px
    height: int  # px

    @classmethod
    def from_image(cls, image: ColorImage) -> Self:
        """Encode an (H, W, 3) image."""
        height, width = image.shape[:2]
        data = base64_text(encode_jpeg(image, JPEG_QUALITY))
        return cls(f"data:image/jpeg;base64,{data}", width, height)


def base64_text(data: bytes) -> str:
    """Return bytes as base64."""
    return base64.b64encode(data).decode("ascii")


def thumbnails(
    folder: Path, names: Sequence[str], progress: Progress = SILENT
) -> dict[str, Picture]:
    """Read photographs and shrink them for a page.

    Args:
        folder: of the photographs.
        names: of the photographs of the page; the more there are, the smaller are the pictures.
        progress: where to show it.

    Returns:
        Pictures of the first ``MAX_NUM_THUMBNAILS`` photographs by name, without unreadable ones.
    """
    shown = names[:MAX_NUM_THUMBNAILS]
    area_px = MAX_TOTAL_PX / max(1, len(names))
    fitting_px = int((ASPECT_RATIO * area_px) ** 0.5)
    side_px = max(MIN_SIDE_PX, min(MAX_SIDE_PX, fitting_px))

    def picture(name: str) -> Picture | None:
        try:
            return Picture.from_image(read_color(folder / name, side_px, is_shown=True))
        except ImageError:
            return None

    found = {}
    with progress.stage("pictures", len(shown), "images") as advance:
        pictures = map_ordered(picture, shown, available_cores())
        for name, thumbnail in zip(shown, pictures, strict=True):
            if thumbnail:
                found[name] = thumbnail
            advance(1)
    return found
