"""Rectifiers `depth-planes` and `depth-affnet`: planes found, and how each is warped."""

from __future__ import annotations

import functools

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from planar_scenes import (
    FixedDepth,
    FixedShapes,
    Room,
    angles_deg,
    corner_room,
    look_up,
    plane_coordinates,
    slanted_wall,
    unit,
)
from small_scene import cached_texture
from strategies import Array, tilt_distance

from colmap_affrect.data import Mask, Photograph, Rectification, RectificationPlan
from colmap_affrect.geometry.affine import project, rectifying_affine
from colmap_affrect.images.warping import warp, warp_mask
from colmap_affrect.rectifiers.base import RectifierInputs
from colmap_affrect.rectifiers.depth_planes import (
    DepthAffNet,
    DepthAffNetOptions,
    DepthPlanes,
    DepthPlanesOptions,
    PlanarSegment,
    PlaneOptions,
    planar_segments,
)

CREASE_PX = 3.0
"""Pixels of the image nearer to a crease may get the label of the other plane: two pixels of the
depth map, which is smaller than the image."""


MIN_CORRELATION = 0.95
"""Of a warp and the texture rendered from the front; half a pixel of error costs more."""


def plan_planes(
    photograph: Photograph, depth: Array, **options: object
) -> RectificationPlan:
    """Plan with the given options of the planes and of the rectifier."""
    rectifier = DepthPlanesOptions(**options)
    return DepthPlanes(rectifier, RectifierInputs(depth=FixedDepth(depth))).plan(
        photograph
    )


def image_mask(segment: PlanarSegment, size: tuple[int, int]) -> Mask:
    """Mask of a segment over the whole image."""
    mask = np.zeros(size[::-1], bool)
    (left, top) = segment.region.origin
    (height, width) = segment.region.mask.shape
    mask[top : top + height, left : left + width] = segment.region.mask
    return mask


