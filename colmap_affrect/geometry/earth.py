"""Positions on earth, as GPS says them: latitude and longitude in degrees, altitude in metres."""

import math

import numpy as np

from colmap_affrect.geometry.arrays import Array

NO_FIX = 1e-6  # degrees: receivers without a fix write 0, 0, which is in the sea
MAX_ALTITUDE_M = 100_000.0  # either way; no photograph is taken beyond it


def why_not_on_earth(position: Array) -> str:
    """Return why latitude, longitude and altitude, (3,), are no place on earth; empty if they are.

    >>> [why_not_on_earth(each) for each in ([47.5, 8.2, 400.0], [0.0, 0.0, 0.0], [96.1, 8.2, 0.0])]
    ['', 'latitude 0, longitude 0: no position was known', 'latitude 96.1 is no place on earth']
    """
    latitude, longitude, altitude = (float(value) for value in position)
    if not all(math.isfinite(value) for value in (latitude, longitude, altitude)):
        return "is not finite"
    if abs(latitude) > 90.0:
        return f"latitude {latitude:g} is no place on earth"
    if abs(longitude) > 360.0:
        return f"longitude {longitude:g} is no place on earth"
    if max(abs(latitude), abs(longitude)) < NO_FIX:
        return "latitude 0, longitude 0: no position was known"
    if abs(altitude) > MAX_ALTITUDE_M:
        return f"altitude {altitude:g} is no place on earth"
    return ""


def beside_each_other(longitudes: Array) -> Array:
    """Return (N,) longitudes of which no two are apart by the date line between them.

    >>> beside_each_other(np.array([179.5, -179.5])).tolist()
    [179.5, 180.5]
    """
    if np.ptp(longitudes) <= 180.0:
        return longitudes
    return np.where(longitudes < 0.0, longitudes + 360.0, longitudes)


def usual_longitude(longitude: float) -> float:
    """Return the same longitude between -180 and 180."""
    return longitude - 360.0 if longitude > 180.0 else longitude
