"""Local affine frames (LAFs), affine maps from tilt coordinates, and canvases of warps."""

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

from colmap_affrect.geometry.arrays import Array, Floats


def rotation(angle_rad: ArrayLike) -> Array:
    """Return R(a) = [[cos a, -sin a], [sin a, cos a]] of shape (..., 2, 2)."""
    cos = np.cos(angle_rad)
    sin = np.sin(angle_rad)
    row_x = np.stack([cos, -sin], axis=-1)
    row_y = np.stack([sin, cos], axis=-1)
    return np.stack([row_x, row_y], axis=-2)


def determinants(matrices: Floats) -> Floats:
    """Return the (...) determinants of (..., 2, 2) matrices, faster than numpy for few of them."""
    diagonal = matrices[..., 0, 0] * matrices[..., 1, 1]
    off_diagonal = matrices[..., 0, 1] * matrices[..., 1, 0]
    return np.asarray(diagonal - off_diagonal)


def adjugates(matrices: Floats) -> Floats:
    """Return the adjugates of (N, 2, 2) matrices: their inverses times their determinants."""
    a, b, c, d = matrices.reshape(-1, 4).T
    return np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2)


def project(homography: Floats, points: Floats) -> Array:
    """Map (N, 2) points by a (3, 3) homography or affine map."""
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def transform_lafs(homography: Floats, lafs: Floats) -> Array:
    """Map (N, 2, 3) LAFs by a homography: centres exactly, shapes by its Jacobian.

    The (3, 3) homography is target_from_source, with a finite and non-zero third coordinate at
    every centre. An affine map, with last row (0, 0, 1) and linear part B, maps shapes A to B A.
    """
    mapped = lafs[:, :, 2] @ homography[:, :2].T + homography[:, 2]
    centers = mapped[:, :2] / mapped[:, 2:]
    jacobians = (
        homography[None, :2, :2] - centers[:, :, None] * homography[None, 2:, :2]
    )
    jacobians = jacobians / mapped[:, 2, None, None]
    shapes = jacobians @ lafs[:, :, :2]
    return np.concatenate([shapes, centers[:, :, None]], axis=2)


def homography_errors(homography: Floats, points1: Floats, points2: Floats) -> Array:
    """Return the distances of matches from a homography, to first order (Sampson).

    Both points of a match may have errors; where image 2 is magnified, so is the error of the point
    in image 1. The inverse homography has the same errors for swapped images.

    Args:
        homography: (3, 3) image2_from_image1.
        points1: (N, 2) px.
        points2: (N, 2) px.

    Returns:
        (N,) px.
    """
    lafs = np.broadcast_to(np.eye(2, 3), (len(points1), 2, 3)).copy()
    lafs[:, :, 2] = points1
    mapped = transform_lafs(homography, lafs)
    jacobians = mapped[:, :, :2]
    covariances = np.eye(2) + jacobians @ jacobians.transpose(0, 2, 1)
    xx = covariances[:, 0, 0]
    xy = covariances[:, 0, 1]
    yy = covariances[:, 1, 1]
    x, y = (mapped[:, :, 2] - points2).T
    squares = yy * x**2 - 2.0 * xy * x * y + xx * y**2
    return np.asarray(np.sqrt(squares / (xx * yy - xy**2)))


def lafs_from_keypoints(points: Floats, radii_px: Floats, angles_rad: Floats) -> Array:
    """Build LAFs r R(a) of circular features.

    The first column of the shape points along the orientation.

    Args:
        points: (N, 2) centres in px.
        radii_px: (N,) radii of the measurement regions.
        angles_rad: (N,) orientations from x towards y (clockwise on the screen), as OpenCV's
            ``KeyPoint.angle``.

    Returns:
        (N, 2, 3) LAFs.
    """
    shapes = radii_px[:, None, None] * rotation(angles_rad)
    return np.concatenate([shapes, points[:, :, None]], axis=2)


def ellipse_extents(shapes: Floats) -> Array:
    """Half width and height (N, 2) of the ellipses that (N, 2, 2) shapes make of a unit circle."""
    return np.asarray(np.linalg.norm(shapes, axis=2))


def rectifying_affine(
    tilt: float, angle_rad: float, *, area_preserving: bool = True
) -> Array:
    """Return the rectifying map diag(sqrt t, 1 / sqrt t) R(phi) of a tilt class.

    Args:
        tilt: t >= 1.
        angle_rad: phi in [0, pi).
        area_preserving: False: the map is diag(1, 1 / t) R(phi), which magnifies in no direction
            (Morel & Yu 2009, ASIFT).

    Returns:
        (2, 2) linear part of rectified_from_image.
    """
    stretch = sqrt(tilt) if area_preserving else 1.0
    diagonal = np.array([[stretch], [stretch / tilt]])
    return np.asarray(diagonal * rotation(angle_rad))


def image_corners(image_size: tuple[int, int]) -> Array:
    """Return the (4, 2) centres of the corner pixels of an image of (width, height)."""
    right = image_size[0] - 1.0
    bottom = image_size[1] - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])


# Float64 rounding of a mapped point adds no column or row to a canvas; numeric
CANVAS_ROUNDING_PX = 1e-9


def fit_canvas(
    linear: Floats, points: Floats, margin_px: float
) -> tuple[Array, tuple[int, int]]:
    """Translate a linear map so that the mapped points fill a canvas from its first pixel on.

    Args:
        linear: (2, 2) linear part of rectified_from_image.
        points: (N, 2) points of the region in image px, N >= 1.
        margin_px: margin around the mapped points, in px of the canvas.

    Returns:
        (3, 3) rectified_from_image, and the (width, height) of the smallest canvas whose pixel
        centres enclose every mapped point and the margin.
    """
    mapped = points @ linear.T
    matrix = np.eye(3)
    matrix[:2, :2] = linear
    matrix[:2, 2] = margin_px - mapped.min(axis=0)
    extent = project(matrix, points).max(axis=0) + margin_px
    width, height = np.ceil(extent - CANVAS_ROUNDING_PX).astype(int) + 1
    return matrix, (int(width), int(height))
