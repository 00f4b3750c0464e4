"""Rectifier ``dense-shapes``: disjoint regions inside the image, each with a canvas that fits."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from colmap_affrect.data import Mask, Rectification, RectificationPlan, ShapeGrid
from colmap_affrect.geometry.affine import rectifying_affine
from colmap_affrect.geometry.tilts import metrics_from_tilts, nearest_centers
from colmap_affrect.rectifiers.affine_warps import DenseShapesOptions, plan_dense_shapes

STEP_PX = 4

Tilts = list[tuple[float, float]]


def shape_grid(
    classes: Tilts, labels: np.ndarray, textured: np.ndarray | None = None
) -> ShapeGrid:
    """A grid whose cell (r, c) has the class ``classes[labels[r, c]]``."""
    metrics = metrics_from_tilts(*np.array(classes).T)[labels]
    textured = np.ones(labels.shape, bool) if textured is None else textured
    return ShapeGrid(metrics, textured, 1.5, STEP_PX)


def image_region(item: Rectification, size: tuple[int, int]) -> Mask:
    """The region as a mask of the whole image of (width, height)."""
    left, top = item.region_origin
    height, width = item.region.shape
    mask = np.zeros(size[::-1], bool)
    mask[top : top + height, left : left + width] = item.region
    return mask


def check_invariants(plan: RectificationPlan, size: tuple[int, int]) -> None:
    """What every plan promises; that canvases fit their regions is in test_regions."""
    width, height = size
    assert plan.image_size == size
    claimed = np.zeros((height, width), int)
    for item in plan.items:
        assert item.region.dtype == bool
        # The mask is cropped to the region: no free row or column at its sides.
        sides = (item.region[0], item.region[-1], item.region[:, 0], item.region[:, -1])
        assert all(side.any() for side in sides)
        region = image_region(item, size)
        assert np.count_nonzero(region) == np.count_nonzero(item.region)
        claimed += region
        linear = item.rectified_from_image[:2, :2]
        assert_allclose(linear, rectifying_affine(item.tilt, item.tilt_angle_rad))
    assert claimed.max(initial=0) <= 1, "regions overlap"
    assert plan.rectified_area_px == sum(item.canvas_area_px for item in plan.items)


@settings(max_examples=40)
@given(
    st.integers(0, 10_000), st.integers(1, 12), st.integers(1, 12), st.integers(0, 15)
)
def test_plan_dense_shapes_partitions_any_grid(
    seed: int, rows: int, columns: int, cut_px: int
) -> None:
    rng = np.random.default_rng(seed)
    classes = [
        (float(7.0 ** rng.random()), float(np.pi * rng.random())) for _ in range(5)
    ]
    labels = rng.integers(0, 5, (rows, columns))
    textured = rng.random((rows, columns)) < 0.8
    size = (STEP_PX * columns - cut_px % 4, STEP_PX * rows - cut_px // 4)
    options = DenseShapesOptions(
        min_region_frac=0.0, min_part_frac=0.0, covered_frac=1.0
    )
    grid = shape_grid(classes, labels, textured)
    plan = plan_dense_shapes(grid, size, options)
    check_invariants(plan, size)
    # With no smallest region, the regions are exactly the textured blocks in their balls.
    warps = [(item.tilt, item.tilt_angle_rad) for item in plan.items]
    centers = np.array(list(dict.fromkeys(warps))).reshape(-1, 2)
    nearest = nearest_centers(grid.metrics.reshape(-1, 3), centers, options.tilt_radius)
    nearest = np.where(textured, nearest.reshape(labels.shape), -1)
    for index, center in enumerate(centers):
        blocks = np.kron(nearest == index, np.ones((STEP_PX, STEP_PX), bool))
        parts = [
            image_region(item, size)
            for item, warp in zip(plan.items, warps, strict=True)
            if warp == tuple(center)
        ]
        np.testing.assert_array_equal(
            np.any(parts, axis=0), blocks[: size[1], : size[0]]
        )


def test_plan_dense_shapes_skips_regions_below_the_smallest_share() -> None:
    labels = np.zeros((10, 20), int)
    labels[:2, :5] = 1  # 5 % of the blocks
    grid = shape_grid([(1.0, 0.0), (4.0, 0.9)], labels)
    counts = []
    for share in (0.04, 0.06):
        options = DenseShapesOptions(min_region_frac=share, covered_frac=1.0)
        counts.append(len(plan_dense_shapes(grid, (80, 40), options).items))
    assert counts == [1, 0]


def test_region_in_two_places_is_one_warp_if_pieces_of_any_size_count() -> None:
    labels = np.zeros((40, 60), int)
    labels[5:12, 4:14] = labels[30:36, 45:50] = 1
    grid = shape_grid([(1.0, 0.0), (3.0, 0.7)], labels)
    options = DenseShapesOptions(covered_frac=1.0)
    split = plan_dense_shapes(grid, (240, 160), options)
    whole = plan_dense_shapes(grid, (240, 160), options.changed(min_part_frac=0.0))
    assert (len(split.items), {item.segment_id for item in split.items}) == (2, {0})
    assert (len(whole.items), {item.segment_id for item in whole.items}) == (1, {0})
    both = sum(image_region(item, (240, 160)) for item in split.items)
    assert_allclose(image_region(whole.items[0], (240, 160)), both)
    assert whole.rectified_area_px > 2 * split.rectified_area_px


def test_regions_of_a_hundredth_of_the_image_and_their_smallest_parts_are_left_out() -> (
    None
):
    options = DenseShapesOptions(covered_frac=1.0)
    labels = np.zeros((40, 60), int)
    labels[5:11, 4:8] = 1  # 24 of 2,400 blocks
    grid = shape_grid([(1.0, 0.0), (3.0, 0.7)], labels)
    assert plan_dense_shapes(grid, (240, 160), options).items == ()
    labels[5:15, 4:14] = 1
    labels[30, 45:47] = 1  # a part of two blocks
    grid = shape_grid([(1.0, 0.0), (3.0, 0.7)], labels)
    (item,) = plan_dense_shapes(grid, (240, 160), options).items
    assert item.region.shape == (40, 40)


def test_parts_of_a_region_that_are_close_share_a_warp() -> None:
    options = DenseShapesOptions(covered_frac=1.0)
    for gap, num in ((3, 1), (12, 2)):
        labels = np.zeros((40, 60), int)
        labels[5:15, 4:14] = labels[5:15, 14 + gap : 24 + gap] = 1
        grid = shape_grid([(1.0, 0.0), (3.0, 0.7)], labels)
        assert len(plan_dense_shapes(grid, (240, 160), options).items) == num
