"""Regions and their warps: everything of a region lies on its canvas, which is bounded."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import classes

from colmap_affrect.data import Rectification
from colmap_affrect.geometry.affine import project, rectifying_affine, transform_lafs
from colmap_affrect.geometry.planes import fronto_parallel_homography
from colmap_affrect.geometry.tilts import metrics_from_tilts, unit_metrics
from colmap_affrect.rectifiers.base import AffineWarpOptions
from colmap_affrect.rectifiers.regions import Region, homography_rectification

MARGIN_PX = 16.0  # around a region
CANVAS_RATIO = 2.0  # area of the canvas of a homography over that of the region
CAMERA = np.array([[300.0, 0.0, 95.0], [0.0, 320.0, 70.0], [0.0, 0.0, 1.0]])


@st.composite
def regions(draw: st.DrawFn) -> Region:
    """Blocky regions of up to 80 x 60 px that touch all sides of their mask."""
    shape = draw(st.tuples(st.integers(1, 6), st.integers(1, 8)))
    blocks = np.array(draw(st.lists(st.booleans(), min_size=48, max_size=48)))
    mask = blocks[: shape[0] * shape[1]].reshape(shape)
    mask[:, 0] = mask[0] = True
    mask[-1, -1] = True
    return Region(
        np.kron(mask, np.ones((10, 10), bool)), (draw(st.integers(0, 90)), 31)
    )


def pixels(region: Region) -> np.ndarray:
    """(N, 2) centres of the pixels of a region."""
    rows, columns = np.nonzero(region.mask)
    return np.column_stack([columns, rows]) + np.array(region.origin, dtype=float)


def check_fit(item: Rectification, region: Region) -> None:
    """The canvas is the smallest that keeps the margin at each of its four sides."""
    mapped = project(item.rectified_from_image, pixels(region))
    last = np.array(item.canvas_size) - 1
    assert_allclose(mapped.min(axis=0), MARGIN_PX, atol=1e-6)
    assert (mapped.max(axis=0) + MARGIN_PX <= last + 1e-6).all()
    assert (mapped.max(axis=0) + MARGIN_PX > last - 1 - 1e-6).all()
    np.testing.assert_array_equal(item.region, region.mask)
    assert item.region_origin == region.origin


@given(regions(), classes(), st.booleans())
def test_affine_warp_fits_the_region(
    region: Region, tilt_class: tuple[float, float], area_preserving: bool
) -> None:
    options = AffineWarpOptions(name="asift", area_preserving=area_preserving)
    item = options.warp(region, *tilt_class, 3)
    assert item.is_affine
    linear = rectifying_affine(*tilt_class, area_preserving=area_preserving)
    assert_allclose(item.rectified_from_image[:2, :2], linear)
    assert (item.tilt, item.tilt_angle_rad, item.segment_id) == (*tilt_class, 3)
    check_fit(item, region)


@given(regions(), st.floats(0.0, 75.0), st.floats(0.0, 2 * np.pi))
def test_homography_rectification_fits_the_region_and_is_twice_as_large(
    region: Region, slant_deg: float, direction_rad: float
) -> None:
    slant = np.deg2rad(slant_deg)
    direction = np.sin(slant) * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    homography = fronto_parallel_homography(
        np.array([*direction, -np.cos(slant)]), CAMERA
    )
    third = pixels(region) @ homography[2, :2] + homography[2, 2]
    if third.min() < 0.05:
        return
    item = homography_rectification(region, homography, 5)
    assert item.segment_id == 5
    check_fit(item, region)
    mapped = project(item.rectified_from_image, pixels(region))
    box = np.ptp(mapped, axis=0)
    assert np.prod(box) <= CANVAS_RATIO * region.area_px
    if min(region.mask.shape) > 10:
        assert np.prod(box) > 0.7 * CANVAS_RATIO * region.area_px
    # The same map but for scale and translation.
    relative = item.rectified_from_image @ np.linalg.inv(homography)
    relative /= relative[2, 2]
    assert_allclose(relative[2, :2], 0.0, atol=1e-9)
    assert_allclose(
        relative[:2, :2], relative[0, 0] * np.eye(2), atol=1e-6 * relative[0, 0]
    )
    unit = np.concatenate([np.eye(2), pixels(region).mean(axis=0)[:, None]], axis=1)
    jacobian = transform_lafs(item.rectified_from_image, unit[None])[0, :, :2]
    assert_allclose(
        metrics_from_tilts(item.tilt, item.tilt_angle_rad),
        unit_metrics(jacobian),
        atol=1e-6,
    )
