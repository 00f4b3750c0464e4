"""What matches of two images say about parallax: none between turned, cropped or copied views.

All points are (N, 2) px with the corner of the image at (0, 0); sizes are (width, height) px.
"""

from typing import Any

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Bytes, Floats, Indices
from colmap_affrect.geometry.conventions import pixel_from_colmap, resized_from_original

Size = tuple[int, int]

FOCAL_LENGTHS = (0.5, 0.63, 0.8, 1.0, 1.26, 1.6, 2.5, 5.0, 10.0)
"""Tried for a turned camera, in longer sides. From ten on a rotation is a shift."""
MAX_NUM_POINTS = 500  # enough to measure a share to two per cent
MIN_DEPTH = 1e-3  # of a turned ray of length 1; what is behind lands far outside of the image
DISPLACEMENT_PX = np.array([13.0, 7.0])  # so moved, keypoints meet others by chance only
MARGIN = 16  # px around an image, for what is moved out of it
MIN_FREE_SHARE = 0.1  # where keypoints are so dense that chance leaves less, nothing can be told
NUM_STARTS = 30  # rotations of two matches each; least squares begin with the best
MAX_ITERATIONS = 3  # least squares are repeated without outliers
WRITING_ERROR, WRITING_HEIGHT = 0.001, 0.015  # of the longer side: a line of small print
WRITING_SLOPE = 0.087  # of a line against the sides of an image, five degrees
MIN_ONE_VIEW, ONE_VIEW_ERROR = 0.85, 0.01  # share of matches, and longer sides: paper is not flat
SIDE_PX, WINDOW_PX, MIN_VARIANCE = 400, 11, 60.0  # of what is compared, in gray values
MAX_NUM_SIMILARITIES = 300  # tried: enough for a set that one in eight matches is in


def pure_rotation_ratio(
    points1: Array, points2: Array, sizes: tuple[Size, Size], error: float
) -> float:
    """Return the share of matches that a turned, and zoomed, camera explains to ``error`` px."""
    points1, points2 = _some(points1), _some(points2)
    spreads = [  # which outliers do not change
        float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
        for points in (points1, points2)
    ]
    zooms = {1.0, spreads[1] / spreads[0]} if min(spreads) else {1.0}
    first = points1 - np.array(sizes[0]) / 2
    second = points2 - np.array(sizes[1]) / 2
    lenses = [(focal * max(sizes[0]), zoom) for focal in FOCAL_LENGTHS for zoom in sorted(zooms)]
    return float(_shares_of(first, second, np.array(lenses), error).max())


def _shares_of(points1: Array, points2: Array, lenses: Array, error: float) -> Array:
    """Return the shares of matches within an error of the best rotation, for each lens.

    Args:
        points1: (N, 2) px from the middle of the first image.
        points2: (N, 2) px from the middle of the second image.
        lenses: (L, 2) focal lengths of the first image in px, and zooms of the second.
        error: px in the second image.

    Returns:
        (L,) shares.
    """
    focals1 = lenses[:, 0]
    focals2 = lenses[:, 0] * lenses[:, 1]
    rays1 = _rays(points1 / focals1[:, None, None])  # (L, N, 3)
    rays2 = _rays(points2 / focals2[:, None, None])
    columns1 = np.ascontiguousarray(np.swapaxes(rays1, -1, -2))

    def errors_of(rotations: Array) -> Array:
        """Return (L, S, N) px for (L, S, 3, 3) rotations."""
        rows = rotations.reshape(len(lenses), -1, 3)  # one product is ten times as fast as many
        turned = (rows @ columns1).reshape(*rotations.shape[:-1], -1)
        scales = focals2[:, None, None] / np.maximum(turned[..., 2, :], MIN_DEPTH)
        shifts_x = turned[..., 0, :] * scales - points2[:, 0]
        shifts_y = turned[..., 1, :] * scales - points2[:, 1]
        return np.asarray(np.sqrt(shifts_x**2 + shifts_y**2))

    picked = np.random.default_rng(0).integers(len(points1), size=(NUM_STARTS, 2))
    started = errors_of(_rotations(rays1[:, picked], rays2[:, picked]))
    best = np.median(started, axis=2).argmin(axis=1)
    errors = started[np.arange(len(lenses)), best]
    for _ in range(MAX_ITERATIONS):
        kept = errors <= np.maximum(error, np.median(errors, axis=1))[:, None]
        fitted = _rotations(rays1 * kept[..., None], rays2)
        errors = errors_of(fitted[:, None])[:, 0]
    return np.asarray((errors <= error).mean(axis=1))


def _rotations(rays1: Array, rays2: Array) -> Array:
    """Return the (..., 3, 3) rotations that turn (..., N, 3) rays best into others."""
    left, _, right = np.linalg.svd(np.swapaxes(rays2, -1, -2) @ rays1)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    return np.asarray(left @ right)


