"""What tie points say of poses, and where those are that one photograph alone sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from strategies import Array

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.tie_points import (
    ImageResidual,
    TiePoints,
    tie_point_log_odds,
)

FOCAL_PX = 800.0
WIDTH = 1000
HEIGHT = 600
POSE = pycolmap.Rigid3d(
    pycolmap.Rotation3d(np.array([0.3, -0.5, 0.2])), np.array([0.4, -1.0, 2.0])
)
MARK = np.array([300.0, 200.0])  # px, of a tie point that nothing else sees
NEAR_DEPTHS = [2.0, 2.1, 4.0, 9.0, 9.5]  # of points around the mark
FAR_DEPTH = 30.0  # of all others


def residuals_of(num_agreeing: int, num_differing: int) -> list[ImageResidual]:
    """Residuals of tie points that three images see; those of the first one differ or not."""
    errors_px = [2.0] * num_agreeing + [40.0] * num_differing
    found = list[ImageResidual]()
    for number, error_px in enumerate(errors_px):
        found.append(ImageResidual(str(number), 1, error_px))
        found.append(ImageResidual(str(number), 2, 1.0))
        found.append(ImageResidual(str(number), 3, 1.0))
    return found


@pytest.mark.parametrize(
    ("num_agreeing", "num_differing"),
    [(3, 0), (3, 2), (4, 1), (5, 2), (0, 1)],
)
def test_tie_points_beyond_three_speak_for_a_pose_and_all_that_differ_against_it(
    num_agreeing: int, num_differing: int
) -> None:
    """Nine of ten agree with right poses, one of twenty with wrong ones."""
    found = tie_point_log_odds(residuals_of(num_agreeing, num_differing))
    expected = max(0, num_agreeing - 3) * math.log(0.9 / 0.05)
    expected += num_differing * math.log(0.1 / 0.95)
    assert found[1] == pytest.approx(expected)


def test_a_tie_point_behind_a_camera_is_as_far_off_as_an_image_is_large() -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", FOCAL_PX, WIDTH, HEIGHT
    )
    model.add_camera_with_trivial_rig(camera)
    middle = np.array([[WIDTH / 2, HEIGHT / 2]])
    for image_id, depth in ((1, 5.0), (2, -5.0)):
        image = pycolmap.Image(f"{image_id}.jpg", middle, 1, image_id)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, depth]))
        model.add_image_with_trivial_frame(image, pose)
    track = pycolmap.Track()
    track.add_element(1, 0)
    track.add_element(2, 0)
    model.add_point3D(np.zeros(3), track)
    before, behind = TiePoints({"p": {1: 0, 2: 0}}).residuals(model)
    assert before.error_px == pytest.approx(0.0)
    assert behind.error_px == pytest.approx(math.hypot(WIDTH, HEIGHT))


def model_around_mark(distance_px: float) -> tuple[pycolmap.Reconstruction, TiePoints]:
    """Return a model of one image that sees points around a mark, and its tie point.

    Args:
        distance_px: of the points around the mark, from it.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, len(NEAR_DEPTHS), endpoint=False)
    around = MARK + distance_px * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    others = np.random.default_rng(2).uniform((600, 300), (WIDTH, HEIGHT), (30, 2))
    pixels = np.concatenate([around, others, [MARK]])
    depths = [*NEAR_DEPTHS, *[FAR_DEPTH] * len(others)]
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_PINHOLE", FOCAL_PX, WIDTH, HEIGHT
    )
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image("1.jpg", pixels, 1, 1)
    model.add_image_with_trivial_frame(image, POSE)
    for number, depth in enumerate(depths):
        track = pycolmap.Track()
        track.add_element(1, number)
        model.add_point3D(place_at(pixels[number], depth), track)
    return model, TiePoints({"p": {1: len(pixels) - 1}})


def place_at(pixel: Array, depth: float) -> Array:
    """Return the (3,) place in the world of a pixel at a depth."""
    x, y = (pixel - (WIDTH / 2, HEIGHT / 2)) / FOCAL_PX
    return np.asarray(POSE.inverse() * (depth * np.array([x, y, 1.0])))


def test_a_mark_of_one_photograph_is_as_deep_as_the_middle_one_of_the_points_around() -> (
    None
):
    model, tie_points = model_around_mark(60.0)
    position = tie_points.positions(model)["p"]
    assert position == pytest.approx(place_at(MARK, sorted(NEAR_DEPTHS)[2]))


@pytest.mark.parametrize(("distance_px", "is_known"), [(90.0, True), (110.0, False)])
def test_points_tell_the_depth_of_a_mark_up_to_a_tenth_of_the_image(
    distance_px: float, *, is_known: bool
) -> None:
    model, tie_points = model_around_mark(distance_px)
    assert ("p" in tie_points.positions(model)) == is_known


def test_a_mark_without_points_around_is_as_deep_as_another_photograph_says() -> None:
    """Their rays meet behind both cameras."""
    model, _ = model_around_mark(60.0)
    to_the_right = np.array([[200.0, 0.0]])
    blind = pycolmap.Image("2.jpg", MARK + to_the_right, 1, 2)
    beside = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-1.0, 0.0, 0.0]))
    model.add_image_with_trivial_frame(blind, beside * POSE)
    last = model.images[1].num_points2D() - 1
    position = TiePoints({"p": {2: 0, 1: last}}).positions(model)["p"]
    assert position == pytest.approx(place_at(MARK, sorted(NEAR_DEPTHS)[2]))
