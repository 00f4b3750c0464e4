"""Rectifier ``depth-affnet``: each planar segment by the maps that cover its own shapes."""

from __future__ import annotations

import functools

import numpy as np
from numpy.testing import assert_allclose
from planar_scenes import FixedDepth, FixedShapes, corner_room
from strategies import Array, tilt_distance

from colmap_affrect.data import RectificationPlan
from colmap_affrect.geometry.affine import rectifying_affine
from colmap_affrect.rectifiers.base import RectifierInputs
from colmap_affrect.rectifiers.depth_planes import (
    DepthAffNet,
    DepthAffNetOptions,
    PlanarSegment,
    PlaneOptions,
    planar_segments,
)


def shapes_at(points: Array, tilt: float, angle_rad: float) -> Array:
    """Rows of one class at (N, 2) points."""
    return np.column_stack([points, np.tile([tilt, angle_rad], (len(points), 1))])


ROOM = corner_room()
DEPTH = ROOM.depth((130, 100))[0]


@functools.cache
def room_segments() -> list[PlanarSegment]:
    """The three planar segments of the room, the largest first."""
    return planar_segments(ROOM.photograph(), DEPTH, PlaneOptions())


def plan_room(shapes: Array, **options: object) -> RectificationPlan:
    """Plan for the room with given shapes."""
    sources = RectifierInputs(FixedShapes(shapes), FixedDepth(DEPTH))
    return DepthAffNet(DepthAffNetOptions(**options), sources).plan(ROOM.photograph())


def points_in(segment: int, count: int = 40) -> Array:
    """Points between pixels that round into a segment of the room."""
    region = room_segments()[segment].region
    rows, columns = np.nonzero(region.mask)
    rng = np.random.default_rng(segment)
    chosen = rng.choice(len(rows), count, replace=False)
    pixels = np.column_stack([columns, rows])[chosen] + region.origin
    return pixels + rng.uniform(-0.4, 0.4, (count, 2))


def test_each_segment_is_warped_by_its_own_shapes() -> None:
    classes = [(3.0, 0.4), (4.2, 1.9)]
    shapes = np.concatenate([shapes_at(points_in(k), *classes[k]) for k in (0, 1)])
    plan, segments = plan_room(shapes), room_segments()
    assert [item.segment_id for item in plan.items] == [0, 1]
    for item, segment, expected in zip(plan.items, segments, classes, strict=False):
        assert tilt_distance(item.tilt, item.tilt_angle_rad, *expected) < np.log(1.7)
        np.testing.assert_array_equal(item.region, segment.region.mask)
        assert item.region_origin == segment.region.origin
        assert item.is_affine
        assert_allclose(
            item.rectified_from_image[:2, :2], rectifying_affine(item.tilt, item.tilt_angle_rad)
        )
    assert plan.original_region is None


def test_a_segment_of_several_shapes_has_several_warps_of_the_same_region() -> None:
    points = points_in(1)
    shapes = np.concatenate([shapes_at(points[:24], 4.5, 0.2), shapes_at(points[24:], 4.5, 1.7)])
    plan = plan_room(shapes)
    assert [item.segment_id for item in plan.items] == [1, 1]
    first, second = plan.items
    np.testing.assert_array_equal(first.region, second.region)
    # The larger group of shapes comes first.
    assert tilt_distance(first.tilt, first.tilt_angle_rad, 4.5, 0.2) < np.log(1.7)
    assert tilt_distance(second.tilt, second.tilt_angle_rad, 4.5, 1.7) < np.log(1.7)
    limited = plan_room(shapes, max_num_rectifications=1)
    assert len(limited.items) == 1


def test_segments_without_tilted_shapes_have_no_warps() -> None:
    upright = np.concatenate([shapes_at(points_in(k), 1.5, 0.3 * k) for k in range(3)])
    assert plan_room(upright).items == ()
    assert plan_room(np.zeros((0, 4))) == RectificationPlan(ROOM.size)
    assert len(plan_room(upright, tilt_radius=1.4).items) >= 3
