"""What EXIF says of the camera of a photograph, and whether that can be true.

Shrunk or cropped files often keep it: statements are compared with each other and with the file.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from PIL import ExifTags

from colmap_affrect.images.reading import opened, read_header, stored_size

# Of 35 mm film, to which equivalents refer (by COLMAP's rounding)
FILM_DIAGONAL_MM = 43.27
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""By EXIF's number of the unit of focal-plane resolutions: inches, cm, and, as COLMAP reads them,
mm and micrometres; format."""
PLAUSIBLE_FOCALS = (
    0.3,
    6.0,
)  # in longer sides: 118 to 10 degrees, which hold nearly all lenses; theory
# Ratio of focal lengths that still agree: equivalents are rounded; theory
MAX_CONTRADICTION = 1.15
# Lossless rotation cuts off up to 15 px, shrinking rounds; theory
MAX_ASPECT_ERROR = 0.01
SENSOR_ASPECTS = (
    3 / 2,
    4 / 3,
    16 / 9,
)  # photographs of another shape may have been cropped; theory
# Longer side of the thumbnails of cameras, often with black bars; format
MAX_THUMBNAIL_PX = 160
RESOLUTION = "focal-plane resolution"
EQUIVALENT = "35 mm equivalent"
SENSOR = "known sensor"


@dataclass(frozen=True)
class CameraTags:
    """What the file of a photograph says of its camera; missing and absurd values are None."""

    size: tuple[int, int]  # (width, height) of the stored pixels
    body: tuple[str, str, str] = ("", "", "")  # make, model and serial number
    lens: str = ""  # model of the lens
    focal_mm: float | None = None  # focal length
    # Of a camera with 35 mm film and the same field of view
    equivalent_mm: float | None = None
    # Focal-plane resolution, x and perhaps y
    px_per_mm: tuple[float, float | None] | None = None
    # (width, height) when EXIF was written
    original_size: tuple[int, int] | None = None
    zoom: float = 1.0  # of the part of the sensor that was enlarged; 1 without

    @property
    def identity(self) -> tuple[object, ...] | None:
        """What photographs of one camera have in common; None where EXIF has no camera."""
        make, model, _ = self.body
        if (
            not (make and model and (self.focal_mm or self.equivalent_mm))
            or self.was_cropped
        ):
            return None
        return (
            *self.body,
            self.lens,
            self.focal_mm,
            self.equivalent_mm,
            self.zoom,
            self.size,
        )

    @property
    def scale(self) -> float:
        """Longer side in units of that of the file that EXIF describes, turned or not."""
        scale = max(self.size) / max(self.original_size or self.size)
        return 1.0 if _similar(scale, 1.0) else scale

    @property
    def was_cropped(self) -> bool:
        """Whether the shape is not that of the file that EXIF describes."""
        return not _similar(
            _aspect(self.size), _aspect(self.original_size or self.size)
        )


@dataclass(frozen=True)
class ExifFocal:
    """A focal length, or why there is none."""

    focal_px: (
        float | None
    )  # of the stored file; None if EXIF does not say or cannot be trusted
    is_rescaled: bool = False  # it is not the one that COLMAP would take
    why: str = ""  # what is wrong; empty if nothing
    # Focal length of the lens, where nothing tells how large the sensor is
    lens_mm: float = 0.0
    # Of the whole photograph that this is a crop of, if EXIF says it
    uncropped_px: float = 0.0


def read_camera_tags(path: Path) -> CameraTags | None:
    """Read the header of a photograph, without its pixels; None if it has no readable one."""
    return read_header(path, _tags_of_file)


def _tags_of_file(file: BinaryIO) -> CameraTags:
    image = opened(file)
    tag = ExifTags.Base
    size = stored_size(image)
    tags = dict[int, Any]()
    if image.format != "PNG" or "exif" in image.info:  # else Pillow reads the pixels
        with suppress(Exception):  # damaged tags raise nearly anything in Pillow
            exif = image.getexif()
            tags = {**exif, **exif.get_ifd(ExifTags.IFD.Exif)}

    def number(key: ExifTags.Base) -> float | None:
        return _positive(tags.get(key))

    def text(key: ExifTags.Base) -> str:
        value = tags.get(key)
        return value.strip(" \t\r\n\0") if isinstance(value, str) else ""

    unit = MM_PER_UNIT.get(int(_positive(tags.get(tag.FocalPlaneResolutionUnit)) or 0))
    across = number(tag.FocalPlaneXResolution)
    down = number(tag.FocalPlaneYResolution)
    width = number(tag.ExifImageWidth)
    height = number(tag.ExifImageHeight)
    return CameraTags(
        size,
        (text(tag.Make), text(tag.Model), text(tag.BodySerialNumber)),
        text(tag.LensModel),
        number(tag.FocalLength),
        number(tag.FocalLengthIn35mmFilm),
        (across / unit, down / unit if down else None) if across and unit else None,
        (int(width), int(height))
        if width and height and min(width, height) >= 1
        else None,
        max(1.0, number(tag.DigitalZoomRatio) or 1.0),
    )


