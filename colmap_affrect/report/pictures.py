"""Photographs as small pictures that are part of a page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import ColorImage, GrayImage
from colmap_affrect.errors import ImageError
from colmap_affrect.images.reading import encode_jpeg, encode_png, read_color
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, Progress

JPEG_QUALITY = 70


@dataclass(frozen=True)
class Picture:
    """An image file as text.

    Attributes:
        uri: a ``data:`` address with the whole file.
        width, height: in px.
    """

    uri: str
    width: int
    height: int

    @classmethod
    def jpeg(cls, image: GrayImage | ColorImage) -> Self:
        """Make one of an (H, W) or (H, W, 3) uint8 image, with loss."""
        return cls._of("image/jpeg", encode_jpeg(image, JPEG_QUALITY), image)

    @classmethod
    def png(cls, image: NDArray[np.uint8]) -> Self:
        """Make one of an (H, W, 3) or, with opacity, (H, W, 4) uint8 image, without loss."""
        return cls._of("image/png", encode_png(image), image)

    @classmethod
    def _of(cls, media_type: str, data: bytes, image: NDArray[np.uint8]) -> Self:
        height, width = image.shape[:2]
        return cls(f"data:{media_type};base64,{base64_text(data)}", width, height)


def base64_text(data: bytes) -> str:
    """Return bytes as base64."""
    return base64.b64encode(data).decode("ascii")


def photograph_pictures(
    folder: Path, names: Sequence[str], max_size_px: int, progress: Progress = SILENT
) -> dict[str, Picture]:
    """Read photographs as stored, shrunk to a longer side; unreadable ones are left out."""

    def picture(name: str) -> Picture | None:
        try:
            return Picture.jpeg(read_color(folder / name, max_size_px))
        except ImageError:
            return None

    found = {}
    with progress.stage("pictures", len(names), "images") as advance:
        pictures = map_ordered(picture, names, available_cores())
        for name, shown in zip(names, pictures, strict=True):
            if shown is not None:
                found[name] = shown
            advance(1)
    return found
