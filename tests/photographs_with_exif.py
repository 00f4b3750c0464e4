"""Tiny photographs with EXIF for tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

BODY = {"Make": "Canon", "Model": "Canon EOS 5D"}
LENS_50 = {
    **BODY, "FocalLength": 50.0, "FocalPlaneXResolution": 4368 / (35.8 / 25.4),
    "FocalPlaneYResolution": 2912 / (23.9 / 25.4), "FocalPlaneResolutionUnit": 2,
}  # fmt: skip
"""Of a camera with 4368 x 2912 px: a focal length of 6100 px."""


def write_photograph(path: Path, size: tuple[int, int], tags: dict[str, Any]) -> None:
    """Write a grey photograph; make and model go into the first directory, as cameras do it."""
    exif = Image.Exif()
    for name, value in tags.items():
        first = name in ("Make", "Model", "Orientation")
        (exif if first else exif.get_ifd(ExifTags.IFD.Exif))[ExifTags.Base[name]] = (
            IFDRational(round(value * 10_000), 10_000)
            if isinstance(value, float)
            else value
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("L", size, 100).save(path, exif=exif)
