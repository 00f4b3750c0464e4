"""Canvases of rectifying warps: where the warped region lies and how large it is."""

from math import sqrt

import numpy as np

from colmap_affrect.geometry.affine import project, rotation
from colmap_affrect.geometry.arrays import Array, Floats


def rectifying_affine(tilt: float, angle_rad: float, *, area_preserving: bool = True) -> Array:
    """Return the (2, 2) rectifying map diag(sqrt t, 1 / sqrt t) R(phi) of a class (tilt, angle).

    Where areas may change, diag(1, 1 / t) R(phi), which magnifies in no direction (ASIFT).
    """
    zoom = sqrt(tilt) if area_preserving else 1.0
    return np.asarray(np.array([[zoom], [zoom / tilt]]) * rotation(angle_rad))


def image_corners(image_size: tuple[int, int]) -> Array:
    """Return the (4, 2) centres of the corner pixels of an image of (width, height)."""
    right, bottom = image_size[0] - 1.0, image_size[1] - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])


def fit_canvas(linear: Floats, points: Floats, margin_px: float) -> tuple[Array, tuple[int, int]]:
    """Translate a linear map so that mapped points fill a canvas from its first pixel on.

    From the (2, 2) linear part of rectified_from_image, (N, 2) points of the region in image px,
    N >= 1, and a margin in canvas px to the (3, 3) rectified_from_image and the (width, height) of
    the canvas: the smallest with every mapped point, margin included, within the pixel centres.
    """
    mapped = points @ linear.T
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    matrix[:2, 2] = margin_px - mapped.min(axis=0)
    extent = project(matrix, points).max(axis=0) + margin_px
    width, height = np.ceil(extent - 1e-9).astype(int) + 1
    return matrix, (int(width), int(height))
