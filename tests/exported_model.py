"""A small model with distorted cameras that look in different directions, and its photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap

SIZE = (160, 120)
NAMES = ("a.png", "b.png", "side/c.png", "d.png")


def write_model(
    folder: Path, camera_model: str = "SIMPLE_RADIAL"
) -> pycolmap.Reconstruction:
    """Write a model of four images and sixty points, whose keypoints are exact."""
    rng = np.random.default_rng(3)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, camera_model, 150.0, *SIZE)
    params = np.array(camera.params)
    params[camera.principal_point_idxs()] = [75.0, 66.0]
    params[camera.extra_params_idxs()] = 0.05
    camera.params = params
    model.add_camera_with_trivial_rig(camera)
    points = rng.uniform([-2, -1, 5], [2, 1, 9], (60, 3))
    poses = []
    for number, name in enumerate(NAMES, 1):
        angles = np.array([0.05, -0.1, 0.03]) * number
        rotation = pycolmap.Rotation3d(angles)
        center = np.array([0.7 * number - 2, 0.2 * (-1) ** number, 0.3 * number])
        pose = pycolmap.Rigid3d(rotation, -rotation.matrix() @ center)
        poses.append(pose)
        keypoints = np.array([camera.img_from_cam(pose * point) for point in points])
        image = pycolmap.Image(
            name=name, keypoints=keypoints, camera_id=1, image_id=number
        )
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, len(NAMES) + 1):
            track.add_element(number, index)
        model.add_point3D(point, track, np.array([index, 2 * index, 250], np.uint8))
    folder.mkdir(parents=True)
    model.write(folder)
    return model


def write_photographs(folder: Path) -> None:
    """Write something for each image."""
    for seed, name in enumerate(NAMES):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, texture(SIZE, seed))
