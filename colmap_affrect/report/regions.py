"""The regions of a plan: where they lie, how large they are, and their colours in pictures."""

import cv2
import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb

from colmap_affrect.data import ColorImage, Mask, Photograph, Rectification, RectificationPlan
from colmap_affrect.geometry.affine import project, transform_frames
from colmap_affrect.geometry.arrays import Array

Color = tuple[float, float, float]
Size = tuple[int, int]

PALETTE = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#F0E442", "#882255")
"""Okabe and Ito's colours for all kinds of colour vision, and one of Paul Tol's."""
ANGLE_COLORS = LinearSegmentedColormap.from_list(
    "tilt angle", [PALETTE[index] for index in (0, 5, 2, 6, 1, 4, 3, 0)]
)
"""For more maps than the palette has colours: a circle, since the tilt angle has period pi."""

TINT = 0.45  # share of the colour over a region

TURN = np.linspace(0.0, 2.0 * np.pi, 25)
UNIT_CIRCLE = np.stack([np.cos(TURN), np.sin(TURN)])


def warp_colors(plan: RectificationPlan) -> list[Color]:
    """Choose a colour for each warp of a plan.

    Warps of one segment, or of one class that shows the whole image, have the same. Where that is
    more than the palette has, the tilt angle decides.
    """
    keys = [
        (item.tilt, item.tilt_angle_rad) if item.region is None else item.segment_id
        for item in plan.items
    ]
    groups = list(dict.fromkeys(keys))
    if len(groups) > len(PALETTE):
        return [to_rgb(ANGLE_COLORS(item.tilt_angle_rad / np.pi)) for item in plan.items]
    return [to_rgb(PALETTE[groups.index(key)]) for key in keys]


def largest_warps(plan: RectificationPlan, count: int) -> list[int]:
    """Return the indices of the warps with the largest canvases, the largest first."""
    order = sorted(range(len(plan.items)), key=lambda index: -plan.items[index].canvas_area_px)
    return order[:count]


def tinted(photograph: Photograph, plan: RectificationPlan) -> ColorImage:
    """Return the (H, W, 3) photograph with each region in the colour of its warp."""
    image = np.repeat(photograph.gray[:, :, None], 3, axis=2)
    for item, color in zip(plan.items, warp_colors(plan), strict=True):
        if item.region is not None:
            rows, columns = np.nonzero(item.region)
            pixels = rows + item.region_origin[1], columns + item.region_origin[0]
            mixed = (1.0 - TINT) * photograph.gray[pixels][:, None] + TINT * 255.0 * np.array(color)
            image[pixels] = np.rint(mixed).astype(np.uint8)
    return image


def region_area_px(item: Rectification, image_size: Size) -> int:
    """Count the pixels of a region in an image of (width, height)."""
    if item.region is None:
        return image_size[0] * image_size[1]
    return int(np.count_nonzero(item.region))


def bounding_box(item: Rectification, image_size: Size) -> tuple[int, int, int, int]:
    """Return left, top, width and height of a region in an image of (width, height), in px."""
    if item.region is None:
        return (0, 0, *image_size)
    left, top, width, height = cv2.boundingRect(item.region.astype(np.uint8))
    return left + item.region_origin[0], top + item.region_origin[1], width, height


def region_middle(region: Mask, origin: tuple[int, int]) -> Array:
    """Return the (2,) pixel of an (h, w) region that is nearest to its centre of mass, image px."""
    rows, columns = np.nonzero(region)
    points = np.stack([columns, rows], axis=1).astype(np.float64)
    nearest = np.argmin(((points - points.mean(axis=0)) ** 2).sum(axis=1))
    return np.asarray(points[nearest] + origin)


def circle_origin(item: Rectification, middle: Array, radius_px: float) -> Array:
    """Return the (2, N) ellipse round a point, image px, that a warp turns into a circle.

    Its area is that of a circle of ``radius_px``.
    """
    ((x, y),) = project(item.rectified_from_image, middle[None])
    (frame,) = transform_frames(
        item.image_from_rectified, np.array([[[1.0, 0.0, x], [0.0, 1.0, y]]])
    )
    shape = frame[:, :2] * radius_px / np.sqrt(np.linalg.det(frame[:, :2]))
    return np.asarray(shape @ UNIT_CIRCLE + middle[:, None])
