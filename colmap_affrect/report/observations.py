"""Where the photographs of a model see its points, as arrays.

They are read from COLMAP's file of the images, in the layout of its documentation: pycolmap hands
them out one by one, a microsecond and more each.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import damage
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.project.regular_files import read_regular

# COLMAP's images.bin: the number of images, then of each what comes before its name, the name up to
# a zero byte, the number of its keypoints, and these; format
COUNT = np.dtype("<u8")
BEFORE_NAME = np.dtype([("id", "<u4"), ("pose", "<f8", 7), ("camera_id", "<u4")])
KEYPOINT = np.dtype([("place", "<f8", 2), ("point_id", "<u8")])
NO_POINT = np.iinfo(np.uint64).max  # of a keypoint that sees none

Keypoints = NDArray[np.void]  # (N,) of KEYPOINT


@dataclass(frozen=True)
class Observations:
    """What the registered photographs of a model see of its points."""

    names: tuple[str, ...]  # of the M registered photographs
    rows: Indices  # (K,) number of the photograph of each observation
    point_ids: Indices  # (K,) of the points that are seen
    places: Array  # (K, 2) px from the upper left corner of the photograph
    errors_px: Array  # (K,) distances from where the model sees the points

    @cached_property
    def num_shared(self) -> Indices:
        """(M, M) numbers of points that two photographs see."""
        num_images = len(self.names)
        order = np.argsort(self.point_ids, kind="stable")
        points = self.point_ids[order]
        rows = self.rows[order]
        counts = np.zeros(num_images**2, dtype=np.int64)
        waiting = list[Indices]()  # rows of two photographs as one number
        num_waiting = 0
        # The other observations of a point are the next ones of its row
        left = np.arange(len(points))
        step = 1
        while len(left):
            left = left[left + step < len(points)]
            left = left[points[left + step] == points[left]]
            waiting.append(rows[left] * num_images + rows[left + step])
            num_waiting += len(left)
            step += 1
            # To go through all pairs of photographs for each step would take longest of all
            if num_waiting >= len(counts) or not len(left):
                counts += np.bincount(np.concatenate(waiting), minlength=num_images**2)
                waiting.clear()
                num_waiting = 0
        one_way = counts.reshape(num_images, num_images)
        both_ways: Indices = one_way + one_way.T
        np.fill_diagonal(both_ways, 0)
        return both_ways

    def mean_errors_px(self) -> Array:
        """Return the (M,) mean distances of the photographs, nan without a point."""
        num_images = len(self.names)
        counts = np.bincount(self.rows, minlength=num_images)
        sums = np.bincount(self.rows, self.errors_px, num_images)
        means = np.full(num_images, np.nan)
        np.divide(sums, counts, out=means, where=counts > 0)
        return means


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the registered images in the order of their ids."""
    return [model.images[image_id] for image_id in sorted(model.reg_image_ids())]


class ModelReader:
    """Reads the models of a run, each once."""

    def __init__(self, sparse_path: Path) -> None:
        """Take the folder of all models; they are read when they are asked for."""
        self.sparse_path = sparse_path
        self.unreadable = set[int]()  # models whose figures could not be counted
        self._models = dict[int, pycolmap.Reconstruction]()
        self._observations = dict[int, Observations]()

    def path(self, number: int) -> Path:
        """Return the folder of a model."""
        return self.sparse_path / str(number)

    def model(self, number: int) -> pycolmap.Reconstruction:
        """Return a model, which is not to be changed.

        Args:
            number: of the model, the largest has 0.

        Raises:
            AffrectError: it cannot be read.
        """
        if number not in self._models:
            self._models[number] = read_given_model(self.path(number))
        return self._models[number]

    def observations(self, number: int) -> Observations:
        """Return all observations of a model, photograph by photograph.

        Args:
            number: of the model.

        Raises:
            AffrectError: it cannot be read.
        """
        if number not in self._observations:
            model = self.model(number)
            path = self.path(number) / "images.bin"
            with damage(path, "run 'colmap-affrect map' again"):
                keypoints = _read_keypoints(path)
            self._observations[number] = _observations_of(model, keypoints)
        return self._observations[number]


def _read_keypoints(path: Path) -> dict[int, Keypoints]:
    """Return the keypoints of the registered images, by image id, with the points that they see."""
    data = read_regular(path)
    (num_images,) = np.frombuffer(data, COUNT, 1).tolist()
    at = COUNT.itemsize
    found = dict[int, Keypoints]()
    for _ in range(num_images):
        (image_id,) = np.frombuffer(data, BEFORE_NAME, 1, at)["id"].tolist()
        at = data.index(b"\0", at + BEFORE_NAME.itemsize) + 1
        (num_keypoints,) = np.frombuffer(data, COUNT, 1, at).tolist()
        at += COUNT.itemsize
        found[image_id] = np.frombuffer(data, KEYPOINT, num_keypoints, at)
        at += num_keypoints * KEYPOINT.itemsize
    return found


def _observations_of(
    model: pycolmap.Reconstruction, keypoints: dict[int, Keypoints]
) -> Observations:
    """Return all observations of a model, of the keypoints of its images by image id."""
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    points = np.array([model.points3D[i].xyz for i in ids.tolist()]).reshape(-1, 3)
    images = registered_images(model)
    rows = [np.empty(0, dtype=np.int64)]
    point_ids = [np.empty(0, dtype=np.int64)]
    places = [np.empty((0, 2))]
    errors = [np.empty(0)]
    for row, image in enumerate(images):
        marks = keypoints[image.image_id]
        seen = marks[marks["point_id"] != NO_POINT]
        ids_of_image = seen["point_id"].astype(np.int64)
        of_image = points[np.searchsorted(ids, ids_of_image)]
        rows.append(np.full(len(seen), row, dtype=np.int64))
        point_ids.append(ids_of_image)
        places.append(seen["place"])
        errors.append(_errors_px(model, image, of_image, seen["place"]))
    return Observations(
        names=tuple(image.name for image in images),
        rows=np.concatenate(rows),
        point_ids=np.concatenate(point_ids),
        places=np.concatenate(places),
        errors_px=np.concatenate(errors),
    )


def _errors_px(
    model: pycolmap.Reconstruction,
    image: pycolmap.Image,
    points: Array,
    places: Array,
) -> Array:
    """Return the (P,) distances of (P, 2) places from where an image sees its (P, 3) points.

    A point that is behind the camera has none, and does not count.
    """
    if not len(points):
        return np.empty(0)
    camera = model.cameras[image.camera_id]
    seen = camera.img_from_cam(image.cam_from_world() * points)
    errors: Array = np.linalg.norm(np.asarray(seen, np.float64) - places, axis=1)
    return np.where(np.isfinite(errors), errors, 0.0)
