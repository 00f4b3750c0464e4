"""Planes from depth: normals of known scenes, clusters on the sphere, views from the front."""

from __future__ import annotations

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from planar_scenes import Room, angles_deg, corner_room, rays, unit
from strategies import Array

from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.planes import (
    PlaneClusters,
    cluster_normals,
    fronto_parallel_homography,
    normals_from_depth,
    shrink_depth,
    spiral_points,
    viewing_cosines,
)

EXACT_DEG = 1e-6
"""Normals of exact depth of one plane: rounding only."""

CAMERA = np.array([[210.0, 0.0, 61.0], [0.0, 250.0, 33.0], [0.0, 0.0, 1.0]])
"""Pixels that are not square, principal point off the centre of a 90 x 70 image."""

SIZE = (90, 70)


def plane_depth(normal: Array, distance: float = 2.0) -> Array:
    """(h, w) z-depth of one plane that the whole image sees."""
    return Room(unit(normal)[None], np.array([distance]), CAMERA, SIZE).depth(SIZE)[0]


@st.composite
def visible_normals(draw: st.DrawFn, max_angle_deg: float = 80.0) -> Array:
    """Unit normals that all pixels of the image of CAMERA see at less than an angle."""
    normal = draw(st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 0.3)))
    assume(np.linalg.norm(normal) > 0.1)
    normal = unit(normal)
    assume(
        viewing_cosines(normal, CAMERA, SIZE).min() > np.cos(np.deg2rad(max_angle_deg))
    )
    return normal


@settings(max_examples=30)
@given(visible_normals(), st.floats(0.01, 100.0))
def test_normals_of_a_plane_are_its_normal_to_the_last_pixel(
    normal: Array, unit_m: float
) -> None:
    normals = normals_from_depth(plane_depth(normal, unit_m), CAMERA)
    assert normals.shape == (70, 90, 3)
    assert angles_deg(normals, normal).max() < EXACT_DEG


def test_normals_are_right_up_to_a_depth_discontinuity() -> None:
    # A board before a wall, one side of it a column of pixels from the image border.
    board = unit([0.5, 0.2, -0.8])
    wall = unit([-0.3, 0.1, -1.0])
    depth = plane_depth(wall, 4.0)
    normals = np.broadcast_to(wall, (70, 90, 3)).copy()
    depth[20:50, 30:88] = plane_depth(board, 2.0)[20:50, 30:88]
    normals[20:50, 30:88] = board
    errors = angles_deg(normals_from_depth(depth, CAMERA), normals)
    assert np.nanmax(errors) < EXACT_DEG
    # What is seen only between the board and the image border has too few neighbours.
    assert np.isnan(errors).mean() < 0.002


def test_shrink_depth_keeps_planes_exact_and_says_where_pixels_went() -> None:
    normal = unit([0.5, -0.4, -0.8])
    shrunk, shrunk_from_depth = shrink_depth(plane_depth(normal), 31)
    assert shrunk.shape == (23, 30)  # blocks of 3 x 3, the last row has no full ones
    middles = np.array([[1.0, 1.0], [85.0, 67.0]])
    assert_allclose(project(shrunk_from_depth, middles), [[0, 0], [28, 22]], atol=1e-12)
    normals = normals_from_depth(shrunk, shrunk_from_depth @ CAMERA)
    assert angles_deg(normals, normal).max() < EXACT_DEG


def scattered(
    center: Array, count: int, spread_deg: float, rng: np.random.Generator
) -> Array:
    """Unit normals about a direction."""
    return unit(center + np.deg2rad(spread_deg) * rng.standard_normal((count, 3)))


def clustered(normals: Array, **options: float) -> PlaneClusters:
    """Clusters with the paper's values unless told otherwise."""
    values = {
        "num_candidates": 500,
        "bin_angle_rad": np.deg2rad(35.0),
        "min_separation_rad": np.deg2rad(87.5),
        "max_num_planes": 3,
        "min_votes_frac": 0.15,
    }
    return cluster_normals(normals, **{**values, **options})


def three_planes() -> tuple[Array, Array, Array]:
    """(40, 50, 3) normals of three planes and unknown ones, labels by size, and the planes."""
    rng = np.random.default_rng(5)
    planes = corner_room().normals
    parts = [scattered(planes[2], 900, 6.0, rng), scattered(planes[0], 600, 6.0, rng),
             scattered(planes[1], 350, 6.0, rng), np.full((150, 3), np.nan)]  # fmt: skip
    order = rng.permutation(2000)
    labels = np.repeat([0, 1, 2, -1], [900, 600, 350, 150])[order]
    return (
        np.concatenate(parts)[order].reshape(40, 50, 3),
        labels.reshape(40, 50),
        planes[[2, 0, 1]],
    )


def test_cluster_normals_finds_planes_by_falling_size() -> None:
    normals, labels, planes = three_planes()
    clusters = clustered(normals)
    assert angles_deg(clusters.normals, planes).max() < 1.0
    np.testing.assert_array_equal(clusters.labels, labels)
    assert clusters.labels.dtype == np.int32


def test_cluster_normals_keeps_opposite_normals_apart() -> None:
    rng = np.random.default_rng(8)
    right = unit([1.0, 0.1, -0.1])
    normals = np.concatenate(
        [scattered(right, 300, 5.0, rng), scattered(-right, 200, 5.0, rng)]
    )
    clusters = clustered(normals[None])
    assert angles_deg(clusters.normals, np.stack([right, -right])).max() < 1.0
    assert np.bincount(clusters.labels[0]).tolist() == [300, 200]