def _rays(points: Array) -> Array:
    rays = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _some(points: Array) -> Array:
    """Return at most ``MAX_NUM_POINTS``, evenly spaced in their order."""
    return points[:: -(-len(points) // MAX_NUM_POINTS)] if len(points) else points


def text_line_matches(points1: Array, points2: Array, sizes: tuple[Size, Size]) -> Bools:
    """Return which matches are on one thin line along the sides of both images, as print is.

    It is the largest set that a similarity explains, and empty where that is no line. Matches of
    one line tell no pose, and a caption is at another place of each print.
    """
    how = cv2.RANSAC, WRITING_ERROR * max(map(max, sizes)), MAX_NUM_SIMILARITIES
    _, found = cv2.estimateAffinePartial2D(points1, points2, None, *how)
    on_line = np.zeros(len(points1), bool) if found is None else found.ravel() > 0
    for points, size in zip((points1, points2), sizes, strict=True):
        inside = points[on_line]
        if not len(inside):
            return on_line
        _, _, axes = np.linalg.svd(inside - inside.mean(axis=0), full_matrices=False)
        is_thin = np.ptp(inside @ axes[-1]) <= WRITING_HEIGHT * max(size)
        if not is_thin or np.abs(axes[0]).min() > WRITING_SLOPE:
            return np.zeros(len(points1), bool)
    return on_line


def same_view_homography(points1: Array, points2: Array, sizes: tuple[Size, Size]) -> Array | None:
    """Return the (3, 3) homography of px centres if a change of scale nearly explains matches."""
    error = ONE_VIEW_ERROR * max(map(max, sizes))
    _, found = cv2.estimateAffinePartial2D(points1, points2, ransacReprojThreshold=error)
    if found is None or np.mean(found) < MIN_ONE_VIEW:
        return None
    centres = pixel_from_colmap(points1), pixel_from_colmap(points2)
    homography, _ = cv2.findHomography(*centres, cv2.RANSAC, error / 3)
    return None if homography is None else np.asarray(homography)


def correlation(gray1: Bytes, gray2: Bytes, homography: Array) -> float:
    """Return the median correlation of windows of a gray image and of another, moved onto it.

    The (3, 3) homography takes px centres of image 1 to image 2; windows of one gray do not count.
    """
    height, width = gray2.shape
    scale = SIDE_PX / max(height, width)
    size = round(width * scale), round(height * scale)
    shrunk = resized_from_original((width, height), size) @ homography
    second = cv2.resize(gray2, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    blur = 0.5 / np.sqrt(abs(np.linalg.det(shrunk[:2, :2])))
    blurred = cv2.GaussianBlur(gray1, (0, 0), blur).astype(np.float32)
    first = cv2.warpPerspective(blurred, shrunk, size, borderValue=-1.0)
    is_seen = cv2.erode((first >= 0.0).astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX)))
    products: Any = first, second, first * first, second * second, first * second
    means = (cv2.blur(image, (WINDOW_PX, WINDOW_PX)) for image in products)
    mean1, mean2, square1, square2, product = means
    variances = square1 - mean1**2, square2 - mean2**2
    places = (is_seen > 0) & (np.maximum(*variances) > MIN_VARIANCE)
    deviations = np.sqrt(np.maximum(variances[0] * variances[1], 1.0))
    found = ((product - mean1 * mean2) / deviations)[places]
    return float(np.median(found)) if found.size else 0.0


def mirrored_share(points1: Floats, points2: Floats, sizes: tuple[Size, Size]) -> float:
    """Return the share of the keypoints of an image that a mirrored copy, of any size, has too.

    Of the image with fewer of them, as a smaller copy keeps not all. Beyond what chance brings,
    which of dense keypoints is most: as a share of what it leaves.
    """
    if len(points2) < len(points1):
        points1, points2, sizes = points2, points1, sizes[::-1]
    size = sizes[0]
    taken = np.zeros((size[1] + 2 * MARGIN, size[0] + 2 * MARGIN), np.uint8)
    taken[_pixels(points2 * np.divide(size, sizes[1]), size)] = 1
    near = np.asarray(cv2.dilate(taken, np.ones((3, 3), np.uint8)))  # neighbours count, too
    shares = [0.0]
    for axis in (0, 1) if len(points1) else ():
        mirrored = _some(points1.astype(np.float64))
        mirrored[:, axis] = size[axis] - mirrored[:, axis]
        share = near[_pixels(mirrored, size)].mean()
        chance = near[_pixels(mirrored + DISPLACEMENT_PX, size)].mean()
        shares.append(float((share - chance) / max(1.0 - chance, MIN_FREE_SHARE)))
    return max(shares)


def _pixels(points: Floats, size: Size) -> tuple[Indices, Indices]:
    """Return rows and columns of points in an image with a margin."""
    pixels = np.floor(points).astype(np.int64) + MARGIN
    columns, rows = np.clip(pixels, 0, np.array(size) + 2 * MARGIN - 1).T
    return rows, columns
