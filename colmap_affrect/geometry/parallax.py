"""Pairs of images without parallax: rotated cameras, lines of print, crops and copies.

All points are (N, 2) px with the corner of the image at (0, 0). Sizes are (width, height) px.
"""

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import (
    Array,
    Bools,
    Bytes,
    Floats,
    Indices,
    Singles,
    sampling_step,
)
from colmap_affrect.geometry.conventions import pixel_from_colmap, resized_from_original

Size = tuple[int, int]

FOCAL_LENGTHS = (0.5, 0.63, 0.8, 1.0, 1.26, 1.6, 2.5, 5.0, 10.0)
"""Focal lengths that are tried for a rotated camera, in units of the longer side. From ten on a
rotation is a shift of the image; theory."""
# Measure a ratio to two per cent (theory: binomial standard deviation)
MAX_NUM_POINTS = 500
TINY = 1e-12  # lengths are divided by; numeric
# Of a rotated ray of length 1; what is behind lands far outside of the image; numeric
MIN_DEPTH = 1e-3
# Rotations of two matches each; least squares begin with the best one; resource
NUM_STARTS = 30
MAX_ITERATIONS = 3  # least squares are repeated without outliers; resource

# Error of a match of print, in units of the longer side; judged
TEXT_ERROR_FRAC = 0.001
# Height of a line of small print, in units of the longer side; judged
TEXT_HEIGHT_FRAC = 0.015
# Sine of the angle of a line of text to a side of the image, five degrees; judged
MAX_TEXT_SLOPE = 0.087
# Of RANSAC: enough for a set that one in eight matches is in; theory
MAX_NUM_TRIALS = 300

MIN_SAME_VIEW_RATIO = 0.85  # matches of copies that a change of scale explains; judged
# Their error, in units of the longer side: paper is not flat; judged
SAME_VIEW_ERROR_FRAC = 0.01

COMPARED_SIZE_PX = 400  # longer side of images whose windows are correlated; resource
WINDOW_PX = 11  # side of the windows; judged
# Of gray values in a window; less is a surface without texture; judged
MIN_VARIANCE = 60.0

DISPLACEMENT_PX = np.array([13.0, 7.0])
"""Displaced by this, keypoints meet others only by chance; theory: farther than a keypoint is from
its neighbours, and different in x and y."""
MARGIN_PX = 16  # around an image, for points that are displaced out of it; theory
MIN_FREE_RATIO = 0.1
"""Where keypoints are so dense that chance leaves less than this, they prove nothing; judged."""


def pure_rotation_ratio(
    points1: Array, points2: Array, sizes: tuple[Size, Size], error: float
) -> float:
    """Return the ratio of matches that a camera explains which rotates and zooms only.

    Args:
        points1: (N, 2) px in the first image.
        points2: (N, 2) px in the second image.
        sizes: (width, height) px of both images.
        error: largest error in px of a match that is explained.

    Returns:
        The largest ratio over all focal lengths.
    """
    points1 = _sampled(points1)
    points2 = _sampled(points2)
    spread1 = _spread(points1)
    spread2 = _spread(points2)
    zooms = [1.0]
    if spread1 and spread2:
        zooms = sorted({1.0, spread2 / spread1})
    centered1 = points1 - np.array(sizes[0]) / 2
    centered2 = points2 - np.array(sizes[1]) / 2
    lenses = []
    for focal_ratio in FOCAL_LENGTHS:
        focal_px = focal_ratio * max(sizes[0])
        lenses += [(focal_px, zoom) for zoom in zooms]
    ratios = _rotation_ratios(
        points1=centered1,
        points2=centered2,
        lenses=np.array(lenses),
        error=error,
    )
    return float(ratios.max())


def _spread(points: Array) -> float:
    """Return the median distance of points from their median, which outliers do not change."""
    distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return float(np.median(distances))