@given(
    visible_normals(),
    st.floats(0.0, np.pi),
    st.tuples(st.floats(0, 89), st.floats(0, 69)),
)
def test_fronto_parallel_homography_shows_squares_of_the_plane_as_squares(
    normal: Array, angle_rad: float, pixel: tuple[float, float]
) -> None:
    (ray,) = rays(CAMERA, np.array([pixel[0]]), np.array([pixel[1]]))[0]
    center = -2.0 * ray / (ray @ normal)
    right = unit(np.cross([0.1, 1.0, 0.2], normal))
    down = np.cross(normal, right)
    turns = angle_rad + np.pi / 2 * np.arange(4)
    corners = center + 0.05 * (
        np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * down
    )
    seen = corners @ CAMERA.T
    frontal = project(
        fronto_parallel_homography(normal, CAMERA), seen[:, :2] / seen[:, 2:]
    )
    sides = np.diff(frontal, axis=0, append=frontal[:1]) / [CAMERA[0, 0], CAMERA[1, 1]]
    lengths = np.linalg.norm(sides, axis=1)
    assert_allclose(lengths, lengths.mean(), rtol=1e-6)
    turned = (
        sides[:, 0] * np.roll(sides, -1, 0)[:, 0]
        + sides[:, 1] * np.roll(sides, -1, 0)[:, 1]
    )
    assert np.abs(turned).max() < 1e-6 * lengths.mean() ** 2


@given(visible_normals())
def test_fronto_parallel_homography_is_positive_where_the_plane_is_seen(
    normal: Array,
) -> None:
    homography = fronto_parallel_homography(normal, CAMERA)
    assert_allclose(np.linalg.det(homography), 1.0)
    rows, columns = np.indices(SIZE[::-1])
    third = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ homography[2]
    directions = rays(CAMERA, np.arange(90), np.arange(70))
    assert_allclose(third, -directions @ normal, atol=1e-9)
    cosines = viewing_cosines(normal, CAMERA, SIZE)
    assert_allclose(cosines, third / np.linalg.norm(directions, axis=2), atol=1e-9)


def test_fronto_parallel_homography_turns_no_further_than_needed() -> None:
    # A wall seen from the side stays upright: verticals stay verticals.
    homography = fronto_parallel_homography(unit([0.8, 0.0, -0.6]), CAMERA)
    upright = project(homography, np.array([[61.0, 3.0], [61.0, 33.0], [61.0, 66.0]]))
    assert_allclose(upright[:, 0], upright[0, 0])
    assert (np.diff(upright[:, 1]) > 0).all()


def weighted_normal(inverse: Array, row: int, column: int) -> Array:
    """Return the normal of a pixel by weighted least squares in its window of 5 x 5 px."""
    ray_from_pixel = np.linalg.inv(CAMERA)
    rows = []
    changes = []
    roots = []
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            change = inverse[row + dy, column + dx] / inverse[row, column] - 1.0
            ray_change = np.linalg.norm(ray_from_pixel @ [dx, dy, 0.0])
            if abs(change) <= ray_change / np.cos(np.deg2rad(85.0)):
                rows.append([dx, dy, 1.0])
                changes.append(1.0 + change)
                roots.append(np.exp(-(dx * dx + dy * dy) / (4.0 * 0.8**2)))
    weights = np.array(roots)
    form, *_ = np.linalg.lstsq(
        weights[:, None] * np.array(rows), weights * np.array(changes), rcond=None
    )
    a, b, c = form
    of_rays = np.array([a, b, c - a * column - b * row]) @ CAMERA
    return unit(-of_rays)


def test_normals_of_rough_surfaces_are_weighted_least_squares_without_far_neighbours() -> (
    None
):
    """Depth differs by some per cent, so that a part of the neighbours is left out."""
    rough = np.random.default_rng(3).normal(1.0, 0.03, (70, 90))
    depth = plane_depth(np.array([0.3, -0.4, -0.8])) * rough
    normals = normals_from_depth(depth, CAMERA)
    for row, column in ((30, 40), (31, 40), (50, 20), (10, 70)):
        if np.isfinite(normals[row, column]).all():
            assert_allclose(
                normals[row, column], weighted_normal(1.0 / depth, row, column)
            )
    assert np.isfinite(normals[30:32, 40]).any()


def test_normals_are_taken_away_that_are_near_the_mean_direction() -> None:
    """They are not near the candidate that was chosen first, which is 20 degrees off."""
    candidates = spiral_points(10)
    cosines = candidates @ candidates[4]
    neighbor = np.argsort(-cosines)[1]
    angle = np.arccos(cosines[neighbor])
    across = unit(candidates[neighbor] - cosines[neighbor] * candidates[4])

    def at_deg(degrees: float) -> Array:
        radians = np.deg2rad(degrees)
        return np.cos(radians) * candidates[4] + np.sin(radians) * across

    assert np.deg2rad(55.0) < angle < np.deg2rad(75.0)
    normals = np.concatenate(
        [np.tile(at_deg(20.0), (100, 1)), np.tile(at_deg(45.0), (60, 1))]
    )
    found = cluster_normals(
        normals[None],
        num_candidates=10,
        bin_angle_rad=np.deg2rad(30.0),
        min_separation_rad=np.deg2rad(20.0),
        max_num_planes=3,
        min_votes_frac=0.1,
    )
    assert len(found.normals) == 1
    assert (found.labels == 0).all()
