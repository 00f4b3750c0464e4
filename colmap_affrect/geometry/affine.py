"""Affine maps from tilt coordinates, local affine frames, and canvases of rectifying warps."""

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

from colmap_affrect.geometry.arrays import Array, Floats


def rotation(angle_rad: ArrayLike) -> Array:
    """Return R(a) = [[cos a, -sin a], [sin a, cos a]] of shape (..., 2, 2)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def determinants(matrices: Floats) -> Floats:
    """Return the (...) determinants of (..., 2, 2) matrices, faster than numpy for few of them."""
    return np.asarray(
        matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]
    )


def adjugates(matrices: Floats) -> Floats:
    """Return the (N, 2, 2) inverses of matrices, times their determinants."""
    a, b, c, d = (matrices[:, i, j] for i in (0, 1) for j in (0, 1))
    return np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)


def project(homography: Floats, points: Floats) -> Array:
    """Map (N, 2) points by a (3, 3) homography or affine map."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def transform_lafs(homography: Floats, lafs: Floats) -> Array:
    """Carry (N, 2, 3) frames through a map: centres exactly, shapes by its Jacobian.

    The (3, 3) map is target_from_source, with a finite and non-zero third coordinate at every
    centre. For an affine one, of last row (0, 0, 1) and linear part B, shapes A become B A.
    """
    mapped = lafs[:, :, 2] @ homography[:, :2].T + homography[:, 2]
    target = mapped[:, :2] / mapped[:, 2:]
    jacobians = homography[None, :2, :2] - target[:, :, None] * homography[None, 2:, :2]
    jacobians = jacobians / mapped[:, 2, None, None]
    return np.concatenate([jacobians @ lafs[:, :, :2], target[:, :, None]], axis=2)


def homography_errors(homography: Floats, points1: Floats, points2: Floats) -> Array:
    """Return (N,) distances of matches from a homography, px, to first order (Sampson).

    Both points may be off: where image 2 is stretched, so is the error of the point in image 1.
    The same for the inverse homography and swapped images.
    """
    frames = np.broadcast_to(np.eye(2, 3), (len(points1), 2, 3)).copy()
    frames[:, :, 2] = points1
    carried = transform_lafs(homography, frames)
    x, y = (carried[:, :, 2] - points2).T
    jacobians = carried[:, :, :2]
    covariances = np.eye(2) + jacobians @ jacobians.transpose(0, 2, 1)
    a, b, d = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
    return np.asarray(np.sqrt((d * x**2 - 2.0 * b * x * y + a * y**2) / (a * d - b**2)))


def lafs_from_keypoints(points: Floats, radii_px: Floats, angles_rad: Floats) -> Array:
    """Build frames r R(a) from centres (N, 2), radii (N,) and orientations (N,).

    The first column of the shape points along the orientation; angles run from x towards y
    (clockwise on the screen), as OpenCV's ``KeyPoint.angle`` does.
    """
    shapes = radii_px[:, None, None] * rotation(angles_rad)
    return np.concatenate([shapes, points[:, :, None]], axis=2)


def ellipse_extents(shapes: Floats) -> Array:
    """Half width and height (N, 2) of the ellipses that (N, 2, 2) shapes make of a unit circle."""
    return np.asarray(np.linalg.norm(shapes, axis=2))


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
