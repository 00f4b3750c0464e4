"""What two photographs of a model have in common: what is expected in the other one, and found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.surroundings import (
    CONTRADICTED,
    Overlap,
    _counted,
    _cut_at_collages,
    _joint_log_ratio,
    _Views,
)

WIDTH = 1000
HEIGHT = 600
FOCAL_PX = 800.0
FAR = 10.0  # depth of what both photographs show
LEFT = 1  # ids of the images
RIGHT = 2

Array = NDArray[np.float64]


@dataclass
class Surface:
    """A grid of points of the middle of the right image at one depth.

    Attributes:
        columns: px, where it begins and ends.
        rows: likewise.
        depth: of all of its points.
        seen_by: ids of the images that see it.
    """

    columns: tuple[float, float]
    rows: tuple[float, float]
    depth: float
    seen_by: tuple[int, ...]

    def points(self) -> Array:
        """(N, 3) points, 20 px apart in the right image."""
        columns = np.arange(*self.columns, 20.0) + 10.0
        rows = np.arange(*self.rows, 20.0) + 10.0
        x, y = np.meshgrid(columns - WIDTH / 2, rows - HEIGHT / 2)
        rays = np.stack([x.ravel(), y.ravel(), np.full(x.size, FOCAL_PX)], axis=1)
        return rays * self.depth / FOCAL_PX


def views_of(surfaces: list[Surface]) -> _Views:
    """Return what two images see that look into one direction, the left one from the left."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", FOCAL_PX, WIDTH, HEIGHT
    )
    model.add_camera_with_trivial_rig(camera)
    points = np.concatenate([surface.points() for surface in surfaces])
    seen_by = [surface.seen_by for surface in surfaces for _ in surface.points()]
    for image_id, center in ((LEFT, (-1.0, 0.0, 0.0)), (RIGHT, (0.0, 0.0, 0.0))):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), -np.array(center))
        rays = points - center
        pixels = FOCAL_PX * rays[:, :2] / rays[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        image = pycolmap.Image(f"{image_id}.jpg", pixels, 1, image_id)
        model.add_image_with_trivial_frame(image, pose)
    for index, (point, images) in enumerate(zip(points, seen_by, strict=True)):
        track = pycolmap.Track()
        for image_id in images:
            track.add_element(image_id, index)
        model.add_point3D(point, track)
    return _Views(model)


BOTH_SEE = Surface((0.0, 400.0), (0.0, 600.0), FAR, (LEFT, RIGHT))
LEFT_SEES = Surface((500.0, 900.0), (0.0, 400.0), FAR, (LEFT,))


def share_found(*before: Surface) -> float:
    """Return the share of what is expected in the right image that it shows."""
    overlap = views_of([BOTH_SEE, LEFT_SEES, *before]).overlap_with(RIGHT, [LEFT])
    return overlap.num_found / overlap.num_expected


def test_what_another_photograph_shows_is_expected_unless_something_is_before_it() -> (
    None
):
    hiding = Surface((480.0, 920.0), (0.0, 420.0), FAR / 2, (RIGHT,))
    assert share_found() < 0.75
    assert share_found(hiding) == 1.0


@pytest.mark.parametrize(
    ("columns", "rows", "depth"),
    [
        ((480.0, 920.0), (0.0, 420.0), 0.95 * FAR),  # a relief of the same wall
        ((480.0, 920.0), (480.0, 600.0), FAR / 2),  # it stands below
    ],
)
def test_neither_a_relief_nor_what_stands_beside_it_hides_anything(
    columns: tuple[float, float], rows: tuple[float, float], depth: float
) -> None:
    beside = Surface(columns, rows, depth, (RIGHT,))
    assert share_found(beside) == pytest.approx(share_found(), abs=0.05)


@pytest.mark.parametrize(
    ("center", "is_alike"),
    [
        ((-5.0, 0.0, 0.0), True),  # from 27 degrees beside
        ((-14.0, 0.0, 0.0), False),  # from 54 degrees
        ((0.0, 0.0, 4.5), True),  # 1.8 times as large
        ((0.0, 0.0, -8.0), True),  # 1.8 times as small
        ((0.0, 0.0, 7.0), False),  # 3 times as large
        ((0.0, 0.0, -25.0), False),  # 3 times as small
    ],
)
def test_photographs_are_alike_from_similar_directions_and_at_similar_scales(
    center: tuple[float, float, float], *, is_alike: bool
) -> None:
    views = views_of([BOTH_SEE])
    image = views.model.images[LEFT]
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), -np.array(center))
    image.frame.set_cam_from_world(image.camera_id, pose)
    point = np.array([[0.0, 0.0, FAR]])
    assert views._looks_alike(LEFT, RIGHT, point).tolist() == [is_alike]


