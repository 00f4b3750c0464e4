"""Matches of synthetic photographs by cameras with known focal lengths."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.geometry.focal_evidence import MatchedPair

Array = NDArray[np.float64]

NOISE, OUTLIER, SHARE_OF_OUTLIERS = 0.5e-3, 3e-3, 0.1
"""Of matches, longer sides: the error, how far some are off that still are inliers, how many."""

IMAGE = np.array([0.5, 0.375])
"""Half of an image."""


@dataclass(frozen=True)
class View:
    """A photograph: focal length in longer sides, (3, 3) world to camera, and where it stood."""

    focal: float
    rotation: Array
    center: Array

    def project(self, points: Array) -> Array:
        """Return (N, 2) in units of the longer side, from the image centre."""
        seen = (points - self.center) @ self.rotation.T
        return np.asarray(self.focal * seen[:, :2] / seen[:, 2:])


def looking(focal: float, center: Array, target: Array, roll: float = 0.0) -> View:
    """Return a view of a target."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross([np.sin(roll), np.cos(roll), 0.0], forward)
    right /= np.linalg.norm(right)
    return View(focal, np.stack([right, np.cross(forward, right), forward]), center)


def views_around(focals: Iterable[float], rng: np.random.Generator) -> list[View]:
    """Return views of the origin from as far as fills the image, some nearer than others."""
    views = []
    for focal in focals:
        turn, lift = rng.uniform(-0.7, 0.7), rng.uniform(-0.3, 0.3)
        away = 3.2 * focal * rng.uniform(0.8, 1.3)
        center = away * np.array([np.sin(turn), np.sin(lift), -np.cos(turn) * np.cos(lift)])
        views.append(looking(focal, center, rng.uniform(-0.3, 0.3, 3), rng.uniform(-0.2, 0.2)))
    return views


def in_a_box(num: int, rng: np.random.Generator) -> Array:
    """Return (N, 3) points about the origin."""
    return rng.uniform(-1.0, 1.0, (num, 3)) * [1.0, 0.8, 0.9]


def on_a_plane(num: int, rng: np.random.Generator) -> Array:
    """Return (N, 3) points of a slanted wall through the origin."""
    x, y = rng.uniform(-1.0, 1.0, (2, num)) * [[1.2], [0.9]]
    return np.stack([x, y, 0.4 * x - 0.2 * y], axis=1)


def matches(
    view1: View, view2: View, points: Array, rng: np.random.Generator, num: int = 100
) -> tuple[Array, Array]:
    """Return noisy projections of points that both images show."""
    first, second = view1.project(points), view2.project(points)
    both = (np.abs(first) < IMAGE).all(axis=1) & (np.abs(second) < IMAGE).all(axis=1)
    chosen = np.flatnonzero(both)[:num]
    found = [
        side[chosen] + NOISE * rng.standard_normal((len(chosen), 2)) for side in (first, second)
    ]
    off = rng.random(len(chosen)) < SHARE_OF_OUTLIERS
    found[1][off] += rng.uniform(-OUTLIER, OUTLIER, (off.sum(), 2))
    return found[0], found[1]


def fundamental(points1: Array, points2: Array) -> Array:
    """Estimate a fundamental matrix, as any program would."""
    found, _ = cv2.findFundamentalMat(1000.0 * points1, 1000.0 * points2, cv2.FM_LMEDS)
    to_px = np.diag([1000.0, 1000.0, 1.0])
    matrix = to_px @ found @ to_px
    return np.asarray(matrix / np.linalg.norm(matrix))


def matched_pair(
    view1: View, view2: View, points: Array, rng: np.random.Generator, num: int = 100
) -> MatchedPair:
    """Return the matches of two views with their fundamental matrix."""
    found = matches(view1, view2, points, rng, num)
    return MatchedPair.of(*found, fundamental(*found), NOISE)


def all_pairs(
    views: Sequence[View], points: Array, rng: np.random.Generator, num: int = 100
) -> list[tuple[tuple[int, int], MatchedPair]]:
    """Return the matched pairs of all views that see enough of the same, by their indices."""
    return [
        ((i, j), matched_pair(views[i], views[j], points, rng, num))
        for i, j in combinations(range(len(views)), 2)
    ]


def write_views(
    path: Path, views: Sequence[View], sizes: Sequence[tuple[int, int]], points: Array, seed: int
) -> None:
    """Write a database of matched images, each with a camera, a rig and a frame of its own.

    Images higher than wide show the view turned by 90 degrees. Wrong matches are among the others.

    Args:
        path: of the database; images that it has stay.
        views: of all images.
        sizes: (width, height) of all images, px.
        points: (N, 3) what they show.
        seed: of noise.
    """
    rng = np.random.default_rng(seed)
    with open_database(path) as database:
        known = database.num_images()
        seen = []
        for index, (view, size) in enumerate(zip(views, sizes, strict=True)):
            places = view.project(points)
            seen.append((np.abs(places) < IMAGE).all(axis=1))
            places += NOISE * rng.standard_normal(places.shape)
            if size[1] > size[0]:
                places = places[:, ::-1] * [-1.0, 1.0]
            if index >= known:
                _write_image(database, f"{index}.jpg", size)
            keypoints = (max(size) * places + np.array(size) / 2).astype(np.float32)
            if index >= known:
                database.write_keypoints(index + 1, keypoints)
        for i, j in combinations(range(len(views)), 2):
            if j >= known:
                both = np.flatnonzero(seen[i] & seen[j])
                wrong = rng.permutation(both)[: len(both) // 6]
                rows = np.stack([both, both], axis=1)
                rows[np.isin(both, wrong), 1] = rng.permutation(wrong)
                database.write_matches(i + 1, j + 1, rows.astype(np.uint32))


def _write_image(database: pycolmap.Database, name: str, size: tuple[int, int]) -> None:
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 1.2 * max(size), *size)
    camera.camera_id = database.write_camera(camera)
    rig = pycolmap.Rig()
    rig.add_ref_sensor(camera.sensor_id)
    image = pycolmap.Image(name=name, camera_id=camera.camera_id)
    image.image_id = database.write_image(image)
    frame = pycolmap.Frame(rig_id=database.write_rig(rig))
    frame.add_data_id(image.data_id)
    database.write_frame(frame)
