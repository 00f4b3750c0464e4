"""Where on earth a model is: a file beside those of COLMAP, which have no place for it."""

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import damage
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.project.atomic_files import replace_text

FILE_NAME = "georeference.json"


@dataclass(frozen=True)
class Georeference:
    """A model in metres whose x, y, z point east, north and up, and where its origin is (WGS 84).

    Attributes:
        latitude: of the origin, degrees.
        longitude: of the origin, degrees.
        altitude: of the origin, metres above the ellipsoid, or as GPS has it.
    """

    latitude: float
    longitude: float
    altitude: float

    @classmethod
    def read(cls, model_path: Path) -> Self | None:
        """Return what is on record beside a model, None if there is nothing."""
        path = model_path / FILE_NAME
        if not path.exists():
            return None
        with damage(path, "align the model again"):
            return TypeAdapter(cls).validate_json(path.read_bytes())

    def write(self, model_path: Path) -> None:
        """Put it on record beside a model."""
        text = TypeAdapter(Georeference).dump_json(self, indent=1).decode()
        replace_text(model_path / FILE_NAME, text + "\n")

    def in_metres(self, positions: ArrayLike) -> Array:
        """Return metres east, north and up of the origin for latitudes, longitudes, altitudes."""
        return np.asarray(_transform().ellipsoid_to_enu(positions, *astuple(self)))

    def on_earth(self, point: ArrayLike) -> tuple[float, float, float]:
        """Return latitude, longitude and altitude of a point of the model."""
        places = _transform().enu_to_ellipsoid(np.asarray(point, float)[None], *astuple(self))
        latitude, longitude, altitude = places[0].tolist()
        return latitude, longitude, altitude


def _transform() -> pycolmap.GPSTransform:
    return pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
