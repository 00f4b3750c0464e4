"""Rectifiers by affine maps, of the whole photograph or (``dense-shapes``) of its regions.

``dense-shapes`` covers the shapes of all blocks and assigns each block to its nearest centre. It is
the paper's DenseAffNet (Sec. 3) with an exchangeable shape source.
"""

from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np

from colmap_affrect.data import (
    Mask,
    Photograph,
    Rectification,
    RectificationPlan,
    ShapeGrid,
)
from colmap_affrect.geometry.affine import fit_canvas, image_corners, rectifying_affine
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.tilts import asift_covering, near_optimal_covering
from colmap_affrect.options import within
from colmap_affrect.rectifiers import base
from colmap_affrect.rectifiers.regions import Region

COVERINGS = {"near-optimal": near_optimal_covering, "asift": asift_covering}
# Parts of a region that are closer than this share a canvas: the margins of two would show the
# same pixels twice; resource
GAP_BLOCKS = 5


class IdentityOptions(base.RectifierOptions):
    """No warps."""

    name: Literal["identity"] = "identity"
    warps: ClassVar[base.Warps] = "none"


class Identity(base.WithInputs):
    """The photograph as it is."""

    Options = IdentityOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan no warps."""
        return RectificationPlan(photograph.size)


class AsiftOptions(base.AffineWarpOptions):
    """The same warps of the whole image for every photograph."""

    name: Literal["asift"] = "asift"
    warps: ClassVar[base.Warps] = "all tilts"
    covering: Literal["near-optimal", "asift"] = "near-optimal"
    """``near-optimal``: 24 maps that with the identity cover all tilts to 5.8 (Rodriguez et al.
    2018); ``asift``: the 60 of ASIFT with tilts to 8 (Morel & Yu 2009, the paper)."""


class Asift(base.WithInputs):
    """The same maps for every photograph (Morel & Yu 2009)."""

    Options = AsiftOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Warp the whole photograph by every map of the covering."""
        covering = COVERINGS[self.options.covering]
        return plan_whole_image(photograph.size, covering(), self.options)


class AffNetShapesOptions(base.CoverOptions):
    """The whole photograph is warped by every covering map of its shapes."""

    name: Literal["affnet-shapes"] = "affnet-shapes"
    warps: ClassVar[base.Warps] = "some"


class AffNetShapes(base.WithInputs):
    """A greedy cover of the photograph's own affine shapes (Rodriguez et al. 2018; Sec. 2.4)."""

    Options = AffNetShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Warp the whole photograph by every covering map of its shapes."""
        samples = self.shapes.samples(photograph.gray)
        cover = self.options.cover(samples.metrics)
        return plan_whole_image(photograph.size, cover.centers, self.options)


def plan_whole_image(
    image_size: tuple[int, int], centers: Floats, options: base.AffineWarpOptions
) -> RectificationPlan:
    """Warp an image as a whole by every tilt class.

    A warp is stretched by the tilt along one direction of the photograph, against the direction
    across: a class of angle 0 widens the photograph, one of pi / 2 makes it higher. The angle
    turns from the right upwards, counterclockwise as one looks at the photograph.

    Args:
        image_size: (width, height) in px.
        centers: (K, 2) rows (tilt, angle_rad): by how much, and along which direction of the
            photograph, from 0 up to pi.
        options: whether warps preserve areas.

    Returns:
        One warp for each class.
    """
    items = []
    for tilt, angle in centers.tolist():
        linear = rectifying_affine(tilt, angle, area_preserving=options.area_preserving)
        matrix, canvas_size = fit_canvas(
            linear, image_corners(image_size), margin_px=0.0
        )
        items.append(
            Rectification(
                rectified_from_image=matrix,
                canvas_size=canvas_size,
                region=None,
                tilt=tilt,
                tilt_angle_rad=angle,
            )
        )
    return RectificationPlan(image_size, tuple(items))


class DenseShapesOptions(base.CoverOptions):
    """Each block of the photograph is warped by the covering map nearest to its shape."""

    name: Literal["dense-shapes"] = "dense-shapes"
    warps: ClassVar[base.Warps] = "some"
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.02  # judged
    """Regions of a smaller share of the image are not warped."""
    min_part_frac: Annotated[float, within(0.0, 1.0)] = 0.002  # judged
    """A region in several places is warped piece by piece, and pieces of a smaller share of the
    image are left out. 0: all of a region in one warp (the paper)."""


class DenseShapes(base.WithInputs):
    """Regions of similar shape, one affine map for each (the paper's DenseAffNet)."""

    Options = DenseShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan one warp for each part of each region."""
        return plan_dense_shapes(
            self.shapes.grid(photograph.gray), photograph.size, self.options
        )


def plan_dense_shapes(
    grid: ShapeGrid, image_size: tuple[int, int], options: DenseShapesOptions
) -> RectificationPlan:
    """Turn a grid of shapes into disjoint regions of an image, each with one warp.

    Args:
        grid: shapes of the blocks of the image.
        image_size: (width, height) in px.
        options: of the cover, and which regions are large enough.

    Returns:
        One warp for each part of each region.
    """
    votes = grid.textured.ravel().astype(np.float64)
    cover = options.cover(grid.metrics.reshape(-1, 3), votes)
    labels = cover.labels.reshape(grid.textured.shape)
    min_region_blocks = options.min_region_frac * labels.size
    min_part_blocks = options.min_part_frac * labels.size
    items: list[Rectification] = []
    for label, (tilt, angle) in enumerate(cover.centers.tolist()):
        blocks = (labels == label) & grid.textured
        if np.count_nonzero(blocks) < min_region_blocks:
            continue
        # The canvas of a warp is the bounding box of its region. Of a region with several parts one
        # canvas for each is far smaller than one for all.
        parts = [blocks]
        if options.min_part_frac:
            parts = _connected_parts(blocks, GAP_BLOCKS)
        for part in parts:
            if np.count_nonzero(part) >= min_part_blocks:
                region = _region_of_blocks(part, grid.step_px, image_size)
                items.append(
                    options.warp(
                        region=region,
                        tilt=tilt,
                        angle_rad=angle,
                        segment_id=label,
                    )
                )
    return RectificationPlan(image_size, tuple(items), replaces_original=True)


def _region_of_blocks(
    blocks: Mask, step_px: int, image_size: tuple[int, int]
) -> Region:
    """Return the pixels that blocks of a grid cover.

    Args:
        blocks: (R, C) which blocks of the image.
        step_px: width of a block.
        image_size: (width, height) in px, which the last blocks may exceed.

    Returns:
        The region.
    """
    rows = np.flatnonzero(blocks.any(axis=1))
    columns = np.flatnonzero(blocks.any(axis=0))
    cropped = blocks[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    left = int(columns[0]) * step_px
    top = int(rows[0]) * step_px
    width_inside = image_size[0] - left
    height_inside = image_size[1] - top
    mask = np.repeat(np.repeat(cropped, step_px, axis=0), step_px, axis=1)
    return Region(mask=mask[:height_inside, :width_inside], origin=(left, top))


def _connected_parts(mask: Mask, gap: int) -> list[Mask]:
    """Split an (H, W) mask into parts of pixels that are at most ``gap`` - 1 px apart."""
    joined = cv2.dilate(mask.astype(np.uint8), np.ones((gap, gap), np.uint8))
    num_labels, labels = cv2.connectedComponents(joined, connectivity=8)
    return [mask & (labels == label) for label in range(1, num_labels)]