def _positive(value: object) -> float | None:
    """Return a positive number in single precision, as COLMAP reads it; None for others."""
    try:
        with np.errstate(all="ignore"):
            number = float(np.float32(float(value)))  # type: ignore[arg-type]
    except (TypeError, ValueError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0.0 else None


def _aspect(size: tuple[int, int]) -> float:
    return max(size) / min(size)


def _similar(first: float, second: float) -> bool:
    return abs(first / second - 1.0) <= MAX_ASPECT_ERROR


def exif_focal(
    tags: CameraTags, sensor_width_mm: float | None = None, *, has_crops: bool = False
) -> ExifFocal:
    """Decide on the focal length that EXIF gives a photograph.

    Of statements that agree the first counts, in COLMAP's order: 35 mm equivalent, focal-plane
    resolution, width of the sensor of this model, where it is known.

    Args:
        tags: What the file says.
        sensor_width_mm: Longer side of the sensor, where it is known.
        has_crops: Whether other photographs of this camera were cropped. One that is smaller than
            when it was taken may then be a crop, too, also where it has kept its shape.
    """
    if tags.was_cropped or (has_crops and tags.scale < 1.0):
        why = (
            "cropped or padded" if tags.was_cropped else "cropped, as others, or shrunk"
        )
        whole = exif_focal(
            replace(tags, size=tags.original_size or tags.size), sensor_width_mm
        )
        return ExifFocal(
            None, why=f"{why}: {_sizes(tags)}", uncropped_px=whole.focal_px or 0.0
        )
    if tags.original_size and tags.scale < 1.0 and max(tags.size) <= MAX_THUMBNAIL_PX:
        return ExifFocal(None, why=f"a thumbnail: {_sizes(tags)}")
    stated = _statements(tags, sensor_width_mm)
    longer = max(tags.size)
    low, high = PLAUSIBLE_FOCALS
    plausible = {k: f for k, f in stated.items() if low * longer <= f <= high * longer}
    if not plausible:
        key, focal = next(iter(stated.items()), ("", 0.0))
        wrong = (
            f"EXIF's {key} would be a focal length of {focal / longer:.2g} longer sides"
        )
        if stated:
            return ExifFocal(None, why=wrong)
        return ExifFocal(
            None, why="no EXIF focal length in px", lens_mm=tags.focal_mm or 0.0
        )
    return _reconciled(tags, stated, plausible)


def _sizes(tags: CameraTags) -> str:
    size = tags.size
    original = tags.original_size or tags.size
    return f"{size[0]} x {size[1]} px, when taken {original[0]} x {original[1]}"


def _statements(tags: CameraTags, sensor_width_mm: float | None) -> dict[str, float]:
    """Return the focal lengths in px that can be derived, in COLMAP's order."""
    found = {}
    if tags.equivalent_mm:
        found[EQUIVALENT] = (
            tags.equivalent_mm / FILM_DIAGONAL_MM * math.hypot(*tags.size)
        )
    if tags.focal_mm and tags.zoom == 1.0:
        across, down = tags.px_per_mm or (0.0, None)
        if across and (down is None or _agree(across, down)):
            found[RESOLUTION] = tags.focal_mm * across * tags.scale
        if sensor_width_mm:
            found[SENSOR] = tags.focal_mm / sensor_width_mm * max(tags.size)
    return found


def _reconciled(
    tags: CameraTags, stated: Mapping[str, float], plausible: Mapping[str, float]
) -> ExifFocal:
    """Choose among plausible focal lengths, of which some may contradict each other.

    Against a resolution, which alone counts for pixels and not for the whole frame, the others are
    right if the photograph was shrunk, wrong if it was cropped.
    """
    colmaps = next(iter(stated))
    key, focal = next(iter(plausible.items()))
    if not all(_agree(other, focal) for other in plausible.values()):
        if not any(_similar(_aspect(tags.size), aspect) for aspect in SENSOR_ASPECTS):
            values = " and ".join(
                f"{f:.0f} px by its {k}" for k, f in plausible.items()
            )
            return ExifFocal(None, why=f"EXIF contradicts itself: {values}")
        key = next(each for each in plausible if each != RESOLUTION)
    if key == RESOLUTION and tags.scale != 1.0:
        return ExifFocal(plausible[key], True, f"shrunk: {_sizes(tags)}")
    wrong = [k for k, f in stated.items() if not _agree(f, plausible[key])]
    why = f"EXIF's {' and '.join(wrong)} is not that of these pixels, its {key} counts"
    return ExifFocal(plausible[key], key != colmaps, why if wrong else "")


def _agree(first: float, second: float) -> bool:
    return 1 / MAX_CONTRADICTION <= first / second <= MAX_CONTRADICTION
