"""Where the photographs of a model see its points, as arrays."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import Array, Indices


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
        step = 1
        while True:  # the other observations of a point are the next ones of its row
            is_same = points[step:] == points[:-step]
            if not is_same.any():
                break
            keys = rows[:-step][is_same] * num_images + rows[step:][is_same]
            counts += np.bincount(keys, minlength=num_images**2)
            step += 1
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


def observations_of(model: pycolmap.Reconstruction) -> Observations:
    """Return all observations of a model, photograph by photograph."""
    images = registered_images(model)
    rows = []
    point_ids = []
    places = []
    errors = []
    for row, image in enumerate(images):
        seen = image.get_observation_points2D()
        ids = [point.point3D_id for point in seen]
        marks = np.array([point.xy for point in seen]).reshape(-1, 2)
        rows.append(np.full(len(ids), row, dtype=np.int64))
        point_ids.append(np.array(ids, dtype=np.int64))
        places.append(marks)
        errors.append(_errors_px(model, image, ids, marks))
    none = np.empty(0, dtype=np.int64)
    return Observations(
        names=tuple(image.name for image in images),
        rows=np.concatenate([none, *rows]),
        point_ids=np.concatenate([none, *point_ids]),
        places=np.concatenate([np.empty((0, 2)), *places]),
        errors_px=np.concatenate([np.empty(0), *errors]),
    )


def _errors_px(
    model: pycolmap.Reconstruction,
    image: pycolmap.Image,
    point_ids: list[int],
    places: Array,
) -> Array:
    """Return the (P,) distances of (P, 2) places from where an image sees its points.

    A point that is behind the camera has none, and does not count.
    """
    if not point_ids:
        return np.empty(0)
    camera = model.cameras[image.camera_id]
    points = np.array([model.points3D[point_id].xyz for point_id in point_ids])
    seen = camera.img_from_cam(image.cam_from_world() * points)
    errors: Array = np.linalg.norm(np.asarray(seen, np.float64) - places, axis=1)
    return np.where(np.isfinite(errors), errors, 0.0)
