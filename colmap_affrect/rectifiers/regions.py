"""Regions of an image and the warps that show them, each on a canvas that just holds it."""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from colmap_affrect.data import Mask, Rectification, in_mask
from colmap_affrect.geometry.affine import fit_canvas, project, transform_lafs
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.tilts import tilts_from_metrics, unit_metrics

MARGIN_PX = 16.0  # surroundings of a region that its descriptors may see, in px of the warp; judged
CANVAS_RATIO = 2.0
"""Area of the canvas of a homography, without margin, over that of the region (the authors'
value); paper."""


@dataclass(frozen=True)
class Region:
    """Part of an image."""

    mask: Mask  # (h, w) bool, cropped to the part
    origin: tuple[int, int]  # (x, y) image pixel of the mask's first pixel

    @property
    def area_px(self) -> int:
        """Number of its pixels."""
        return int(np.count_nonzero(self.mask))

    def outline(self) -> Array:
        """Return (N, 2) pixel centres in the image whose convex hull is that of the region."""
        rows = np.flatnonzero(self.mask.any(axis=1))
        first_columns = self.mask[rows].argmax(axis=1)
        last_columns = self.mask.shape[1] - 1 - self.mask[rows, ::-1].argmax(axis=1)
        x = np.concatenate([first_columns, last_columns])
        y = np.concatenate([rows, rows])
        return np.asarray(np.stack([x, y], axis=1) + self.origin, dtype=np.float64)

    def contains(self, points: Floats) -> Mask:
        """Return which (N, 2) points, rounded to pixels, belong to it."""
        return in_mask(self.mask, points, self.origin)


def homography_rectification(
    region: Region, homography: Array, segment_id: int
) -> Rectification:
    """Plan the warp of a region by a homography, scaled so that the canvas has twice its area.

    Args:
        region: part of the image.
        homography: (3, 3) map of image px, with a positive determinant, and positive third
            coordinates all over the region.
        segment_id: number of the region, for reports.

    Returns:
        The warp, with the tilt class of the homography in the middle of the region.
    """
    outline = project(homography, region.outline())
    box_area = float(np.prod(np.ptp(outline, axis=0) + 1.0))
    scale = sqrt(CANVAS_RATIO * region.area_px / box_area)
    canvas_from_mapped, canvas_size = fit_canvas(scale * np.eye(2), outline, MARGIN_PX)
    matrix = canvas_from_mapped @ homography
    middle = np.argwhere(region.mask).mean(axis=0)[::-1] + region.origin
    laf = np.concatenate([np.eye(2), middle[:, None]], axis=1)
    (mapped,) = transform_lafs(matrix, laf[None])
    tilt, angle_rad = tilts_from_metrics(unit_metrics(mapped[:, :2]))
    return Rectification(
        rectified_from_image=matrix,
        canvas_size=canvas_size,
        region=region.mask,
        tilt=float(tilt),
        tilt_angle_rad=float(angle_rad),
        region_origin=region.origin,
        segment_id=segment_id,
    )
