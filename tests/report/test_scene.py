"""How a model is turned, scaled and thinned before a page draws it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.report.scene import (
    View3D,
    max_num_observations,
    max_num_points,
    read_view,
)

FOCAL_PX = 100.0
SIZE = (200, 120)  # half of it is 1.0 and 0.6 focal lengths
FRONT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""World axes right, front, up of cameras whose axes are those of the world."""


def cam_from_world(yaw_deg: float, position: Sequence[float]) -> pycolmap.Rigid3d:
    """A camera that is turned about its y axis."""
    yaw = np.deg2rad(yaw_deg)
    rotation = np.array(
        [[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]]
    )
    return pycolmap.Rigid3d(
        pycolmap.Rotation3d(rotation), -rotation @ np.array(position)
    )


def view_of(
    folder: Path, poses: Sequence[pycolmap.Rigid3d], points: np.ndarray, color: int = 0
) -> View3D:
    """The view of a model of some cameras, called 0, 1, ..., and of (N, 3) points."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", FOCAL_PX, *SIZE)
    model.add_camera_with_trivial_rig(camera)
    for number, pose in enumerate(poses):
        image = pycolmap.Image(str(number), [], 1, number + 1)
        model.add_image_with_trivial_frame(image, pose)
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.full(3, color, np.uint8))
    folder.mkdir()
    model.write(folder)
    return read_view(folder, {})


def positions(view: View3D) -> np.ndarray:
    """(N, 3) positions of the points that the page draws."""
    data = base64.b64decode(view.points)[: 6 * view.num_points]
    return np.frombuffer(data, "<u2").reshape(-1, 3) / 65535 * 2 - 1


def colors(view: View3D) -> set[int]:
    return set(base64.b64decode(view.points)[6 * view.num_points :])


def test_z_is_up_and_y_is_where_cameras_look(tmp_path: Path) -> None:
    places = np.array([(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -0.5, 0.2)])
    poses = [cam_from_world(0.0, place) for place in places]
    view = view_of(tmp_path / "model", poses, np.zeros((0, 3)))
    centers = np.array([corners[0] for _, corners in view.cameras])
    ratio = (centers[1] - centers[0]) @ FRONT @ (places[1] - places[0]) / 4
    np.testing.assert_allclose(
        centers - centers[0], ratio * (places - places[0]) @ FRONT.T, atol=1e-6
    )
    farthest = np.linalg.norm(centers, axis=1).max()
    assert farthest == pytest.approx(1 / 1.15)


@pytest.mark.parametrize(
    ("yaws_deg", "has_front"), [((-70, 70), True), ((-75, 75), False)]
)
def test_cameras_that_look_in_all_directions_have_no_front(
    yaws_deg: tuple[int, int], has_front: bool, tmp_path: Path
) -> None:
    """The mean of their directions is 0.34 and 0.26 long."""
    poses = [cam_from_world(yaw, (yaw, 0.0, 0.0)) for yaw in yaws_deg]
    poses += [cam_from_world(yaw, (yaw, 0.0, 9.0)) for yaw in yaws_deg]
    view = view_of(tmp_path / "model", poses, np.zeros((0, 3)))
    centers = np.array([corners[0] for _, corners in view.cameras])
    across = centers[1] - centers[0]
    assert abs(across[2]) < 1e-6
    assert (abs(across[1]) < 1e-6 < across[0]) == has_front


def test_camera_is_a_pyramid_of_its_view_which_is_bounded(tmp_path: Path) -> None:
    poses = [cam_from_world(0.0, (x, 0.0, 0.0)) for x in (-1.0, 1.0)]
    view = view_of(tmp_path / "model", poses, np.zeros((0, 3)))
    for _, (center, *corners) in view.cameras:
        right, depth, up = (np.array(corners) - center).T
        np.testing.assert_allclose(depth, 0.07)
        np.testing.assert_allclose(np.abs(right), 0.8 * 0.07)  # not 1.0
        np.testing.assert_allclose(np.abs(up), 0.6 * 0.07)


def test_a_tenth_of_the_points_may_be_outside_of_the_view(tmp_path: Path) -> None:
    poses = [cam_from_world(0.0, (x, 0.0, 0.0)) for x in (-1.0, 1.0)]
    near = np.random.default_rng(0).uniform(-1, 1, (88, 3))
    far = np.random.default_rng(1).uniform(400, 500, (12, 3))
    view = view_of(tmp_path / "near", poses, np.concatenate([near, far[:8]]))
    assert view.num_points == 88
    assert np.ptp(positions(view), axis=0).min() > 0.5
    view = view_of(tmp_path / "far", poses, np.concatenate([near, far]))
    assert view.num_points == 100  # more than a tenth is no error


@pytest.mark.parametrize(("color", "shown"), [(0, 130), (1, 60), (255, 200)])
def test_colors_show_on_light_and_on_dark_ground(
    color: int, shown: int, tmp_path: Path
) -> None:
    """Points without colours are gray."""
    poses = [cam_from_world(0.0, (x, 0.0, 0.0)) for x in (-1.0, 1.0)]
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    assert colors(view_of(tmp_path / "model", poses, points, color)) == {shown}


def test_pages_of_many_photographs_draw_more_points() -> None:
    assert [max_num_points(num) for num in (3, 40, 100, 1000)] == [
        20_000, 20_000, 50_000, 200_000,
    ]  # fmt: skip
    assert [max_num_observations(num) for num in (40, 1000)] == [50_000, 500_000]
