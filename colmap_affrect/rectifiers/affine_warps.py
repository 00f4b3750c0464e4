"""Rectifiers by affine maps: of the whole photograph, or ``dense-shapes`` of its regions.

``dense-shapes`` covers the shapes of all blocks, and gives each block to its nearest centre: the
paper's DenseAffNet (Sec. 3) with an exchangeable shape source.
"""

from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np

from colmap_affrect.data import Mask, Photograph, Rectification, RectificationPlan, ShapeGrid
from colmap_affrect.geometry.affine import fit_canvas, image_corners, rectifying_affine
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.tilts import asift_covering, near_optimal_covering
from colmap_affrect.options import within
from colmap_affrect.rectifiers import base
from colmap_affrect.rectifiers.regions import Region

COVERINGS = {"near-optimal": near_optimal_covering, "asift": asift_covering}
GAP_BLOCKS = 5  # groups of blocks closer than this are warped together


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
        return plan_whole_image(photograph.size, COVERINGS[self.options.covering](), self.options)


class AffNetShapesOptions(base.CoverOptions):
    """The whole photograph is warped by every covering map of its shapes."""

    name: Literal["affnet-shapes"] = "affnet-shapes"
    warps: ClassVar[base.Warps] = "some"


class AffNetShapes(base.WithInputs):
    """A greedy cover of the photograph's own affine shapes (Rodriguez et al. 2018; Sec. 2.4)."""

    Options = AffNetShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Warp the whole photograph by every covering map of its shapes."""
        centers = self.options.cover(self.shapes.samples(photograph.gray).metrics).centers
        return plan_whole_image(photograph.size, centers, self.options)


def plan_whole_image(
    image_size: tuple[int, int], centers: Floats, options: base.AffineWarpOptions
) -> RectificationPlan:
    """Warp an image of (width, height) as a whole by (K, 2) classes (tilt, angle_rad)."""
    items = []
    for tilt, angle in centers.tolist():
        linear = rectifying_affine(tilt, angle, area_preserving=options.area_preserving)
        matrix, canvas_size = fit_canvas(linear, image_corners(image_size), margin_px=0.0)
        items.append(Rectification(matrix, canvas_size, None, tilt, angle))
    return RectificationPlan(image_size, tuple(items))


class DenseShapesOptions(base.CoverOptions):
    """Each block of the photograph is warped by the covering map nearest to its shape."""

    name: Literal["dense-shapes"] = "dense-shapes"
    warps: ClassVar[base.Warps] = "some"
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.02
    """Regions of a smaller share of the image are not warped."""
    min_part_frac: Annotated[float, within(0.0, 1.0)] = 0.002
    """A region in several places is warped piece by piece, and pieces of a smaller share of the
    image are left out. 0: all of a region in one warp (the paper)."""


class DenseShapes(base.WithInputs):
    """Regions of similar shape, one affine map for each (the paper's DenseAffNet)."""

    Options = DenseShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan one warp for each place of each region."""
        return plan_dense_shapes(self.shapes.grid(photograph.gray), photograph.size, self.options)


def plan_dense_shapes(
    grid: ShapeGrid, image_size: tuple[int, int], options: DenseShapesOptions
) -> RectificationPlan:
    """Turn a grid of shapes into disjoint regions of an image of (width, height), one warp each."""
    cover = options.cover(grid.metrics.reshape(-1, 3), grid.textured.ravel().astype(np.float64))
    labels = cover.labels.reshape(grid.textured.shape)
    items: list[Rectification] = []
    for label, (tilt, angle) in enumerate(cover.centers.tolist()):
        blocks = (labels == label) & grid.textured
        if np.count_nonzero(blocks) < options.min_region_frac * labels.size:
            continue
        # The canvas of a warp is the bounding box of its region: for a region in several places one
        # canvas for each is far smaller than one for all.
        parts = _connected_groups(blocks, GAP_BLOCKS) if options.min_part_frac else [blocks]
        for part in parts:
            if np.count_nonzero(part) < options.min_part_frac * labels.size:
                continue
            items.append(options.warp(_region(part, grid, image_size), tilt, angle, label))
    return RectificationPlan(image_size, tuple(items), replaces_original=True)


def _region(blocks: Mask, grid: ShapeGrid, image_size: tuple[int, int]) -> Region:
    """Return the pixels of an image of (width, height) that some blocks of the grid cover."""
    rows, columns = np.flatnonzero(blocks.any(axis=1)), np.flatnonzero(blocks.any(axis=0))
    crop = blocks[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    left, top = int(columns[0]) * grid.step_px, int(rows[0]) * grid.step_px
    mask = np.repeat(np.repeat(crop, grid.step_px, axis=0), grid.step_px, axis=1)
    return Region(mask[: image_size[1] - top, : image_size[0] - left], (left, top))


def _connected_groups(mask: Mask, gap: int) -> list[Mask]:
    """Split an (H, W) mask into groups of pixels that are at most ``gap`` - 1 px apart."""
    joined = cv2.dilate(mask.astype(np.uint8), np.ones((gap, gap), np.uint8))
    num_groups, groups = cv2.connectedComponents(joined, connectivity=8)
    return [mask & (groups == group) for group in range(1, num_groups)]
