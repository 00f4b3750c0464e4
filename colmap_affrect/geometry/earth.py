"""GPS positions: latitude and longitude in degrees, altitude in metres."""

import math

from colmap_affrect.geometry.arrays import Array

NO_FIX_DEG = 1e-6  # receivers without a fix write 0, 0, which is in the sea; numeric
# Above and below zero: no photograph is taken beyond (edge of space); theory
MAX_ALTITUDE_M = 100_000.0


def why_not_on_earth(position: Array) -> str:
    """Return why (latitude, longitude, altitude) is no position on earth; empty if it is one.

    >>> why_not_on_earth([47.5, 8.2, 400.0])
    ''
    >>> why_not_on_earth([0.0, 0.0, 0.0])
    'latitude 0, longitude 0: no position was known'
    >>> why_not_on_earth([96.1, 8.2, 0.0])
    'latitude 96.1 is no place on earth'
    """
    latitude, longitude, altitude = map(float, position)
    if not all(map(math.isfinite, (latitude, longitude, altitude))):
        return "is not finite"
    if abs(latitude) > 90.0:
        return f"latitude {latitude:g} is no place on earth"
    if abs(longitude) > 360.0:
        return f"longitude {longitude:g} is no place on earth"
    if max(abs(latitude), abs(longitude)) < NO_FIX_DEG:
        return "latitude 0, longitude 0: no position was known"
    if abs(altitude) > MAX_ALTITUDE_M:
        return f"altitude {altitude:g} is no place on earth"
    return ""
