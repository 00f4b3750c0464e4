"""Planes in depth maps: their normals, clusters of normals, and fronto-parallel views.

Depth is z-depth along the optical axis, NaN where unknown, of any unit. Normals have unit length
and are in camera coordinates (x right, y down, z forward). They face the camera: n . r < 0 for the
ray r of the pixel.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.conventions import grid_origin

WINDOW_RADIUS_PX = 2  # a plane is fitted to 5 x 5 px (the value of the paper's authors)
WINDOW_SIGMA_PX = 0.8  # of its Gaussian weights (the value of the paper's authors)
MIN_WEIGHT_FRAC = 0.5
"""Share of the window's weight that known neighbours need; a mere line has 0.499 of it; theory."""
MAX_SLANT_COS = np.cos(np.deg2rad(85.0))
"""Cosine of the largest viewing angle of a plane; steeper neighbours are on another
surface; judged."""
# Distance of neighbours on the spiral, times sqrt(N) (Saff & Kuijlaars 1997); paper
SPIRAL_STEP = 3.6


def shrink_depth(depth: Floats, max_size_px: int) -> tuple[Floats, Array]:
    """Average 1/z over square blocks until the longer side is at most ``max_size_px``.

    The inverse depth of a plane is an affine function of the pixel, so planes stay exact. A block
    with an unknown pixel is unknown. Incomplete blocks at the right and lower side are dropped.

    Returns:
        The depth map, and the (3, 3) shrunk_from_given in pixel-centre px.
    """
    step = math.ceil(max(depth.shape) / max_size_px)
    step_y = min(step, depth.shape[0])
    step_x = min(step, depth.shape[1])
    num_rows = depth.shape[0] // step_y
    num_columns = depth.shape[1] // step_x
    whole = depth[: num_rows * step_y, : num_columns * step_x]
    blocks = whole.reshape(num_rows, step_y, num_columns, step_x)
    given_from_shrunk = np.diag([float(step_x), float(step_y), 1.0])
    given_from_shrunk[:2, 2] = grid_origin(step_x), grid_origin(step_y)
    shrunk = 1.0 / np.mean(1.0 / blocks, axis=(1, 3))
    return shrunk, np.linalg.inv(given_from_shrunk)


def normals_from_depth(depth: Floats, camera_matrix: Floats) -> Array:
    """Fit a plane to the 5 x 5 window of each pixel of a depth map and return its normal.

    Along a plane 1/z is an affine function of the pixel, fitted by least squares with Gaussian
    weights. Neighbours whose 1/z differs from the centre's by more than a plane seen at 85 degrees
    would make it, |dr| / cos 85 deg times for rays that differ by dr, have weight 0.

    Args:
        depth: (h, w), NaN where unknown.
        camera_matrix: (3, 3) intrinsics in pixel-centre px of the depth map.

    Returns:
        (h, w, 3) unit normals, NaN where the pixel or too much of its window is unknown.
    """
    height, width = depth.shape
    inverse = 1.0 / np.asarray(depth, dtype=np.float64)
    padded = np.pad(inverse, WINDOW_RADIUS_PX, constant_values=np.nan)
    ray_from_pixel = np.linalg.inv(camera_matrix)
    offsets = range(-WINDOW_RADIUS_PX, WINDOW_RADIUS_PX + 1)
    total_weight = 0.0
    moments = np.zeros((6, height, width))  # sums of w times 1, x, y, x x, x y, y y
    # Sums of w times the change times 1, x, y
    change_moments = np.zeros((3, height, width))
    for dy in offsets:
        top = dy + WINDOW_RADIUS_PX
        for dx in offsets:
            left = dx + WINDOW_RADIUS_PX
            weight = np.exp(-(dx**2 + dy**2) / (2.0 * WINDOW_SIGMA_PX**2))
            total_weight += weight
            change = padded[top : top + height, left : left + width] / inverse - 1.0
            ray_change = np.linalg.norm(ray_from_pixel[:, :2] @ [dx, dy])
            is_same_plane = np.abs(change) <= ray_change / MAX_SLANT_COS
            weights = weight * is_same_plane
            weighted_changes = weight * np.where(is_same_plane, change, 0.0)
            for index, factor in enumerate((1, dx, dy, dx * dx, dx * dy, dy * dy)):
                moments[index] += factor * weights
            for index, factor in enumerate((1, dx, dy)):
                change_moments[index] += factor * weighted_changes
    is_enough = moments[0] >= MIN_WEIGHT_FRAC * total_weight
    sums = np.where(is_enough, moments[0], np.nan)
    slopes_x, slopes_y, changes = _fitted_planes(
        moments[1:] / sums, change_moments / sums
    )
    # As a form l . (x, y, 1) of the pixel; on rays r it is (K^T l) . r, and n is along -K^T l.
    columns = np.arange(width)
    rows = np.arange(height)[:, None]
    constants = 1.0 + changes - slopes_x * columns - slopes_y * rows
    pixel_forms = np.stack([slopes_x, slopes_y, constants], axis=-1)
    ray_forms = pixel_forms @ np.asarray(camera_matrix)
    return np.asarray(-ray_forms / np.linalg.norm(ray_forms, axis=-1, keepdims=True))


