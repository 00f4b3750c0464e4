"""Lines of print, and copies of one photograph."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry import parallax
from colmap_affrect.geometry.affine import project, rotation
from colmap_affrect.geometry.arrays import Array, Bytes
from colmap_affrect.geometry.parallax import (
    Size,
    correlation,
    mirrored_share,
    pure_rotation_ratio,
    same_view_homography,
    text_line_matches,
)

SIZES: tuple[Size, Size] = ((1000, 800), (1000, 800))
SHIFT_PX = np.array([20.0, 100.0])  # of a caption between two prints


def caption(height_px: float, angle_deg: float) -> Array:
    """Points of a line of print, 400 px long."""
    rng = np.random.default_rng(1)
    along = rng.uniform(0.0, 400.0, 60)
    across = rng.uniform(-height_px / 2, height_px / 2, 60)
    turn = rotation(np.deg2rad(angle_deg))
    return np.stack([along, across], axis=1) @ turn.T + (300.0, 400.0)


def noise(sigma_px: float, count: int) -> Array:
    return np.random.default_rng(2).normal(0.0, sigma_px, (count, 2))


def test_matches_of_a_caption_are_on_a_text_line_and_those_of_the_scene_are_not() -> (
    None
):
    points1 = caption(height_px=6.0, angle_deg=2.0)
    scene = np.random.default_rng(3).uniform((0, 0), (1000, 800), (30, 2))
    others = np.random.default_rng(4).uniform((0, 0), (1000, 800), (30, 2))
    points1 = np.concatenate([points1, scene])
    points2 = np.concatenate(
        [0.8 * points1[:60] + (30.0, 240.0) + noise(0.1, 60), others]
    )
    found = text_line_matches(points1, points2, SIZES)
    assert np.count_nonzero(found[:60]) > 54
    assert np.count_nonzero(found[60:]) < 3


@pytest.mark.parametrize(
    ("height_px", "angle_deg"), [(60.0, 0.0), (6.0, 20.0)], ids=["too high", "oblique"]
)
def test_thick_or_oblique_bands_are_no_text_line(
    height_px: float, angle_deg: float
) -> None:
    points = caption(height_px, angle_deg)
    assert not text_line_matches(points, points + SHIFT_PX, SIZES).any()


def test_line_of_inexact_matches_is_no_print() -> None:
    points = caption(height_px=6.0, angle_deg=0.0)
    for sigma_px in (1.5, 4.0):
        others = points + SHIFT_PX + noise(sigma_px, 60)
        found = text_line_matches(points, others, SIZES)
        assert np.count_nonzero(found) < 35


def copies(num_wrong: int, sigma_px: float) -> tuple[Array, Array]:
    """Matches of a photograph and a smaller print of it."""
    points1 = np.random.default_rng(5).uniform((0, 0), (1000, 800), (200, 2))
    points2 = 0.6 * points1 + (20.0, 30.0) + noise(sigma_px, 200)
    points2[:num_wrong] = np.random.default_rng(6).uniform(
        (0, 0), (700, 500), (num_wrong, 2)
    )
    return points1, points2


@pytest.mark.parametrize(("sigma_px", "error_px"), [(0.05, 0.1), (2.0, 4.0)])
def test_matches_of_a_print_have_the_homography_of_pixel_centres(
    sigma_px: float, error_px: float
) -> None:
    points1, points2 = copies(10, sigma_px)
    homography = same_view_homography(points1, points2, SIZES)
    assert homography is not None
    # Corners of images are at (0, 0), centres of their first pixels at (0.5, 0.5).
    points = np.array([[99.5, 99.5], [799.5, 599.5]])
    expected = 0.6 * (points + 0.5) + (20.0, 30.0) - 0.5
    assert_allclose(project(homography, points), expected, atol=error_px)


@pytest.mark.parametrize(
    ("num_wrong", "sigma_px"), [(60, 2.0), (0, 40.0)], ids=["other matches", "parallax"]
)
def test_other_photographs_are_no_copies(num_wrong: int, sigma_px: float) -> None:
    assert same_view_homography(*copies(num_wrong, sigma_px), SIZES) is None


def gray_texture(seed: int, deviation: float) -> Bytes:
    random = np.random.default_rng(seed).normal(size=(300, 400)).astype(np.float32)
    smooth = cv2.GaussianBlur(random, (0, 0), 2.0)
    return np.rint(128.0 + deviation * smooth / smooth.std()).astype(np.uint8)


def test_copies_correlate_whatever_their_contrast_and_other_photographs_do_not() -> (
    None
):
    photograph = gray_texture(7, 15.0)
    shading = 60.0 * np.sin(np.arange(400) / 30.0)
    copy = np.rint(0.8 * photograph + 30.0 + shading).clip(0, 255).astype(np.uint8)
    assert correlation(photograph, copy, np.eye(3)) > 0.85
    assert correlation(photograph, gray_texture(8, 15.0), np.eye(3)) < 0.3


def test_images_without_texture_do_not_correlate() -> None:
    faint = gray_texture(7, 3.5)
    assert correlation(faint, faint, np.eye(3)) == 0.0


def test_windows_of_little_contrast_are_compared_too() -> None:
    photograph = gray_texture(7, 10.0)
    assert correlation(photograph, photograph, np.eye(3)) > 0.99


def test_mirrored_copies_of_dense_keypoints_prove_little() -> None:
    side = 800
    is_keypoint = np.random.default_rng(3).random((side, side)) < 0.45
    rows, columns = np.nonzero(is_keypoint)
    points = np.stack([columns, rows], axis=1) + 0.5
    mirrored = points * [-1.0, 1.0] + [side, 0.0]
    share = mirrored_share(points, mirrored, ((side, side), (side, side)))
    assert 0.15 < share < 0.6


def test_the_rotation_of_two_rays_is_that_of_kabsch() -> None:
    random = np.random.default_rng(0)
    rays1 = random.normal(size=(40, 2, 3))
    rays2 = random.normal(size=(40, 2, 3))
    rays1 /= np.linalg.norm(rays1, axis=-1, keepdims=True)
    rays2 /= np.linalg.norm(rays2, axis=-1, keepdims=True)
    found = parallax._rotations_of_two(rays1, rays2)
    assert_allclose(found, parallax._fitted_rotations(rays1, rays2), atol=1e-9)


def test_medians_are_those_of_numpy() -> None:
    rows = np.random.default_rng(0).normal(size=(5, 8))
    assert_allclose(parallax._medians(rows), np.median(rows, axis=1))
    assert_allclose(parallax._medians(rows[:, 1:]), np.median(rows[:, 1:], axis=1))


def test_a_camera_that_turns_and_zooms_may_have_images_of_two_sizes() -> None:
    """Image 2 is larger, and of a lens that is one and a half times as long."""
    sizes: tuple[Size, Size] = ((640, 480), (1000, 900))
    focal_px = 0.63 * 640.0
    x, y = np.meshgrid(np.linspace(60, 580, 15), np.linspace(40, 440, 13))
    points1 = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.column_stack([(points1 - (320, 240)) / focal_px, np.ones(len(points1))])
    roll = pycolmap.Rotation3d(np.array([0.0, 0.0, 0.3]))
    turn = pycolmap.Rotation3d(np.array([0.2, 0.0, 0.0])) * roll
    turned = rays @ turn.matrix().T
    points2 = 1.5 * focal_px * turned[:, :2] / turned[:, 2:] + (500, 450)
    assert pure_rotation_ratio(points1, points2, sizes, 4.0) > 0.9
    wrong = np.random.default_rng(6).permutation(points2)
    assert pure_rotation_ratio(points1, wrong, sizes, 4.0) < 0.3


def test_where_one_image_shows_nothing_windows_do_not_correlate() -> None:
    """Two thirds of the second image are painted over."""
    random = np.random.default_rng(5)
    rough = random.uniform(0, 255, (40, 60)).astype(np.uint8)
    gray = cv2.resize(rough, (300, 200), interpolation=cv2.INTER_LINEAR)
    painted = gray.copy()
    painted[:, 100:] = 128
    assert correlation(gray, gray, np.eye(3)) > 0.9
    assert correlation(gray, painted, np.eye(3)) < 0.2
    assert correlation(painted, gray, np.eye(3)) < 0.2
