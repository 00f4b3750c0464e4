"""Scenes of a slanted wall in which each pair of images has features of its own."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import numpy as np
from mapping_tasks import write_images
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.model_files import Poses
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.mappers.pair_graph import PairGraph

WIDTH = 1000
HEIGHT = 700
MATRIX = np.array([[900.0, 0.0, 480.0], [0.0, 910.0, 360.0], [0.0, 0.0, 1.0]])
NOISE_PX = 0.3


def turned(about_x: float, about_y: float, about_z: float) -> NDArray[np.float64]:
    angles = np.deg2rad([about_x, about_y, about_z])
    return np.asarray(pycolmap.Rotation3d(angles).matrix())


def views(count: int) -> Poses:
    """Cameras that walk along a wall with unequal steps, up and down, and turn and roll."""
    steps = np.cumsum([1.0, 1.3, 0.8, 1.5, 1.1, 0.9][:count])
    found = {}
    for i, along in enumerate(steps):
        rotation = turned(3.0 * (-1) ** i, 9.0 - 4.0 * i, 5.0 * i)
        center = np.array([along, 0.25 * (-1) ** i, -0.3 * i % 0.7])
        found[f"{i}.jpg"] = rotation, -rotation @ center
    return found


def wall(random: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points of two slanted planes that meet in an edge."""
    x = random.uniform(-3, 9, count)
    y = random.uniform(-3, 3, count)
    return np.stack([x, y, 7.0 + 0.35 * np.abs(x - 3.0) + 0.1 * y], axis=1)


def wall_camera(matrix: NDArray[np.float64] = MATRIX) -> pycolmap.Camera:
    """Return the camera that all images share."""
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT)
    camera.params = matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    return camera


def posed_model(path: Path, poses: Poses) -> pycolmap.Reconstruction:
    """Return a model of the images of a database, without points."""
    model = pycolmap.Reconstruction()
    model.load(PairGraph.read(path).cache)
    for image_id, name in enumerate(poses, 1):
        frame = model.images[image_id].frame
        frame.set_cam_from_world(1, pycolmap.Rigid3d(np.column_stack(poses[name])))
        model.register_frame(frame.frame_id)
    return model


def write_scene(
    path: Path,
    poses: Poses,
    pairs: Iterable[tuple[int, int]],
    matrix: NDArray[np.float64] = MATRIX,
) -> None:
    """Write a verified database in which each pair of images has features of its own."""
    random = np.random.default_rng(5)
    names = list(poses)
    keypoints = {i: [np.zeros((0, 2))] for i in range(len(names))}
    matches = {}
    for first, second in pairs:
        points = wall(random, 600)
        seen = [project(points, poses[names[i]], matrix) for i in (first, second)]
        inside = np.logical_and(*(is_inside(part) for part in seen))
        starts = [sum(map(len, keypoints[i])) for i in (first, second)]
        for i, part in zip((first, second), seen, strict=True):
            keypoints[i].append(
                part[inside] + random.normal(0, NOISE_PX, (inside.sum(), 2))
            )
        rows = np.arange(inside.sum())
        matches[first, second] = np.stack([starts[0] + rows, starts[1] + rows], axis=1)
    with closing(pycolmap.Database.open(path)) as database:
        write_images(database, wall_camera(matrix), names)
        for i, parts in keypoints.items():
            database.write_keypoints(i + 1, np.concatenate(parts).astype(np.float32))
        for (first, second), indices in matches.items():
            database.write_matches(first + 1, second + 1, indices.astype(np.uint32))
    verify(path, VerificationOptions())


def project(
    points: NDArray[np.float64],
    pose: tuple[NDArray, NDArray],
    matrix: NDArray[np.float64] = MATRIX,
) -> NDArray[np.float64]:
    """Px of (N, 3) points, NaN of those behind the camera."""
    seen = (points @ pose[0].T + pose[1]) @ matrix.T
    return np.where(seen[:, 2:] > 0, seen[:, :2] / seen[:, 2:], np.nan)


def is_inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        return np.asarray(((points > 0) & (points < (WIDTH, HEIGHT))).all(axis=1))
