"""Exact warps of images and of their regions, free of aliasing."""

from collections.abc import Iterator
from math import ceil, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import ColorImage, GrayImage, Mask, Rectification
from colmap_affrect.geometry.affine import lafs_from_keypoints, transform_lafs
from colmap_affrect.geometry.arrays import Array, Bytes, Singles
from colmap_affrect.geometry.conventions import is_inside

# Px of the source, times sqrt(c^2 - 1) before a compression by c (ASIFT); paper
ANTI_ALIASING_SIGMA = 0.8
# Of the square tiles of homographies, each blurred for its strongest compression; resource
TILE_PX = 64
# Points along a side of a tile at which its compression is measured
SAMPLES_PER_TILE = 5
# Samples per px of a warp along an axis; beyond, memory counts more than aliasing; resource
MAX_DENSITY = 16


def half_size(image: Singles) -> Singles:
    """Return an (H, W) image blurred and resampled to half its size, as kornia's ``pyrdown``."""
    kernel = np.array([1, 4, 6, 4, 1], dtype=np.float32) / 16
    smooth = cv2.sepFilter2D(
        image,
        ddepth=-1,
        kernelX=kernel,
        kernelY=kernel,
        borderType=cv2.BORDER_REFLECT_101,
    )
    return np.asarray(
        cv2.resize(
            smooth,
            dsize=(image.shape[1] // 2, image.shape[0] // 2),
            interpolation=cv2.INTER_LINEAR,
        ),
        dtype=np.float32,
    )


def warp(
    image: GrayImage | ColorImage | Singles, rectification: Rectification
) -> Bytes:
    """Render a rectification: one exact resampling, free of aliasing where it compresses.

    The image is resampled once, on a grid that is denser than the warp by integer factors, blurred,
    and decimated by them. Outside the image its border is reflected.

    From (H, W) or (H, W, 3) levels 0 to 255, by an affine map diag(sx, sy) R(phi) + translation
    with sx >= 1 >= sy or any homography, to (height, width) or (height, width, 3) uint8; what lies
    behind the camera has no meaning.
    """
    # Rounding to 8 bits between the steps would shift edges by up to 0.1 px.
    source = np.asarray(image, dtype=np.float32)
    if rectification.is_affine:
        return _warp_affine(source, rectification)
    warped = np.empty(
        (*rectification.canvas_size[::-1], *source.shape[2:]), dtype=np.uint8
    )
    for tile, image_from_tile in _tiles(warped, rectification):
        tile[:] = np.rint(_warp_tile(source, image_from_tile, size=tile.shape[1::-1]))
    return warped


def _warp_affine(source: Singles, rectification: Rectification) -> GrayImage:
    """Warp on rows that are ``ceil(1/sy)`` times denser, blurred along the compressed axis."""
    matrix = rectification.rectified_from_image
    width, height = rectification.canvas_size
    compression = 1.0 / float(np.hypot(*matrix[1, :2]))
    density = max(1, ceil(compression - 1e-9))
    dense_from_image = np.diag([1.0, density, 1.0]) @ matrix
    dense = cv2.warpAffine(
        source,
        M=dense_from_image[:2],
        dsize=(width, (height - 1) * density + 1),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    sigma_px = _anti_aliasing_sigma(compression, density)
    if sigma_px > 0.0:
        dense = cv2.GaussianBlur(dense, (1, 2 * ceil(3 * sigma_px) + 1), sigma_px)
    return np.asarray(np.rint(dense[::density]), dtype=np.uint8)


def _anti_aliasing_sigma(compression: float, density: int) -> float:
    """Return the blur before a compression, in px of a grid ``density`` times the warp's."""
    blur = ANTI_ALIASING_SIGMA * sqrt(max(compression**2 - 1.0, 0.0))
    return blur * density / compression


def _tiles(
    canvas: Bytes, rectification: Rectification
) -> Iterator[tuple[Bytes, Array]]:
    """Yield views of the tiles of a canvas and their (3, 3) maps image_from_tile."""
    image_from_canvas = rectification.image_from_rectified
    for top in range(0, canvas.shape[0], TILE_PX):
        for left in range(0, canvas.shape[1], TILE_PX):
            image_from_tile = image_from_canvas.copy()
            image_from_tile[:, 2] = image_from_canvas @ [left, top, 1.0]
            yield canvas[top : top + TILE_PX, left : left + TILE_PX], image_from_tile


def _warp_tile(
    source: Singles, image_from_tile: Array, size: tuple[int, int]
) -> Singles:
    """Render one tile of (width, height), with surroundings as far as the blur reaches."""
    compressions = _compressions(image_from_tile, size, image_size=source.shape[1::-1])
    densities = np.minimum(np.ceil(compressions - 1e-9), MAX_DENSITY)
    density_x, density_y = densities.astype(int)
    sigma_x = _anti_aliasing_sigma(compressions[0], density_x)
    sigma_y = _anti_aliasing_sigma(compressions[1], density_y)
    reach_x = ceil(3 * sigma_x)
    reach_y = ceil(3 * sigma_y)
    columns = np.arange(-reach_x, (size[0] - 1) * density_x + reach_x + 1) / density_x
    rows = np.arange(-reach_y, (size[1] - 1) * density_y + reach_y + 1) / density_y
    x, y, _ = _source_points(
        image_from_tile, columns, rows, image_size=source.shape[1::-1]
    )
    dense = cv2.remap(
        source,
        map1=x,
        map2=y,
        interpolation=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    dense = cv2.GaussianBlur(
        dense,
        ksize=(2 * reach_x + 1, 2 * reach_y + 1),
        sigmaX=sigma_x,
        sigmaY=sigma_y,
    )
    rows_end = dense.shape[0] - reach_y
    columns_end = dense.shape[1] - reach_x
    return np.asarray(dense[reach_y:rows_end:density_y, reach_x:columns_end:density_x])


def _compressions(
    image_from_tile: Array, size: tuple[int, int], image_size: tuple[int, int]
) -> Array:
    """Return how many image px a px of the tile spans at most, in x and in y, at least 1."""
    columns, rows = (np.linspace(0, extent - 1, SAMPLES_PER_TILE) for extent in size)
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    points = points[points @ image_from_tile[2, :2] + image_from_tile[2, 2] > 0.0]
    unit = lafs_from_keypoints(
        points, radii_px=np.ones(len(points)), angles_rad=np.zeros(len(points))
    )
    spans = transform_lafs(image_from_tile, unit)
    seen = is_inside(spans[:, :, 2], image_size)
    return np.asarray(
        np.linalg.norm(spans[seen, :, :2], axis=1).max(axis=0, initial=1.0)
    )


def _source_points(
    image_from_tile: Array,
    columns: NDArray[np.number],
    rows: NDArray[np.number],
    image_size: tuple[int, int],
) -> tuple[Singles, Singles, Mask]:
    """Return x and y in the image of a grid of points of a tile, and what is before the camera.

    Points further than an image size away are moved there: a border is reflected once.
    """
    x, y, depth = (
        form[0] * columns + form[1] * rows[:, None] + form[2]
        for form in image_from_tile
    )
    is_ahead = depth > 0.0
    depth = np.where(is_ahead, depth, 1.0)
    width, height = image_size
    x = np.clip(x / depth, -width, 2 * width)
    y = np.clip(y / depth, -height, 2 * height)
    return x.astype(np.float32), y.astype(np.float32), is_ahead


def mask_values(mask: Mask) -> Bytes:
    """Return an (H, W) mask as uint8, 255 inside and 0 outside."""
    return mask.astype(np.uint8) * 255


def warp_mask(rectification: Rectification, image_size: tuple[int, int]) -> Bytes:
    """Carry the region of a rectification of an image of (width, height) px into its warp.

    To (height, width) uint8 of the canvas, nearest: 255 inside, 0 outside and behind the camera.
    """
    region = rectification.region
    if region is None:
        region = np.ones(image_size[::-1], dtype=bool)
    values = mask_values(region)
    image_from_region = np.eye(3)
    image_from_region[:2, 2] = rectification.region_origin
    if rectification.is_affine:
        matrix = rectification.rectified_from_image @ image_from_region
        return np.asarray(
            cv2.warpAffine(
                values,
                M=matrix[:2],
                dsize=rectification.canvas_size,
                flags=cv2.INTER_NEAREST,
            ),
            np.uint8,
        )
    mask = np.empty(rectification.canvas_size[::-1], dtype=np.uint8)
    region_from_image = np.linalg.inv(image_from_region)
    for tile, image_from_tile in _tiles(mask, rectification):
        rows, columns = map(np.arange, tile.shape)
        x, y, ahead = _source_points(
            region_from_image @ image_from_tile,
            columns,
            rows,
            image_size=region.shape[::-1],
        )
        inside = cv2.remap(
            values,
            map1=x,
            map2=y,
            interpolation=cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT,
        )
        tile[:] = np.where(ahead, inside, 0)
    return mask
