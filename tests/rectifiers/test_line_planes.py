"""Rectifier `lines`: walls that straight lines span, as if seen from the front."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from line_scenes import SIZE, chance_edges, corner_of_walls, draw_wall, pixels, turn
from numpy.testing import assert_allclose

from colmap_affrect.data import GrayImage, Photograph
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.conventions import camera_matrix
from colmap_affrect.rectifiers.base import RECTIFIERS, RectifierInputs


def photograph_of(image: GrayImage) -> Photograph:
    size = (image.shape[1], image.shape[0])
    return Photograph(image, "a.png", None, camera_matrix(size), None, None, False)


@pytest.fixture(scope="module")
def corner() -> Photograph:
    """Two walls of a court that meet in the middle."""
    return photograph_of(corner_of_walls())


def test_each_wall_of_a_corner_is_shown_from_the_front(corner: Photograph) -> None:
    rectifier = RECTIFIERS.make(RECTIFIERS.options("lines"), RectifierInputs())
    plan = rectifier.plan(corner)
    assert len(plan.items) == 2
    for along in (np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])):
        square = np.array(
            [[0.6, -0.4, 0.6], [1.6, -0.4, 1.6], [1.6, 0.6, 1.6], [0.6, 0.6, 0.6]]
        )
        points = square * (along + np.array([0.0, 1.0, 0.0]))
        in_image = pixels(points)
        holding = [item for item in plan.items if item.in_region(in_image).all()]
        assert len(holding) == 1
        mapped = project(holding[0].rectified_from_image, in_image)
        sides = np.linalg.norm(np.roll(mapped, -1, axis=0) - mapped, axis=1)
        assert_allclose(sides / sides.mean(), 1.0, atol=0.01)  # a square again
        diagonals = np.linalg.norm(mapped[:2] - mapped[2:], axis=1)
        assert_allclose(diagonals[0] / diagonals[1], 1.0, atol=0.01)
        before = np.linalg.norm(np.roll(in_image, -1, axis=0) - in_image, axis=1)
        assert before.max() / before.min() > 1.2  # it was none in the photograph
        assert holding[0].tilt > 1.1


def test_walls_from_the_front_are_left_as_they_are(corner: Photograph) -> None:
    options = RECTIFIERS.options({"name": "lines", "min_angle_deg": 70.0})
    assert not RECTIFIERS.make(options, RectifierInputs()).plan(corner).items


def test_lines_by_chance_and_empty_pictures_give_no_warps() -> None:
    image = np.full(SIZE[::-1], 230, np.uint8)
    for x1, y1, x2, y2 in chance_edges(60, 3).round().astype(int).tolist():
        cv2.line(image, (x1, y1), (x2, y2), 30, 3, cv2.LINE_AA)
    rectifier = RECTIFIERS.make(RECTIFIERS.options("lines"), RectifierInputs())
    assert not rectifier.plan(photograph_of(image)).items
    assert not rectifier.plan(photograph_of(np.full((90, 120), 128, np.uint8))).items


def test_walls_at_twenty_degrees_from_the_front_are_left_as_they_are() -> None:
    """A wall is warped from 30 degrees on, though a warp at less would be a bit better."""
    nearly_ahead = turn(0, -4.0) @ turn(1, 20.0)
    image = np.full(SIZE[::-1], 200, np.uint8)
    draw_wall(image, np.array([1.0, 0.0, 0.0]), nearly_ahead)
    draw_wall(image, np.array([-1.0, 0.0, 0.0]), nearly_ahead)
    options = RECTIFIERS.options("lines")
    assert (
        not RECTIFIERS.make(options, RectifierInputs()).plan(photograph_of(image)).items
    )
    every = RECTIFIERS.options({"name": "lines", "min_angle_deg": 5.0})
    assert RECTIFIERS.make(every, RectifierInputs()).plan(photograph_of(image)).items