def _fitted_planes(means: Array, change_means: Array) -> tuple[Array, Array, Array]:
    """Fit q = a x + b y + c by least squares, in the window of each pixel.

    Args:
        means: (5, h, w) weighted means of x, y, x x, x y and y y.
        change_means: (3, h, w) weighted means of q, q x and q y.

    Returns:
        (h, w) each of a, b and c.
    """
    x, y, xx, xy, yy = means
    q, qx, qy = change_means
    variance_x = xx - x * x
    variance_y = yy - y * y
    covariance = xy - x * y
    covariance_qx = qx - q * x
    covariance_qy = qy - q * y
    determinant = variance_x * variance_y - covariance * covariance
    slope_x = (variance_y * covariance_qx - covariance * covariance_qy) / determinant
    slope_y = (variance_x * covariance_qy - covariance * covariance_qx) / determinant
    return slope_x, slope_y, q - slope_x * x - slope_y * y


def spiral_points(num_points: int) -> Array:
    """Return (N, 3) points spread evenly over the unit sphere, along a spiral about z.

    Heights are equidistant (Saff & Kuijlaars 1997, both ends half a step off the poles).
    """
    heights = 1.0 - (2.0 * np.arange(num_points) + 1.0) / num_points
    radii = np.sqrt(1.0 - heights**2)
    longitudes = np.cumsum(SPIRAL_STEP / (np.sqrt(num_points) * radii))
    return np.stack(
        [radii * np.cos(longitudes), radii * np.sin(longitudes), heights], axis=1
    )


@dataclass(frozen=True)
class PlaneClusters:
    """Directions that many normals share."""

    normals: Array  # (K, 3) unit normals in order of choice; K may be 0
    # (h, w) the nearest of them for each pixel, -1 where none is near
    labels: NDArray[np.int32]


