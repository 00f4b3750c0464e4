"""Cameras and points of a model, to be drawn in a page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.report.pictures import base64_text

MAX_NUM_POINTS = 20_000  # that are drawn of a model
POINT_PERCENTILE = 90.0  # share of the points, from the middle outwards, that the view holds
RADIUS_MARGIN = 1.15
MIN_COMMON_DIRECTION = 0.3  # length of the mean horizontal viewing direction that gives a front
CAMERA_DEPTH = 0.07  # depth of the pyramids that stand for cameras, as a share of the view's radius
MAX_HALF_WIDTH = 0.8  # of the base of a pyramid per depth, for cameras with a very wide view
DARKEST, COLOR_RANGE = 60, 140  # colours of points are squeezed to show on light and on dark ground


@dataclass(frozen=True)
class View3D:
    """A model ready for the page; lengths in units of the view's radius."""

    num_points: int = 0
    points: str = ""  # base64: (N, 3) uint16 positions from -1 to 1, then (N, 3) uint8 colours
    cameras: tuple[tuple[str, Array], ...] = ()  # names; (5, 3) centre and corners of pyramids
    note: str = ""  # why there is nothing to draw; empty if there is

    def script_data(self, index: Mapping[str, int], kinds: Mapping[str, str]) -> dict[str, Any]:
        """Return what the page's script reads; ``kinds`` are names of colours by photograph."""
        cameras = [
            {
                "index": index[name],
                "kind": kinds[name],
                "corners": corners.round(4).ravel().tolist(),
            }
            for name, corners in self.cameras
            if name in index
        ]
        return {"points": self.points, "count": self.num_points, "cameras": cameras}


def read_view(path: Path | None) -> View3D:
    """Read a model, turned upright; without one, or where it cannot be read, a note says so."""
    if path is None:
        return View3D(note="There is no model.")
    try:
        model = read_given_model(path)
    except AffrectError as error:
        return View3D(note=f"The model cannot be shown: {error}")
    _turn_upright(model)
    return _view(model)


def _turn_upright(model: pycolmap.Reconstruction) -> None:
    """Turn z up, as cameras are held on average, and y where they look; radius 1 about 0."""
    axes, centers = _poses(model)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    up = -axes[:, :, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-6:
        up = -axes[0, :, 1]
    up /= np.linalg.norm(up)
    along = np.cross(axes[:, :, 2].mean(axis=0), up)
    if np.linalg.norm(along) < MIN_COMMON_DIRECTION:  # they look in all directions
        along = np.linalg.svd(up[None])[2][1]
    along /= np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up])
    spread = np.linalg.norm(points - np.median(points, axis=0), axis=1) if len(points) else []
    inner = points[spread <= np.percentile(spread, POINT_PERCENTILE)] if len(points) else points
    held = np.concatenate([inner, centers]) @ rotation.T
    middle = (held.min(axis=0) + held.max(axis=0)) / 2
    radius = RADIUS_MARGIN * max(float(np.linalg.norm(held - middle, axis=1).max()), 1e-9)
    model.transform(pycolmap.Sim3d(1 / radius, pycolmap.Rotation3d(rotation), -middle / radius))


def _poses(model: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Return (M, 3, 3) world_from_camera rotations and (M, 3) centres of the registered images."""
    poses = [model.images[i].cam_from_world().inverse() for i in sorted(model.reg_image_ids())]
    axes = np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3)
    return axes, np.array([pose.translation for pose in poses]).reshape(-1, 3)


def _view(model: pycolmap.Reconstruction) -> View3D:
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    if len(ids) > MAX_NUM_POINTS:
        ids = np.random.default_rng(0).choice(ids, MAX_NUM_POINTS, replace=False)
    chosen = [model.points3D[point_id] for point_id in ids.tolist()]
    points = np.array([point.xyz for point in chosen]).reshape(-1, 3)
    colors = np.array([point.color for point in chosen], dtype=np.uint8).reshape(-1, 3)
    inside = np.abs(points).max(axis=1, initial=0.0) <= 1.0
    points, colors = points[inside], colors[inside]
    if not colors.any():
        colors = np.full_like(colors, 128)
    colors = (DARKEST + colors.astype(np.float64) / 255 * COLOR_RANGE).astype(np.uint8)
    quantised = np.rint((points + 1.0) / 2.0 * np.iinfo(np.uint16).max).astype("<u2")
    names = [model.images[image_id].name for image_id in sorted(model.reg_image_ids())]
    return View3D(
        len(points),
        base64_text(quantised.tobytes() + colors.tobytes()),
        tuple(zip(names, _pyramids(model), strict=True)),
    )


def _pyramids(model: pycolmap.Reconstruction) -> Array:
    """Return the (M, 5, 3) centre and corners of the view of each camera."""
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    cameras = [model.cameras[image.camera_id] for image in images]
    half = np.array([np.array([c.width, c.height]) / c.mean_focal_length() / 2 for c in cameras])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.ones((len(half), 4, 3))
    corners[:, :, :2] = signs * np.minimum(half, MAX_HALF_WIDTH)[:, None]
    axes, centers = _poses(model)
    turned = np.einsum("mab,mcb->mca", axes, corners * CAMERA_DEPTH)
    return np.concatenate([centers[:, None], centers[:, None] + turned], axis=1)
