"""Planes from depth maps: normals, their clusters on the sphere, and views from the front.

Depth is z-depth along the optical axis, NaN where unknown, of any unit. Normals are of unit
length in camera coordinates (x right, y down, z forward) and face the camera: n . r < 0 for the
ray r that sees the surface.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.conventions import grid_origin

WINDOW_RADIUS = 2
WINDOW_SIGMA_PX = 0.8  # Gaussian weights of the 5 x 5 window of a plane (the authors' values)
MIN_WEIGHT_FRAC = 0.5  # of the window's weight that known neighbours need; a mere line has 0.499
MAX_SLANT_COS = np.cos(np.deg2rad(85.0))  # steeper neighbours are on another surface
SPIRAL_STEP = 3.6  # of neighbours on the spiral, times sqrt(N) (Saff & Kuijlaars)


def shrink_depth(depth: Floats, max_size_px: int) -> tuple[Floats, Array]:
    """Average 1/z over square blocks until the longer side is at most ``max_size_px``.

    Inverse depth of a plane is affine in the pixel, so planes stay exact. A block with an
    unknown pixel is unknown; incomplete blocks at the right and lower side are dropped. Returns
    the depth map and the (3, 3) map to its pixel-centre px from those of the given one.
    """
    step = -(-max(depth.shape) // max_size_px)
    step_y, step_x = np.minimum(step, depth.shape).tolist()
    rows, columns = depth.shape[0] // step_y, depth.shape[1] // step_x
    blocks = depth[: rows * step_y, : columns * step_x].reshape(rows, step_y, columns, step_x)
    given_from_shrunk = np.diag([float(step_x), float(step_y), 1.0])
    given_from_shrunk[:2, 2] = grid_origin(step_x), grid_origin(step_y)
    return 1.0 / np.mean(1.0 / blocks, axis=(1, 3)), np.linalg.inv(given_from_shrunk)


def normals_from_depth(depth: Floats, camera_matrix: Floats) -> Array:
    """Fit a plane to the 5 x 5 window of each pixel of a depth map and return its normal.

    Along a plane 1/z is an affine function of the pixel, fitted by least squares with Gaussian
    weights. Neighbours whose 1/z differs from the centre's by more than a plane seen at 85 degrees
    would make it, |dr| / cos 85 deg times for rays that differ by dr, have weight 0.

    From (h, w) depth and (3, 3) intrinsics in pixel-centre px of the depth map to (h, w, 3) unit
    normals, NaN where the pixel or too much of its window is unknown.
    """
    height, width = depth.shape
    inverse = 1.0 / np.asarray(depth, dtype=np.float64)
    padded = np.pad(inverse, WINDOW_RADIUS, constant_values=np.nan)
    ray_from_pixel = np.linalg.inv(camera_matrix)
    offsets = range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
    total_weight = 0.0
    moments = np.zeros((9, height, width))
    for dy in offsets:
        for dx in offsets:
            weight = np.exp(-(dx**2 + dy**2) / (2.0 * WINDOW_SIGMA_PX**2))
            total_weight += weight
            top, left = dy + WINDOW_RADIUS, dx + WINDOW_RADIUS
            change = padded[top : top + height, left : left + width] / inverse - 1.0
            ray_change = np.linalg.norm(ray_from_pixel[:, :2] @ [dx, dy])
            known = np.abs(change) <= ray_change / MAX_SLANT_COS
            weights, weighted = weight * known, weight * np.where(known, change, 0.0)
            for index, factor in enumerate((1, dx, dy, dx * dx, dx * dy, dy * dy)):
                moments[index] += factor * weights
            for index, factor in enumerate((1, dx, dy), start=6):
                moments[index] += factor * weighted
    enough = moments[0] >= MIN_WEIGHT_FRAC * total_weight
    slope_x, slope_y, change = _weighted_line(np.where(enough, moments, np.nan))
    # As a form l . (x, y, 1) of the pixel; on rays r it is (K^T l) . r, and n is along -K^T l.
    constant = 1.0 + change - slope_x * np.arange(width) - slope_y * np.arange(height)[:, None]
    forms = np.stack([slope_x, slope_y, constant], axis=-1) @ np.asarray(camera_matrix)
    return np.asarray(-forms / np.linalg.norm(forms, axis=-1, keepdims=True))


def _weighted_line(moments: Array) -> tuple[Array, Array, Array]:
    """Return slopes in x and y and the value at 0 from sums of w, wx, wy, wxx ... and q, qx, qy."""
    x, y, xx, xy, yy, q, qx, qy = moments[1:] / moments[0]
    xx, xy, yy, qx, qy = xx - x * x, xy - x * y, yy - y * y, qx - q * x, qy - q * y
    determinant = xx * yy - xy * xy
    slope_x = (yy * qx - xy * qy) / determinant
    slope_y = (xx * qy - xy * qx) / determinant
    return slope_x, slope_y, q - slope_x * x - slope_y * y


def spiral_points(num_points: int) -> Array:
    """Return (N, 3) points spread evenly over the unit sphere, along a spiral about z.

    Heights are equidistant (Saff & Kuijlaars 1997, both ends half a step off the poles).
    """
    heights = 1.0 - (2.0 * np.arange(num_points) + 1.0) / num_points
    radii = np.sqrt(1.0 - heights**2)
    longitudes = np.cumsum(SPIRAL_STEP / (np.sqrt(num_points) * radii))
    return np.stack([radii * np.cos(longitudes), radii * np.sin(longitudes), heights], axis=1)


@dataclass(frozen=True)
class PlaneClusters:
    """Directions that many normals share."""

    normals: Array  # (K, 3) unit normals in order of choice; K may be 0
    labels: NDArray[np.int32]  # (h, w) the nearest of them for each pixel, -1 where none is near


def cluster_normals(
    normals: Floats,
    *,
    num_candidates: int,
    bin_angle_rad: float,
    min_separation_rad: float,
    max_num_planes: int,
    min_votes_frac: float,
) -> PlaneClusters:
    """Choose directions that most (h, w, 3) normals share, then give each normal to the nearest.

    Candidates are the :func:`spiral_points` of the whole sphere. After each choice the direction
    moves to the mean of its normals, those then within the bin are taken away, and the others vote
    again (the authors counted once).

    Normals (unit, NaN where unknown) at most ``bin_angle_rad`` from a direction belong to it, which
    needs ``min_votes_frac`` of all h w pixels.
    """
    known = ~np.isnan(normals).any(axis=-1)
    waiting = np.asarray(normals[known], dtype=np.float32)
    candidates = spiral_points(num_candidates)
    bin_cos, separation_cos = float(np.cos(bin_angle_rad)), float(np.cos(min_separation_rad))
    votes = _votes(candidates, waiting, bin_cos)
    centers = np.zeros((0, 3))
    while len(centers) < max_num_planes:
        far = (candidates @ centers.T).max(axis=1, initial=-1.0) <= separation_cos
        best = int(np.argmax(np.where(far, votes, 0)))
        if not far[best] or votes[best] < max(min_votes_frac * known.size, 1):
            break
        near = waiting[waiting @ candidates[best].astype(waiting.dtype) >= bin_cos]
        mean = np.ones(len(near)) @ near.astype(np.float64)
        center = mean / np.linalg.norm(mean)
        centers = np.concatenate([centers, center[None]])
        taken = _cosines(waiting, center[None])[:, 0] >= bin_cos
        votes -= _votes(candidates, waiting[taken], bin_cos)
        waiting = waiting[~taken]
    labels = np.full(known.shape, -1, dtype=np.int32)
    if len(centers):
        cosines = _cosines(normals[known], centers)
        labels[known] = np.where(cosines.max(axis=1) >= bin_cos, cosines.argmax(axis=1), -1)
    return PlaneClusters(centers, labels)


def fronto_parallel_homography(normal: Floats, camera_matrix: Floats) -> Array:
    """Return the (3, 3) map to the view that a camera turned towards a plane would have.

    It is K R K^-1, with intrinsics K in pixel-centre px and R the smallest rotation that turns -n,
    which points into the plane, onto the optical axis; n = (0, 0, -1) gives the identity. Its third
    coordinate at a pixel (x, y, 1) is -n . r with the pixel's ray r = K^-1 (x, y, 1): positive
    where the pixel can see the front of the plane.
    """
    x, y, z = -np.asarray(normal, dtype=np.float64)
    turn = np.array([[0.0, 0.0, -x], [0.0, 0.0, -y], [x, y, 0.0]])
    rotation = np.eye(3) + turn + turn @ turn / (1.0 + z)
    return np.asarray(camera_matrix @ rotation @ np.linalg.inv(camera_matrix))


def viewing_cosines(normal: Floats, camera_matrix: Floats, size: tuple[int, int]) -> Array:
    """Return (h, w) cosines of rays against a plane's normal: 1 from the front, < 0 from behind."""
    width, height = size
    ray_from_pixel = np.linalg.inv(camera_matrix)
    columns, rows = np.arange(width), np.arange(height)[:, None]
    x, y, z = (form[0] * columns + form[1] * rows + form[2] for form in ray_from_pixel)
    towards = -(normal[0] * x + normal[1] * y + normal[2] * z)
    return np.asarray(towards / np.sqrt(x * x + y * y + z * z))


def _cosines(directions: Floats, centers: Floats) -> Floats:
    return np.asarray(directions @ centers.T.astype(directions.dtype))


def _votes(candidates: Array, normals: Floats, bin_cos: float) -> Indices:
    by_axis = np.asfortranarray(normals)  # several times faster than rows of three
    counts = [np.count_nonzero(_cosines(by_axis, each[None]) >= bin_cos) for each in candidates]
    return np.array(counts)
