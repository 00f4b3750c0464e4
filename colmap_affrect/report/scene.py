"""Cameras and points of a model as a page draws them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.upright import upright_rotation
from colmap_affrect.report.pictures import base64_text
from colmap_affrect.report.upright import upright_of_run

# What is in the view, and how it is drawn, was chosen by eye.
MAX_NUM_POINTS = 20_000  # that are drawn of a model; a page stays below some MB
# Share of the points, by distance from their median, that is in the view
POINT_PERCENTILE = 90.0
# Radius of the view per distance of the farthest camera or point from it
RADIUS_MARGIN = 1.15
# Length of the mean up vector that gives one; cameras held in all ways: none
MIN_COMMON_UP = 1e-6
# Depth of the pyramids that stand for cameras, in radii of the view
CAMERA_DEPTH = 0.07
# Half width of a pyramid per depth; wider cameras would hide the model
MAX_HALF_WIDTH = 0.8
# Gray value of black points: colours have to show on light and on dark ground
DARKEST = 60
COLOR_RANGE = 140  # gray value of white points less that of black ones
NO_COLOR = 128  # gray value of all points of a model without colours


@dataclass(frozen=True)
class View3D:
    """A model ready for the page; lengths in units of the radius of the view."""

    num_points: int = 0
    points: str = (
        ""  # base64: (N, 3) uint16 positions from -1 to 1, then (N, 3) uint8 colours
    )
    cameras: tuple[
        tuple[str, Array], ...
    ] = ()  # names; (5, 3) centre and corners of pyramids
    note: str = ""  # why there is nothing to draw; empty if there is
    kinds: Mapping[str, str] = field(
        default_factory=dict
    )  # colours of cameras, by photograph

    def script_data(self, index: Mapping[str, int]) -> dict[str, Any]:
        """Return what the script of the page reads, as JSON has it.

        Cameras of photographs that have no number in ``index`` are left out.
        """
        cameras = []
        for name, corners in self.cameras:
            if name in index:
                camera = {
                    "index": index[name],
                    "kind": self.kinds[name],
                    "corners": corners.round(4).ravel().tolist(),
                }
                cameras.append(camera)
        return {"points": self.points, "count": self.num_points, "cameras": cameras}


def read_view(path: Path | None, kinds: Mapping[str, str]) -> View3D:
    """Read a model and turn it upright; a note says why there is none, or it cannot be read.

    ``kinds`` are the names of the colours of the cameras, by photograph.
    """
    if path is None:
        return View3D(note="There is no model.")
    try:
        model = read_given_model(path)
    except AffrectError as error:
        return View3D(note=f"The model cannot be shown: {error}")
    upright = upright_of_run(path, model)
    fit_upright(model, None if upright is None else upright.direction)
    return replace(_view(model), kinds=kinds)


def fit_upright(model: pycolmap.Reconstruction, up: Floats | None = None) -> None:
    """Move a model into a sphere of radius 1 about 0.

    Its z axis points up, and its y axis where the cameras look.

    Args:
        model: that is changed.
        up: (3,) unit vector; None: as cameras are held on average.
    """
    axes, centers = _poses(model)
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    rotation = _upright_from_world(axes, up)
    inner = points
    if len(points):  # the farthest are often wrong
        distances = np.linalg.norm(points - np.median(points, axis=0), axis=1)
        inner = points[distances <= np.percentile(distances, POINT_PERCENTILE)]
    shown = np.concatenate([inner, centers]) @ rotation.T
    middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
    farthest = float(np.linalg.norm(shown - middle, axis=1).max())
    radius = RADIUS_MARGIN * max(farthest, 1e-9)
    model.transform(
        pycolmap.Sim3d(1 / radius, pycolmap.Rotation3d(rotation), -middle / radius)
    )


def _upright_from_world(axes: Array, up: Floats | None) -> Floats:
    """Return a (3, 3) rotation, of (M, 3, 3) world_from_camera rotations and (3,) up, if known."""
    if up is None:
        up = -axes[:, :, 1].mean(axis=0)  # y of a camera points down
        if np.linalg.norm(up) < MIN_COMMON_UP:
            up = -axes[0, :, 1]
        up = up / np.linalg.norm(up)
    return upright_rotation(up, axes[:, :, 2].mean(axis=0))


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the registered images in the order of their ids."""
    return [model.images[image_id] for image_id in sorted(model.reg_image_ids())]


def _poses(model: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Return (M, 3, 3) world_from_camera rotations and (M, 3) centres of the registered images."""
    poses = [image.cam_from_world().inverse() for image in _registered(model)]
    axes = np.array([pose.rotation.matrix() for pose in poses])
    centers = np.array([pose.translation for pose in poses])
    return axes.reshape(-1, 3, 3), centers.reshape(-1, 3)


def _view(model: pycolmap.Reconstruction) -> View3D:
    """Return a model that was turned upright as the page has it."""
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    if len(ids) > MAX_NUM_POINTS:
        ids = np.random.default_rng(0).choice(ids, MAX_NUM_POINTS, replace=False)
    chosen = [model.points3D[point_id] for point_id in ids.tolist()]
    positions = np.array([point.xyz for point in chosen]).reshape(-1, 3)
    colors = np.array([point.color for point in chosen], dtype=np.uint8).reshape(-1, 3)
    is_inside = np.abs(positions).max(axis=1, initial=0.0) <= 1.0
    positions = positions[is_inside]
    colors = colors[is_inside]
    if not colors.any():
        colors = np.full_like(colors, NO_COLOR)
    visible = (DARKEST + colors.astype(np.float64) / 255 * COLOR_RANGE).astype(np.uint8)
    quantised = np.rint((positions + 1.0) / 2.0 * np.iinfo(np.uint16).max).astype("<u2")
    return View3D(
        len(positions),
        base64_text(quantised.tobytes() + visible.tobytes()),
        _pyramids(model),
    )


def _pyramids(model: pycolmap.Reconstruction) -> tuple[tuple[str, Array], ...]:
    """Return the name and the (5, 3) centre and corners of the view of each camera."""
    images = _registered(model)
    corners = np.ones((len(images), 4, 3))
    for number, image in enumerate(images):
        camera = model.cameras[image.camera_id]
        half = np.array([camera.width, camera.height]) / camera.mean_focal_length() / 2
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        corners[number, :, :2] = signs * np.minimum(half, MAX_HALF_WIDTH)
    axes, centers = _poses(model)
    turned = np.einsum("mab,mcb->mca", axes, corners * CAMERA_DEPTH)
    pyramids = np.concatenate([centers[:, None], centers[:, None] + turned], axis=1)
    return tuple(zip([image.name for image in images], pyramids, strict=True))