def near_crease(labels: NDArray[np.intp]) -> Mask:
    """Pixels within CREASE_PX of another label."""
    edges = np.zeros(labels.shape, np.uint8)
    edges[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edges[1:] |= labels[1:] != labels[:-1]
    return cv2.distanceTransform(1 - edges, cv2.DIST_L2, 5) <= CREASE_PX


@pytest.mark.parametrize("depth_size", [(160, 100), (700, 525)])
def test_planar_segments_of_a_room_are_its_walls_and_floor(
    depth_size: tuple[int, int],
) -> None:
    room = corner_room()
    depth, _ = room.depth(depth_size)
    _, labels = room.depth(room.size)
    segments = planar_segments(room.photograph(), depth, PlaneOptions())
    assert len(segments) == 3
    clear = ~near_crease(labels)
    order = np.argsort(-np.bincount(labels.ravel()))
    for segment, label in zip(segments, order, strict=True):
        assert angles_deg(segment.normal, room.normals[label]) < 1.0
        np.testing.assert_array_equal(
            image_mask(segment, room.size)[clear], (labels == label)[clear]
        )


def test_planar_segments_align_depth_and_image_at_pixel_centres() -> None:
    # A step between two planes on a boundary of the depth map's pixels, whatever the sizes.
    walls = unit([[0.6, 0.0, -0.8], [-0.6, 0.1, -0.8]])
    size = (300, 200)
    depth_size = (60, 50)
    depth = np.where(
        np.arange(60) < 21,
        *(
            Room(
                wall[None], np.array([d]), slanted_wall(wall).camera_matrix, size
            ).depth(depth_size)[0]
            for wall, d in zip(walls, (2.0, 4.0), strict=True)
        ),
    )
    photograph = Photograph(
        np.zeros(size[::-1], np.uint8),
        "a.png",
        None,
        slanted_wall(walls[0]).camera_matrix,
    )
    left, right = sorted(
        planar_segments(photograph, depth, PlaneOptions(min_separation_deg=60.0)),
        key=lambda segment: segment.region.origin,
    )
    # Pixels 0-20 of 60 are 0-104 of 300.
    assert (left.region.origin, left.region.mask.shape) == ((0, 0), (200, 105))
    assert (right.region.origin, right.region.mask.shape) == ((105, 0), (200, 195))
    assert left.region.mask.all()
    assert right.region.mask.all()


def test_planar_segments_leave_out_what_is_seen_too_obliquely() -> None:
    wall = slanted_wall([0.93, 0.0, -0.37])  # 68 degrees from the optical axis
    depth, _ = wall.depth((200, 150))
    directions = np.stack(
        [(np.arange(400) - 215.0) / 340.0, np.zeros(400), np.ones(400)], axis=1
    )
    for max_angle_deg in (60.0, 70.0, 80.0):
        options = PlaneOptions(max_angle_deg=max_angle_deg)
        (segment,) = planar_segments(wall.photograph(), depth, options)
        assert angles_deg(segment.normal, wall.normals[0]) < 0.01
        cosines = -directions @ wall.normals[0] / np.linalg.norm(directions, axis=1)
        seen = cosines >= np.cos(np.deg2rad(max_angle_deg))
        row = image_mask(segment, wall.size)[130]  # that of the principal point
        assert np.count_nonzero(row != seen) <= 1
    assert (
        planar_segments(wall.photograph(), depth, PlaneOptions(max_angle_deg=30.0))
        == []
    )


def test_planar_segments_are_connected_and_large_enough() -> None:
    wall = slanted_wall([0.3, 0.1, -0.9])
    depth, _ = wall.depth((400, 300))
    depth[:, 250:254] = np.nan  # 250 and 146 columns
    depth[100:120, 300:320] = np.nan
    segments = planar_segments(wall.photograph(), depth, PlaneOptions())
    assert [segment.region.origin for segment in segments] == [(0, 0), (254, 0)]
    assert [segment.region.mask.shape[1] for segment in segments] == [250, 146]
    assert not segments[1].region.contains(np.array([[310.0, 110.0]]))[0]
    (large,) = planar_segments(
        wall.photograph(), depth, PlaneOptions(min_region_frac=0.5)
    )
    np.testing.assert_array_equal(large.region.mask, segments[0].region.mask)


def test_plan_keeps_features_of_the_photograph_everywhere_or_outside() -> None:
    wall = slanted_wall([0.5, 0.1, -0.85])
    depth, _ = wall.depth((200, 150))
    depth[:, 120:] = np.nan
    everywhere = plan_planes(wall.photograph(), depth)
    assert len(everywhere.items) == 1
    assert everywhere.original_region is None
    outside = plan_planes(wall.photograph(), depth, keep_original="outside")
    assert outside.original_region.shape == (300, 400)
    np.testing.assert_array_equal(
        outside.original_region, np.broadcast_to(np.arange(400) >= 240, (300, 400))
    )


def canvas_in_plane(item: Rectification, room: Room) -> tuple[Array, Array]:
    """(H, W, 2) pixels of the warp, and (H, W, 2) what they show, in plane coordinates."""
    width, height = item.canvas_size
    canvas = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(
        float
    )
    pixels = project(item.image_from_rectified, canvas.reshape(-1, 2))
    directions = np.column_stack([pixels, np.ones(len(pixels))])
    directions = directions @ np.linalg.inv(room.camera_matrix).T
    (normal,) = room.normals
    points = -room.distances[0] * directions / (directions @ normal)[:, None]
    return canvas, plane_coordinates(normal, points).reshape(canvas.shape)


NORMALS = [(0.7, 0.2, -0.68), (0.1, -0.9, -0.42)]


@pytest.mark.parametrize("normal", NORMALS)
def test_warp_of_a_slanted_wall_is_its_frontal_view(
    normal: tuple[float, float, float],
) -> None:
    room = slanted_wall(normal)
    pattern = cached_texture((900, 900), seed=4, finest_sigma_px=5.0)
    image = room.render(pattern, 120.0)
    plan = plan_planes(room.photograph(image), room.depth((180, 130))[0])
    (item,) = plan.items
    inside = warp_mask(item, room.size) > 0
    canvas, shown = canvas_in_plane(item, room)
    # From canvas to plane it is a similarity.
    design = np.column_stack([canvas[inside], np.ones(np.count_nonzero(inside))])
    fitted, *_ = np.linalg.lstsq(design, shown[inside], rcond=None)
    px_in_plane = np.sqrt(abs(np.linalg.det(fitted[:2])))
    assert np.abs(design @ fitted - shown[inside]).max() < 0.2 * px_in_plane
    assert_allclose(fitted[:2] @ fitted[:2].T / px_in_plane**2, np.eye(2), atol=2e-3)
    # What the warp shows is the texture of the plane.
    frontal = look_up(pattern, *np.moveaxis(120.0 * shown, -1, 0))
    assert (
        np.corrcoef(warp(image, item)[inside], frontal[inside])[0, 1] > MIN_CORRELATION
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
    plan = plan_room(shapes)
    segments = room_segments()
    assert [item.segment_id for item in plan.items] == [0, 1]
    for item, segment, expected in zip(plan.items, segments, classes, strict=False):
        assert tilt_distance(item.tilt, item.tilt_angle_rad, *expected) < np.log(1.7)
        np.testing.assert_array_equal(item.region, segment.region.mask)
        assert item.region_origin == segment.region.origin
        assert item.is_affine
        assert_allclose(
            item.rectified_from_image[:2, :2],
            rectifying_affine(item.tilt, item.tilt_angle_rad),
        )
    assert plan.original_region is None


def test_a_segment_of_several_shapes_has_several_warps_of_the_same_region() -> None:
    points = points_in(1)
    shapes = np.concatenate(
        [shapes_at(points[:24], 4.5, 0.2), shapes_at(points[24:], 4.5, 1.7)]
    )
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


def test_planes_and_regions_that_are_small_are_left_out() -> None:
    """By default a plane has 15 per cent of the pixels, and a region of it 3 per cent."""
    wall = slanted_wall([0.3, 0.1, -0.9])
    other = slanted_wall([-0.8, 0.1, -0.6])
    depth, _ = wall.depth((400, 300))
    depth_of_other, _ = other.depth((400, 300))
    depth[:, 360:] = depth_of_other[:, 360:]  # a tenth of the pixels
    depth[:, 352:356] = np.nan
    depth[:, 344:348] = np.nan  # four columns between are 1 per cent
    (segment,) = planar_segments(wall.photograph(), depth, PlaneOptions())
    assert segment.region.origin == (0, 0)
    assert segment.region.mask.shape == (300, 344)
    every = PlaneOptions(min_votes_frac=0.05, min_region_frac=0.005)
    assert len(planar_segments(wall.photograph(), depth, every)) > 1


def test_noise_of_large_depth_maps_does_not_hide_planes() -> None:
    """They are shrunk first: windows of 5 x 5 px would see the noise alone."""
    wall = slanted_wall([0.3, 0.1, -0.9])
    depth, _ = wall.depth((2000, 1500))
    noise = np.random.default_rng(1).normal(1.0, 0.003, depth.shape)
    (segment,) = planar_segments(wall.photograph(), depth * noise, PlaneOptions())
    assert angles_deg(segment.normal, wall.normals[0]) < 3.0
