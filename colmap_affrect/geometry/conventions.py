"""Coordinate conventions, and the only place where half pixels appear.

1. Pixel-centre coordinates everywhere in this package: (0, 0) is the *centre* of the
   top-left pixel, x right, y down; point arrays are (N, 2) in (x, y); an image of
   width w and height h covers [-0.5, w - 0.5] x [-0.5, h - 0.5].
2. COLMAP puts (0, 0) at the top-left *corner* of that pixel: ``colmap = pixel + 0.5``.
3. Resizing by s maps ``p' = (p + 0.5) s - 0.5``; affine shapes scale by rows.
4. Arrays are indexed [row, column] = [y, x]; sizes are given as (width, height).
5. A rectifying map is A = lambda R(psi) diag(t, 1) R(phi), lambda > 0, t >= 1,
   phi in [0, pi), R(a) = [[cos a, -sin a], [sin a, cos a]] acting on (x, y), y down.
   The tilt class (t, phi) of a LAF of shape L is that of L^-1, the map that rectifies it.
6. A local affine frame maps the unit circle to the measurement ellipse, whose radius
   is ``MEASUREMENT_SIGMAS`` times the Gaussian scale sigma of the feature (as in kornia
   and hloc). COLMAP's affine shape maps the unit circle to one sigma.
"""

import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats

HALF_PIXEL = 0.5  # theory
# Radius of the measurement ellipse of a local affine frame, in sigmas; kornia's mr_size
MEASUREMENT_SIGMAS = 6.0


def colmap_from_pixel(points: Floats) -> Floats:
    """Move (..., 2) points from pixel-centre to COLMAP's corner origin."""
    return points + points.dtype.type(HALF_PIXEL)


def pixel_from_colmap(points: Floats) -> Floats:
    """Move (..., 2) points from COLMAP's corner origin to pixel-centre."""
    return points - points.dtype.type(HALF_PIXEL)


def resized_from_original(
    original_size: tuple[int, int], resized_size: tuple[int, int]
) -> Array:
    """Return the (3, 3) map of pixel-centre px of an image to those of its resized version.

    Both sizes are (width, height) in px.
    """
    scale = np.asarray(resized_size, dtype=np.float64) / np.asarray(original_size)
    matrix = np.diag([scale[0], scale[1], 1.0])
    matrix[:2, 2] = HALF_PIXEL * (scale - 1.0)
    return matrix


DEFAULT_FOCAL_RATIO = 1.2
"""Focal length where EXIF has none, in units of the longer side (COLMAP's
``default_focal_length_factor``)."""


def camera_matrix(image_size: tuple[int, int]) -> Array:
    """Return (3, 3) pinhole intrinsics in pixel-centre px, principal point in the middle.

    From (width, height), with a focal length of ``DEFAULT_FOCAL_RATIO`` longer sides.

    >>> camera_matrix((10, 5))
    array([[12. ,  0. ,  4.5],
           [ 0. , 12. ,  2. ],
           [ 0. ,  0. ,  1. ]])
    """
    focal = DEFAULT_FOCAL_RATIO * max(image_size)
    cx, cy = np.asarray(image_size, dtype=np.float64) / 2.0 - HALF_PIXEL
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def grid_origin(step_px: int) -> float:
    """Centre of the first cell of a grid of ``step_px`` wide cells, pixel-centre px."""
    return HALF_PIXEL * (step_px - 1)


def is_inside(
    points: Floats, size: tuple[int, int], margin_px: Floats | float = 0
) -> Bools:
    """Return whether points lie in an image and keep a distance from its edge.

    Args:
        points: (N, 2) pixel-centre px.
        size: (width, height) of the image in px.
        margin_px: distance from the edge: a number, or (N, 2) distances in x and y.

    Returns:
        (N,) bool.
    """
    is_after_low = points >= -HALF_PIXEL + margin_px
    is_before_high = points <= np.asarray(size) - HALF_PIXEL - margin_px
    return np.asarray((is_after_low & is_before_high).all(axis=1))