def cluster_normals(
    normals: Floats,
    *,
    num_candidates: int,
    bin_angle_rad: float,
    min_separation_rad: float,
    max_num_planes: int,
    min_votes_frac: float,
) -> PlaneClusters:
    """Choose directions that most normals share, then assign each normal to the nearest.

    Candidates are the :func:`spiral_points` of the whole sphere. After each choice the direction
    moves to the mean of its normals, those then within the bin are taken away, and the others vote
    again (the authors counted once).

    Args:
        normals: (h, w, 3) unit normals, NaN where unknown.
        num_candidates: candidate directions.
        bin_angle_rad: largest angle between a direction and the normals that belong to it.
        min_separation_rad: smallest angle between two directions.
        max_num_planes: directions, at most.
        min_votes_frac: normals that a direction needs, as a share of all h w pixels.

    Returns:
        The directions, and which normals belong to each.
    """
    known = ~np.isnan(normals).any(axis=-1)
    unassigned = np.asarray(normals[known], dtype=np.float32)
    candidates = spiral_points(num_candidates)
    bin_cos = float(np.cos(bin_angle_rad))
    separation_cos = float(np.cos(min_separation_rad))
    min_votes = max(min_votes_frac * known.size, 1)
    votes = _votes(candidates, unassigned, bin_cos)
    centers = np.zeros((0, 3))
    while len(centers) < max_num_planes:
        nearest_cosines = (candidates @ centers.T).max(axis=1, initial=-1.0)
        is_separate = nearest_cosines <= separation_cos
        best = int(np.argmax(np.where(is_separate, votes, 0)))
        if not is_separate[best] or votes[best] < min_votes:
            break
        candidate = candidates[best].astype(unassigned.dtype)
        members = unassigned[unassigned @ candidate >= bin_cos]
        mean = np.ones(len(members)) @ members.astype(np.float64)
        center = mean / np.linalg.norm(mean)
        centers = np.concatenate([centers, center[None]])
        is_assigned = _cosines(unassigned, center[None])[:, 0] >= bin_cos
        votes -= _votes(candidates, unassigned[is_assigned], bin_cos)
        unassigned = unassigned[~is_assigned]
    labels = np.full(known.shape, -1, dtype=np.int32)
    if len(centers):
        cosines = _cosines(normals[known], centers)
        is_near = cosines.max(axis=1) >= bin_cos
        labels[known] = np.where(is_near, cosines.argmax(axis=1), -1)
    return PlaneClusters(centers, labels)


def fronto_parallel_homography(normal: Floats, camera_matrix: Floats) -> Array:
    """Return the map to the view of the same camera turned towards a plane.

    It is K R K^-1, with R the smallest rotation that turns -n, which points into the plane, onto
    the optical axis; n = (0, 0, -1) gives the identity. Its third coordinate at a pixel (x, y, 1)
    is -n . r with the pixel's ray r = K^-1 (x, y, 1): positive where the pixel can see the front of
    the plane.

    Args:
        normal: (3,) n.
        camera_matrix: (3, 3) K in pixel-centre px.

    Returns:
        (3, 3) rectified_from_image.
    """
    x, y, z = -np.asarray(normal, dtype=np.float64)
    cross = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    rotation = np.eye(3) + cross + cross @ cross / (1.0 + z)
    return np.asarray(camera_matrix @ rotation @ np.linalg.inv(camera_matrix))


def viewing_cosines(
    normal: Floats, camera_matrix: Floats, size: tuple[int, int]
) -> Array:
    """Return the cosines of the angles between the rays of an image and a plane's normal.

    Args:
        normal: (3,) of the plane.
        camera_matrix: (3, 3) intrinsics in pixel-centre px.
        size: (width, height) of the image in px.

    Returns:
        (h, w): 1 from the front, below 0 from behind.
    """
    width, height = size
    columns = np.arange(width)
    rows = np.arange(height)[:, None]
    form_x, form_y, form_z = np.linalg.inv(camera_matrix)
    x = form_x[0] * columns + form_x[1] * rows + form_x[2]
    y = form_y[0] * columns + form_y[1] * rows + form_y[2]
    z = form_z[0] * columns + form_z[1] * rows + form_z[2]
    products = -(normal[0] * x + normal[1] * y + normal[2] * z)
    return np.asarray(products / np.sqrt(x * x + y * y + z * z))


def _cosines(normals: Floats, centers: Floats) -> Floats:
    """Return the (N, K) cosines between (N, 3) normals and (K, 3) directions."""
    return np.asarray(normals @ centers.T.astype(normals.dtype))


def _votes(candidates: Array, normals: Floats, bin_cos: float) -> Indices:
    """Count the normals in the bin of each candidate."""
    normals = np.asfortranarray(normals)  # several times faster than rows of three
    counts = []
    for candidate in candidates:
        is_near = _cosines(normals, candidate[None]) >= bin_cos
        counts.append(np.count_nonzero(is_near))
    return np.array(counts)