def _rotation_ratios(
    points1: Array, points2: Array, lenses: Array, error: float
) -> Array:
    """Return the ratios of matches within an error of the best rotation, for each lens.

    Args:
        points1: (N, 2) px from the middle of the first image.
        points2: (N, 2) px from the middle of the second image.
        lenses: (L, 2) focal lengths of the first image in px, and zooms of the second.
        error: px in the second image.

    Returns:
        (L,) ratios.
    """
    focals1 = lenses[:, 0]
    focals2 = lenses[:, 0] * lenses[:, 1]
    rays1 = _rays(points1 / focals1[:, None, None])  # (L, N, 3)
    rays2 = _rays(points2 / focals2[:, None, None])
    columns1 = np.ascontiguousarray(np.swapaxes(rays1, -1, -2))
    random = np.random.default_rng(0)
    samples = random.integers(len(points1), size=(NUM_STARTS, 2))
    starts = _rotations_of_two(rays1[:, samples], rays2[:, samples])
    errors = np.empty(rays1.shape[:2])
    # To compare starts half the digits do, in half the time.
    columns1_32 = columns1.astype(np.float32)
    points2_32 = points2.astype(np.float32)
    starts_32 = starts.astype(np.float32)
    # Lens by lens: what stays in the cache of a core is four times as fast.
    for index, focal2 in enumerate(focals2):
        start_errors = _rotation_errors(
            rotations=starts_32[index],
            columns1=columns1_32[index],
            points2=points2_32,
            focal2=float(focal2),
        )
        best_start = _medians(start_errors).argmin()
        errors[index] = _rotation_errors(
            rotations=starts[index, best_start, None],
            columns1=columns1[index],
            points2=points2,
            focal2=float(focal2),
        )[0]
    for _ in range(MAX_ITERATIONS):
        limits = np.maximum(error, _medians(errors))
        is_inlier = errors <= limits[:, None]
        rotations = _fitted_rotations(rays1 * is_inlier[..., None], rays2)
        for index, focal2 in enumerate(focals2):
            rotation = rotations[index, None]
            columns = columns1[index]
            errors[index] = _rotation_errors(
                rotations=rotation,
                columns1=columns,
                points2=points2,
                focal2=focal2,
            )[0]
    return np.asarray((errors <= error).mean(axis=1))


def _rotation_errors(
    rotations: Floats, columns1: Floats, points2: Floats, focal2: float
) -> Floats:
    """Return (S, N) px between rotated rays and their matches, for one lens.

    Args:
        rotations: (S, 3, 3).
        columns1: (3, N) unit rays of the first image.
        points2: (N, 2) px from the middle of the second image.
        focal2: Focal length of the second image in px.
    """
    rows = rotations.reshape(-1, 3)  # one product is ten times as fast as many
    rotated = (rows @ columns1).reshape(*rotations.shape[:-1], -1)
    scales = focal2 / np.maximum(rotated[:, 2], MIN_DEPTH)
    errors_x = rotated[:, 0] * scales - points2[:, 0]
    errors_y = rotated[:, 1] * scales - points2[:, 1]
    return np.asarray(np.sqrt(errors_x**2 + errors_y**2))


def _rotations_of_two(rays1: Array, rays2: Array) -> Array:
    """Return the (..., 3, 3) rotations that map (..., 2, 3) unit rays best to others.

    They map the middle of two rays, and their difference, which are at right angles: what Kabsch's
    method finds too, in a fifth of the time.
    """
    return np.asarray(np.swapaxes(_axes_of_two(rays2), -1, -2) @ _axes_of_two(rays1))


def _axes_of_two(rays: Array) -> Array:
    """Return (..., 3, 3) rows: unit vectors along the sum, the difference and the normal."""
    axes = np.empty((*rays.shape[:-2], 3, 3))
    axes[..., 0, :] = rays[..., 0, :] + rays[..., 1, :]
    axes[..., 1, :] = rays[..., 0, :] - rays[..., 1, :]
    lengths = np.linalg.norm(axes[..., :2, :], axis=-1, keepdims=True)
    axes[..., :2, :] /= np.maximum(lengths, TINY)
    x1, y1, z1 = np.moveaxis(axes[..., 0, :], -1, 0)
    x2, y2, z2 = np.moveaxis(axes[..., 1, :], -1, 0)
    axes[..., 2, 0] = y1 * z2 - z1 * y2
    axes[..., 2, 1] = z1 * x2 - x1 * z2
    axes[..., 2, 2] = x1 * y2 - y1 * x2
    return axes


