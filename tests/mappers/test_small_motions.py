"""Points that move against the others by less than matches may be off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import write_images
from wall_scene import is_inside, posed_model, project, views, wall, wall_camera

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers.small_motions import small_motion

NUM_POINTS = 600
NUM_IMAGES = 5
NOISE_PX = 0.2


def model_of_wall(
    path: Path, moving: float, step: float, *, is_scattered: bool = False
) -> pycolmap.Reconstruction:
    """Return a model of a wall, a part of whose points moves up and down a little.

    Args:
        path: Of a database to write.
        moving: The part of the points that moves, of those on the left.
        step: By how much from image to image, in units of the wall.
        is_scattered: Whether points move here and there instead, each in its own way.
    """
    random = np.random.default_rng(4)
    points = wall(random, NUM_POINTS)
    moves = points[:, 0] < np.quantile(points[:, 0], moving)
    if is_scattered:
        moves = random.uniform(size=NUM_POINTS) < moving
    poses = views(NUM_IMAGES)
    pixels = {}
    for number, (name, pose) in enumerate(poses.items()):
        now = points.copy()
        now[moves, 1] += step * (number - NUM_IMAGES // 2)
        noise = random.normal(0.0, NOISE_PX, (NUM_POINTS, 2))
        if is_scattered:
            now = points
            noise[moves] *= 6.0
        pixels[name] = project(now, pose) + noise
    with open_database(path) as database:
        write_images(database, wall_camera(), poses)
        for image_id, name in enumerate(poses, 1):
            database.write_keypoints(image_id, pixels[name].astype(np.float32))
    model = posed_model(path, poses)
    for number, point in enumerate(points):
        track = pycolmap.Track()
        for image_id, name in enumerate(poses, 1):
            if is_inside(pixels[name][number : number + 1])[0]:
                track.add_element(image_id, number)
        if track.length() > 1:
            model.add_point3D(point, track)
    return model


def test_a_part_that_creeps_is_found_and_how_far_its_poses_are_from_the_others(
    tmp_path: Path,
) -> None:
    model = model_of_wall(tmp_path / "a.db", 0.35, 0.02)
    model.update_point_3d_errors()
    errors = [point.error for point in model.points3D.values()]
    assert max(errors) < 8.0
    found = small_motion(model)
    assert found is not None
    assert found.share == pytest.approx(0.65, abs=0.1)
    # The last image hardly shows what moves.
    assert sorted(found.changes_deg) == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    assert 0.5 < min(found.changes_deg.values()) < max(found.changes_deg.values()) < 3.0


@pytest.mark.parametrize("is_scattered", [False, True])
def test_nothing_moves_where_points_err_each_in_their_own_way(
    tmp_path: Path, *, is_scattered: bool
) -> None:
    part = 0.3 if is_scattered else 0.0
    model = model_of_wall(tmp_path / "a.db", part, 0.0, is_scattered=is_scattered)
    assert small_motion(model) is None


def test_two_images_and_few_points_tell_nothing(tmp_path: Path) -> None:
    model = model_of_wall(tmp_path / "a.db", 0.35, 0.02)
    for point_id in sorted(model.point3D_ids())[40:]:
        model.delete_point3D(point_id)
    assert small_motion(model) is None
