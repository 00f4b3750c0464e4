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

from colmap_affrect.images.reading import open_image, read_header, stored_size

# Of 35 mm film, to which equivalents refer (by COLMAP's rounding)
FILM_DIAGONAL_MM = 43.27
MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""By EXIF's number of the unit of focal-plane resolutions: inches, cm, and, as COLMAP reads them,
mm and micrometres."""
# In longer sides: 118 to 10 degrees, which hold nearly all lenses; theory
PLAUSIBLE_FOCALS = (0.3, 6.0)
# Ratio of focal lengths that still agree: equivalents are rounded; theory
MAX_CONTRADICTION = 1.15
# Lossless rotation cuts off up to 15 px, shrinking rounds; theory
MAX_ASPECT_ERROR = 0.01
# Photographs of another shape may have been cropped; theory
SENSOR_ASPECTS = (3 / 2, 4 / 3, 16 / 9)
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
    # Whether the size is not by EXIF, but the largest that others of this body have
    is_size_of_others: bool = False

    @property
    def identity(self) -> tuple[object, ...] | None:
        """What photographs of one camera have in common; None where EXIF has no camera."""
        make, model, _ = self.body
        has_focal = bool(self.focal_mm or self.equivalent_mm)
        if not (make and model and has_focal) or self.was_cropped:
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
        return has_other_shape(self.size, self.original_size or self.size)


@dataclass(frozen=True)
class ExifFocal:
    """A focal length, or why there is none."""

    # Of the stored file; None if EXIF does not say or cannot be trusted
    focal_px: float | None
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
    image = open_image(file)
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

    return CameraTags(
        size=size,
        body=(text(tag.Make), text(tag.Model), text(tag.BodySerialNumber)),
        lens=text(tag.LensModel),
        focal_mm=number(tag.FocalLength),
        equivalent_mm=number(tag.FocalLengthIn35mmFilm),
        px_per_mm=_resolution(
            number(tag.FocalPlaneXResolution),
            down=number(tag.FocalPlaneYResolution),
            unit_number=number(tag.FocalPlaneResolutionUnit),
        ),
        original_size=_whole_size(
            number(tag.ExifImageWidth), number(tag.ExifImageHeight)
        ),
        zoom=max(1.0, number(tag.DigitalZoomRatio) or 1.0),
    )


def _resolution(
    across: float | None, down: float | None, unit_number: float | None
) -> tuple[float, float | None] | None:
    """Return px per mm in x and perhaps y, from pixels per unit and EXIF's number of the unit."""
    unit = MM_PER_UNIT.get(int(unit_number or 0))
    if not across or not unit:
        return None
    return across / unit, down / unit if down else None


def _whole_size(width: float | None, height: float | None) -> tuple[int, int] | None:
    """Return (width, height) in px; None where one is missing or below a pixel."""
    if not width or not height or min(width, height) < 1:
        return None
    return int(width), int(height)


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


def has_other_shape(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Tell whether photographs of two sizes differ in shape, turned or not."""
    return not _similar(_aspect(first), _aspect(second))


def _similar(first: float, second: float) -> bool:
    return abs(first / second - 1.0) <= MAX_ASPECT_ERROR


def exif_focal(
    tags: CameraTags, sensor_width_mm: float | None = None, *, has_crops: bool = False
) -> ExifFocal:
    """Decide on the focal length that EXIF gives a photograph.

    Of statements that agree the first counts, in COLMAP's order: 35 mm equivalent, focal-plane
    resolution, width of the sensor of this model, where it is known.

    Args:
        tags: what the file says.
        sensor_width_mm: longer side of the sensor, where it is known.
        has_crops: whether other photographs of this camera were cropped. One that is smaller than
            when it was taken may then be a crop, too, also where it has kept its shape.

    Returns:
        The focal length, or why there is none.
    """
    if tags.was_cropped or (has_crops and tags.scale < 1.0):
        return _focal_of_crop(tags, sensor_width_mm)
    if tags.original_size and tags.scale < 1.0 and max(tags.size) <= MAX_THUMBNAIL_PX:
        return ExifFocal(None, why=f"a thumbnail: {_sizes(tags)}")
    stated = _statements(tags, sensor_width_mm)
    if not stated:
        return ExifFocal(
            focal_px=None,
            why="no EXIF focal length in px",
            lens_mm=tags.focal_mm or 0.0,
        )
    return _reconcile(tags, stated)


def _focal_of_crop(tags: CameraTags, sensor_width_mm: float | None) -> ExifFocal:
    """Return no focal length, but that of the whole photograph, if EXIF says it."""
    original = replace(tags, size=tags.original_size or tags.size)
    what = "cropped or padded" if tags.was_cropped else "cropped, as others, or shrunk"
    return ExifFocal(
        focal_px=None,
        why=f"{what}: {_sizes(tags)}",
        uncropped_px=exif_focal(original, sensor_width_mm).focal_px or 0.0,
    )


def _sizes(tags: CameraTags) -> str:
    size = tags.size
    original = tags.original_size or tags.size
    taken = "others of its camera" if tags.is_size_of_others else "when taken"
    return f"{size[0]} x {size[1]} px, {taken} {original[0]} x {original[1]}"


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


def _reconcile(tags: CameraTags, stated: Mapping[str, float]) -> ExifFocal:
    """Choose among focal lengths in px, some of which may be absurd, or contradict each other.

    Against a resolution, which alone counts for pixels and not for the whole frame, the others are
    right if the photograph was shrunk, wrong if it was cropped.
    """
    plausible = _plausible_focals(stated, max(tags.size))
    colmaps_key = next(iter(stated))
    if not plausible:
        share = stated[colmaps_key] / max(tags.size)
        return ExifFocal(
            focal_px=None,
            why=f"EXIF's {colmaps_key} would be a focal length of {share:.2g} longer sides",
        )
    key = next(iter(plausible))
    if _contradicting(plausible, plausible[key]):
        if not _may_be_whole(tags.size):
            texts = [f"{focal:.0f} px by its {k}" for k, focal in plausible.items()]
            return ExifFocal(
                focal_px=None, why=f"EXIF contradicts itself: {' and '.join(texts)}"
            )
        key = next(each for each in plausible if each != RESOLUTION)
    focal_px = plausible[key]
    if key == RESOLUTION and tags.scale != 1.0:
        return ExifFocal(
            focal_px=focal_px, is_rescaled=True, why=f"shrunk: {_sizes(tags)}"
        )
    wrong = " and ".join(_contradicting(stated, focal_px))
    why = f"EXIF's {wrong} is not that of these pixels, its {key} counts"
    return ExifFocal(
        focal_px=focal_px, is_rescaled=key != colmaps_key, why=why if wrong else ""
    )


def _plausible_focals(stated: Mapping[str, float], longer: int) -> dict[str, float]:
    """Return the focal lengths that a photograph of this longer side in px may have."""
    low, high = PLAUSIBLE_FOCALS
    return {
        key: focal
        for key, focal in stated.items()
        if low * longer <= focal <= high * longer
    }


def _contradicting(stated: Mapping[str, float], focal_px: float) -> list[str]:
    return [key for key, other in stated.items() if not _agree(other, focal_px)]


def _may_be_whole(size: tuple[int, int]) -> bool:
    """Tell whether a photograph of (width, height) px has the shape of a sensor."""
    return any(_similar(_aspect(size), aspect) for aspect in SENSOR_ASPECTS)


def _agree(first: float, second: float) -> bool:
    return 1 / MAX_CONTRADICTION <= first / second <= MAX_CONTRADICTION