def _medians(rows: Floats) -> Floats:
    """Return the medians of rows: ``np.median`` takes half as long again."""
    middle = rows.shape[1] // 2
    if rows.shape[1] % 2:
        return np.asarray(np.partition(rows, middle, axis=1)[:, middle])
    parted = np.partition(rows, (middle - 1, middle), axis=1)
    return np.asarray(parted[:, middle - 1 : middle + 1].mean(axis=1))


def _fitted_rotations(rays1: Array, rays2: Array) -> Array:
    """Return the (..., 3, 3) rotations that map (..., N, 3) rays best to others (Kabsch)."""
    left, _, right = np.linalg.svd(np.swapaxes(rays2, -1, -2) @ rays1)
    left[..., 2] *= np.linalg.det(left @ right)[..., None]
    return np.asarray(left @ right)


def _rays(points: Array) -> Array:
    """Return (..., 3) unit rays of (..., 2) normalized points."""
    ones = np.ones((*points.shape[:-1], 1))
    rays = np.concatenate([points, ones], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _sampled(points: Array) -> Array:
    """Return at most ``MAX_NUM_POINTS``, evenly spaced in their order."""
    return points[:: sampling_step(len(points), MAX_NUM_POINTS)]


def text_line_matches(
    points1: Array, points2: Array, sizes: tuple[Size, Size]
) -> Bools:
    """Return which matches are on one line of text along a side of both images.

    They are the largest set that a similarity explains; none where that set is no thin line. The
    matches of one line determine no pose, and a caption is at another position of each print.

    Args:
        points1: (N, 2) px in the first image.
        points2: (N, 2) px in the second image.
        sizes: (width, height) px of both images.

    Returns:
        (N,) bool.
    """
    _, inliers = cv2.estimateAffinePartial2D(
        points1,
        points2,
        None,
        cv2.RANSAC,
        TEXT_ERROR_FRAC * _longest_side(sizes),
        MAX_NUM_TRIALS,
    )
    nothing = np.zeros(len(points1), bool)
    if inliers is None or not inliers.any():
        return nothing
    on_line = inliers.ravel() > 0
    is_line1 = _is_text_line(points1[on_line], sizes[0])
    is_line2 = _is_text_line(points2[on_line], sizes[1])
    return on_line if is_line1 and is_line2 else nothing


def _is_text_line(points: Array, size: Size) -> bool:
    """Tell whether points are on a thin line along a side of an image."""
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    is_thin = np.ptp(points @ axes[-1]) <= TEXT_HEIGHT_FRAC * max(size)
    return bool(is_thin and np.abs(axes[0]).min() <= MAX_TEXT_SLOPE)


def _longest_side(sizes: tuple[Size, Size]) -> int:
    return max(*sizes[0], *sizes[1])


def same_view_homography(
    points1: Array, points2: Array, sizes: tuple[Size, Size]
) -> Array | None:
    """Return the homography between two copies of one photograph.

    Args:
        points1: (N, 2) px of matches in the first image.
        points2: (N, 2) px in the second image.
        sizes: (width, height) px of both images.

    Returns:
        (3, 3) image2_from_image1 in pixel-centre px; None unless a similarity explains nearly all
        matches.
    """
    error_px = SAME_VIEW_ERROR_FRAC * _longest_side(sizes)
    _, inliers = cv2.estimateAffinePartial2D(
        points1, points2, ransacReprojThreshold=error_px
    )
    if inliers is None or np.mean(inliers) < MIN_SAME_VIEW_RATIO:
        return None
    centers1 = pixel_from_colmap(points1)
    centers2 = pixel_from_colmap(points2)
    homography, _ = cv2.findHomography(centers1, centers2, cv2.RANSAC, error_px / 3)
    return None if homography is None else np.asarray(homography)


def correlation(gray1: Bytes, gray2: Bytes, homography: Array) -> float:
    """Return the median correlation of windows of one image, and of another mapped onto it.

    Args:
        gray1: (H, W) uint8 image that is mapped.
        gray2: (h, w) uint8 image.
        homography: (3, 3) image2_from_image1 in pixel-centre px.

    Returns:
        The median over windows with texture; 0 without any.
    """
    height, width = gray2.shape
    scale = COMPARED_SIZE_PX / max(height, width)
    size = (round(width * scale), round(height * scale))
    shrunk_from_image1 = resized_from_original((width, height), size) @ homography
    second = cv2.resize(gray2, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    blur_px = 0.5 / np.sqrt(abs(np.linalg.det(shrunk_from_image1[:2, :2])))
    blurred = cv2.GaussianBlur(gray1, (0, 0), blur_px).astype(np.float32)
    warped = cv2.warpPerspective(blurred, shrunk_from_image1, size, borderValue=-1.0)
    first = np.asarray(warped, np.float32)
    is_visible = (first >= 0.0).astype(np.uint8)
    is_whole_window = cv2.erode(is_visible, np.ones((WINDOW_PX, WINDOW_PX))) > 0
    mean1 = _window_means(first)
    mean2 = _window_means(second)
    variance1 = _window_means(first * first) - mean1**2
    variance2 = _window_means(second * second) - mean2**2
    covariance = _window_means(first * second) - mean1 * mean2
    deviations = np.sqrt(np.maximum(variance1 * variance2, 1.0))
    has_texture = np.maximum(variance1, variance2) > MIN_VARIANCE
    correlations = (covariance / deviations)[is_whole_window & has_texture]
    return float(np.median(correlations)) if correlations.size else 0.0


def _window_means(image: Singles) -> Singles:
    return np.asarray(cv2.blur(image, (WINDOW_PX, WINDOW_PX)), np.float32)


def mirrored_share(points1: Floats, points2: Floats, sizes: tuple[Size, Size]) -> float:
    """Return the ratio of keypoints of an image that a mirrored copy, of any size, has too.

    It is the ratio of the image with fewer keypoints, as a smaller copy does not keep all. What
    chance brings is subtracted, which of dense keypoints is most, and the rest is a ratio of what
    chance leaves.

    Args:
        points1: (N, 2) px in the first image.
        points2: (M, 2) px in the second image.
        sizes: (width, height) px of both images.

    Returns:
        The larger ratio of both axes.
    """
    if len(points2) < len(points1):
        return mirrored_share(points2, points1, (sizes[1], sizes[0]))
    size1, size2 = sizes
    if not len(points1):
        return 0.0
    height = size1[1] + 2 * MARGIN_PX
    width = size1[0] + 2 * MARGIN_PX
    is_keypoint = np.zeros((height, width), np.uint8)
    in_first = points2 * np.divide(size1, size2)
    is_keypoint[_pixels(in_first, size1)] = 1
    is_near = np.asarray(cv2.dilate(is_keypoint, np.ones((3, 3), np.uint8)))
    ratios = [0.0]
    for axis in (0, 1):
        mirrored = _sampled(points1.astype(np.float64))
        mirrored[:, axis] = size1[axis] - mirrored[:, axis]
        ratio = is_near[_pixels(mirrored, size1)].mean()
        by_chance = is_near[_pixels(mirrored + DISPLACEMENT_PX, size1)].mean()
        free = max(1.0 - by_chance, MIN_FREE_RATIO)
        ratios.append(float((ratio - by_chance) / free))
    return max(ratios)


def _pixels(points: Floats, size: Size) -> tuple[Indices, Indices]:
    """Return rows and columns of points in an image of (width, height) with a margin."""
    pixels = np.floor(points).astype(np.int64) + MARGIN_PX
    last = np.array(size) + 2 * MARGIN_PX - 1
    columns, rows = np.clip(pixels, 0, last).T
    return rows, columns
