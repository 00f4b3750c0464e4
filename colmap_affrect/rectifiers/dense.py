"""Rectifier ``dense-shapes``: cover the shapes of all blocks, then give each to its nearest centre.

The paper's DenseAffNet (Sec. 3) with an exchangeable shape source.
"""

from typing import Annotated, Literal

import numpy as np

from colmap_affrect.data import Mask, Photograph, Rectification, RectificationPlan, ShapeGrid
from colmap_affrect.images.masks import connected_groups
from colmap_affrect.options import within
from colmap_affrect.rectifiers.base import CoverOptions, WithInputs
from colmap_affrect.rectifiers.regions import Region, affine_rectification

GAP_BLOCKS = 5  # groups of blocks closer than this are warped together


class DenseShapesOptions(CoverOptions):
    """Each block of the photograph is warped by the covering map nearest to its shape."""

    name: Literal["dense-shapes"] = "dense-shapes"
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.02
    """Regions of a smaller share of the image are not warped."""
    min_part_frac: Annotated[float, within(0.0, 1.0)] = 0.002
    """A region in several places is warped piece by piece, and pieces of a smaller share of the
    image are left out. 0: all of a region in one warp (the paper)."""


class DenseShapes(WithInputs):
    """Regions of similar shape, one affine map for each (the paper's DenseAffNet)."""

    Options = DenseShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan one warp for each place of each region."""
        return plan_dense_shapes(self.shapes.grid(photograph.gray), photograph.size, self.options)


def plan_dense_shapes(
    grid: ShapeGrid, image_size: tuple[int, int], options: DenseShapesOptions
) -> RectificationPlan:
    """Turn a grid of shapes into disjoint regions of an image of (width, height), one warp each."""
    votes = grid.textured.ravel().astype(np.float64)
    cover = options.cover(grid.metrics.reshape(-1, 3), votes)
    labels = cover.labels.reshape(grid.textured.shape)
    items: list[Rectification] = []
    for label, (tilt, angle) in enumerate(cover.centers.tolist()):
        blocks = (labels == label) & grid.textured
        if np.count_nonzero(blocks) < options.min_region_frac * labels.size:
            continue
        # The canvas of a warp is the bounding box of its region: for a region in several places one
        # canvas for each is far smaller than one for all.
        parts = connected_groups(blocks, GAP_BLOCKS) if options.min_part_frac else [blocks]
        for part in parts:
            if np.count_nonzero(part) < options.min_part_frac * labels.size:
                continue
            region = _region(part, grid, image_size)
            items.append(
                affine_rectification(
                    region, tilt, angle, label, area_preserving=options.area_preserving
                )
            )
    return RectificationPlan(image_size, tuple(items), replaces_original=True)


def _region(blocks: Mask, grid: ShapeGrid, image_size: tuple[int, int]) -> Region:
    """Return the pixels of an image of (width, height) that some blocks of the grid cover."""
    rows, columns = np.flatnonzero(blocks.any(axis=1)), np.flatnonzero(blocks.any(axis=0))
    crop = blocks[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    left, top = int(columns[0]) * grid.step_px, int(rows[0]) * grid.step_px
    mask = np.repeat(np.repeat(crop, grid.step_px, axis=0), grid.step_px, axis=1)
    return Region(mask[: image_size[1] - top, : image_size[0] - left], (left, top))