def test_cells_of_three_points_say_nothing() -> None:
    cells = np.repeat([0, 1, 9], [6, 3, 5])
    is_found = cells == 0
    found = _counted(cells, is_found, 1.0)
    assert found.num_found == 1.0
    of_eleven = 1.0 - (1.0 - np.array([6.0, 5.0]) / 11.0) ** 6  # six matches at random
    assert found.num_expected == pytest.approx(of_eleven.sum())


@pytest.mark.parametrize(("num_expected", "tells"), [(6.0, False), (12.0, True)])
def test_an_eighth_of_a_photograph_tells_whether_two_are_of_one_place(
    num_expected: float, *, tells: bool
) -> None:
    missing = Overlap(num_expected, 0.0)
    assert missing.has_enough == tells
    assert (missing.log_ratio < CONTRADICTED) == tells
    assert (Overlap(num_expected, num_expected).log_ratio > 1.0) == tells


def test_pairs_tell_together_as_if_each_told_half_again() -> None:
    one = Overlap(20.0, 19.0)
    assert _joint_log_ratio([one]) == pytest.approx(one.log_ratio)
    assert _joint_log_ratio([one] * 4) == pytest.approx(2.0 * one.log_ratio)
    assert _joint_log_ratio([one, Overlap(2.0, 0.0)]) == pytest.approx(one.log_ratio)
    assert _joint_log_ratio([]) == 0.0


def test_what_is_hidden_is_told_by_depths_along_the_camera_that_looks() -> None:
    """The camera is turned and has moved, so that its axes are none of those of the world."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", FOCAL_PX, WIDTH, HEIGHT
    )
    model.add_camera_with_trivial_rig(camera)
    local = Surface((400.0, 600.0), (200.0, 400.0), FAR, (LEFT,)).points()
    pixels = FOCAL_PX * local[:, :2] / local[:, 2:] + (WIDTH / 2, HEIGHT / 2)
    pose = pycolmap.Rigid3d(
        pycolmap.Rotation3d(np.array([0.7, -0.4, 0.2])), np.array([3.0, -2.0, 1.0])
    )
    image = pycolmap.Image("1.jpg", pixels, 1, LEFT)
    model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(local):
        track = pycolmap.Track()
        track.add_element(LEFT, index)
        model.add_point3D(pose.inverse() * point, track)
    middle = np.array([[500.0, 300.0]] * 3)
    depths = np.array([0.5 * FAR, 1.1 * FAR, 1.2 * FAR])
    is_hidden = _Views(model)._is_hidden(LEFT, middle, depths)
    assert is_hidden.tolist() == [False, False, True]


class _AlwaysOtherRegions:
    """Images that share points with others in other regions of them."""

    def regions_differ(self, *_: object) -> bool:
        return True


@pytest.mark.parametrize(
    ("pairs", "parts", "collages"),
    [
        # the fourth image alone hangs on the third one
        ([(1, 2), (1, 3), (2, 3), (3, 4)], [{1, 2, 3, 4}], set()),
        # the fourth and the fifth do
        ([(1, 2), (1, 3), (2, 3), (3, 4), (3, 5), (4, 5)], [{1, 2, 3}, {4, 5}], {3}),
    ],
)
def test_a_collage_ties_two_images_or_more_to_others(
    pairs: list[tuple[int, int]], parts: list[set[int]], collages: set[int]
) -> None:
    views: Any = _AlwaysOtherRegions()
    overlaps = dict.fromkeys(pairs, Overlap(20.0, 19.0))
    place = {image_id for pair in pairs for image_id in pair}
    found = set[int]()
    assert _cut_at_collages(place, overlaps, views, found) == parts
    assert found == collages


@pytest.mark.parametrize(("num_common", "differ"), [(0, True), (1, True), (4, False)])
def test_regions_of_an_image_differ_that_have_a_tenth_of_their_cells_in_common(
    num_common: int, *, differ: bool
) -> None:
    """An image shares 20 cells with a second one, and 30 cells with a third one."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", FOCAL_PX, WIDTH, HEIGHT
    )
    model.add_camera_with_trivial_rig(camera)
    columns = (np.arange(64) % 8 + 0.5) * WIDTH / 8
    rows = (np.arange(64) // 8 + 0.5) * HEIGHT / 8
    one_in_each_cell = np.stack([columns, rows], axis=1)
    for image_id in (1, 2, 3):
        image = pycolmap.Image(f"{image_id}.jpg", one_in_each_cell, 1, image_id)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    seen_by_second = range(20)
    seen_by_third = range(20 - num_common, 50 - num_common)
    for cell in range(64):
        track = pycolmap.Track()
        track.add_element(1, cell)
        if cell in seen_by_second:
            track.add_element(2, cell)
        if cell in seen_by_third:
            track.add_element(3, cell)
        model.add_point3D(np.ones(3), track)
    views = _Views(model)
    assert views.regions_differ(1, {2}, {3}) == differ
    assert views.regions_differ(1, {3}, {2}) == differ
    assert not views.regions_differ(1, {2}, set())
