"""Whether the points of a model tell the focal lengths of cameras that nobody knows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.loose_cameras import loose_images

UNKNOWN = CameraRecord(("a",), "guess", 1500.0, size=(640, 480))
NUM_IMAGES, STEP_DEG = 5, 30.0
DISTANCE, NOISE_PX = 6.0, 0.3


def ring(views_per_point: int) -> pycolmap.Reconstruction:
    """Return a model of images around a cube that they all look at the middle of.

    Each point is seen by so many neighbours; keypoints have noise.
    """
    random = np.random.default_rng(4)
    camera = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[1500, 320, 240, 0]
    )
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    places = random.uniform(-0.7, 0.7, (600, 3))
    first = random.integers(0, NUM_IMAGES - views_per_point + 1, len(places))
    tracks = [pycolmap.Track() for _ in places]
    for number in range(NUM_IMAGES):
        turn = pycolmap.Rotation3d(np.array([0.0, np.deg2rad(STEP_DEG * number), 0.0]))
        pose = pycolmap.Rigid3d(turn, np.array([0.0, 0.0, DISTANCE]))
        rows = np.flatnonzero((first <= number) & (number < first + views_per_point))
        pixels = np.array([camera.img_from_cam(pose * places[row]) for row in rows])
        pixels += random.normal(0.0, NOISE_PX, pixels.shape)
        image = pycolmap.Image(f"{number}.jpg", pixels, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pose)
        for index, row in enumerate(rows):
            tracks[row].add_element(number + 1, index)
    for place, track in zip(places, tracks, strict=True):
        model.add_point3D(place, track)
    return model


def task_of(record: CameraRecord = UNKNOWN) -> MappingTask:
    return MappingTask(Path("database.db"), None, cameras={1: record})


@pytest.mark.parametrize(("views_per_point", "is_loose"), [(2, True), (4, False)])
def test_views_of_one_thing_from_around_tell_focal_lengths_by_points_of_many_images(
    views_per_point: int, is_loose: bool
) -> None:
    model = ring(views_per_point)
    names = tuple(f"{number}.jpg" for number in range(NUM_IMAGES))
    assert loose_images(model, task_of()) == (names if is_loose else ())
    assert model.cameras[1].focal_length == 1500.0


def test_what_is_known_need_not_be_told_by_points() -> None:
    model = ring(2)
    assert loose_images(model, task_of(replace(UNKNOWN, source="exif"))) == ()
    assert loose_images(model, replace(task_of(), cameras={})) == ()
    assert loose_images(pycolmap.Reconstruction(), task_of()) == ()
