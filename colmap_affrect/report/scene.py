"""Cameras and points of a model as a page draws them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import read_given_model
from colmap_affrect.errors import AffrectError, with_flags
from colmap_affrect.geometry.arrays import Array, Floats, Indices
from colmap_affrect.geometry.upright import upright_rotation
from colmap_affrect.report.observations import (
    ModelReader,
    Observations,
    registered_images,
)
from colmap_affrect.report.pictures import base64_text
from colmap_affrect.report.upright import upright_of_run

# What is in the view, and how it is drawn, was chosen by eye.
# That are drawn of a model of few photographs, 9 bytes each, and of many; resource
MAX_NUM_POINTS = 20_000
MAX_NUM_POINTS_OF_MANY = 200_000
NUM_POINTS_OF_PHOTOGRAPH = 500  # with which the page of a larger model grows; resource
# Of a point that is drawn, 6 bytes each; of points beyond that the page does not tell who sees them
OBSERVATIONS_PER_POINT = 2.5
NUM_GRID = 12  # rows and columns of places that radial distortion is fitted to
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
MOST = 65_535  # of a uint16
NO_COLOR = 128  # gray value of all points of a model without colours


@dataclass(frozen=True)
class View3D:
    """A model ready for the page; lengths in units of the radius of the view."""

    num_points: int = 0
    # Base64: (N, 3) uint16 positions from -1 to 1, then (N, 3) uint8 colours
    points: str = ""
    # Names; (5, 3) centre and corners of pyramids
    cameras: tuple[tuple[str, Array], ...] = ()
    # Base64: (N,) uint16 numbers of observations, then their (K,) uint16 rows of ``cameras``, then
    # (K, 2) uint16 places, 65535 at the right and lower border of the photograph
    tracks: str = ""
    looks: tuple[dict[str, Any], ...] = ()  # how each camera sees, for the script
    note: str = ""  # why there is nothing to draw; empty if there is
    # Colours of cameras, by photograph
    kinds: Mapping[str, str] = field(default_factory=dict)

    def script_data(self, index: Mapping[str, int]) -> dict[str, Any]:
        """Return what the script of the page reads, as JSON has it.

        Cameras of photographs that have no number in ``index`` get -1 and are not drawn.
        """
        cameras = []
        for row, (name, corners) in enumerate(self.cameras):
            camera = {
                "index": index.get(name, -1),
                "kind": self.kinds.get(name, ""),
                "corners": corners.round(4).ravel().tolist(),
            }
            if self.looks:
                camera["look"] = self.looks[row]
            cameras.append(camera)
        return {
            "points": self.points,
            "count": self.num_points,
            "tracks": self.tracks,
            "cameras": cameras,
        }


def max_num_points(num_photographs: int) -> int:
    """Return how many points are drawn of a model of some photographs at most."""
    wanted = NUM_POINTS_OF_PHOTOGRAPH * num_photographs
    return min(max(wanted, MAX_NUM_POINTS), MAX_NUM_POINTS_OF_MANY)


def max_num_observations(num_photographs: int) -> int:
    """Return of how many observations a page of some photographs tells at most."""
    return round(OBSERVATIONS_PER_POINT * max_num_points(num_photographs))


def read_view(path: Path | None, kinds: Mapping[str, str]) -> View3D:
    """Read a model and turn it upright; a note says why there is none, or it cannot be read.

    Args:
        path: folder of the model.
        kinds: names of the colours of the cameras, by photograph.

    Returns:
        The view.
    """
    if path is None:
        return View3D(note="There is no model.")
    try:
        model = read_given_model(path)
    except AffrectError as error:
        return _no_view(error)
    _turn_upright(model, path)
    return replace(view_of(model), kinds=kinds)


def read_view_with_tracks(
    reader: ModelReader,
    number: int,
    kinds: Mapping[str, str],
    max_num_observations: int,
) -> View3D:
    """Return a view for a page that looks through its photographs, see :func:`read_view`.

    Args:
        reader: of the models of a run.
        number: of the model.
        kinds: names of the colours of the cameras, by photograph.
        max_num_observations: of points in photographs.

    Returns:
        The view.
    """
    try:
        seen = reader.observations(number)
    except AffrectError as error:
        return _no_view(error)
    model = pycolmap.Reconstruction(reader.model(number))
    _turn_upright(model, reader.path(number))
    cameras = model.cameras.values()
    has_axes = all(len(camera.focal_length_idxs()) for camera in cameras)
    if not has_axes:  # of panoramas, which nobody can look through
        return replace(view_of(model), kinds=kinds)
    return replace(view_of(model, seen, max_num_observations), kinds=kinds)


def _no_view(error: AffrectError) -> View3D:
    return View3D(note=f"The model cannot be shown: {with_flags(error.words)}")


def _turn_upright(model: pycolmap.Reconstruction, path: Path) -> None:
    upright = upright_of_run(path, model)
    fit_upright(model, None if upright is None else upright.direction)


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


def _poses(model: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Return (M, 3, 3) world_from_camera rotations and (M, 3) centres of the registered images."""
    poses = [image.cam_from_world().inverse() for image in registered_images(model)]
    axes = np.array([pose.rotation.matrix() for pose in poses])
    centers = np.array([pose.translation for pose in poses])
    return axes.reshape(-1, 3, 3), centers.reshape(-1, 3)


def view_of(
    model: pycolmap.Reconstruction,
    seen: Observations | None = None,
    max_num_observations: int = 0,
) -> View3D:
    """Return a model that was turned upright as the page has it.

    Args:
        model: inside of a sphere of radius 1 about 0, see :func:`fit_upright`.
        seen: where its photographs see its points, for a page that looks through these.
        max_num_observations: of these that the page has.
    """
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    most = max_num_points(model.num_reg_images())
    if len(ids) > most:
        ids = np.random.default_rng(0).choice(ids, most, replace=False)
    chosen = [model.points3D[point_id] for point_id in ids.tolist()]
    positions = np.array([point.xyz for point in chosen]).reshape(-1, 3)
    colors = np.array([point.color for point in chosen], dtype=np.uint8).reshape(-1, 3)
    is_inside = np.abs(positions).max(axis=1, initial=0.0) <= 1.0
    ids = ids[is_inside]
    positions = positions[is_inside]
    colors = colors[is_inside]
    if not colors.any():
        colors = np.full_like(colors, NO_COLOR)
    visible = (DARKEST + colors.astype(np.float64) / 255 * COLOR_RANGE).astype(np.uint8)
    quantised = np.rint((positions + 1.0) / 2.0 * MOST).astype("<u2")
    view = View3D(
        len(positions),
        base64_text(quantised.tobytes() + visible.tobytes()),
        _pyramids(model),
    )
    if seen is None:
        return view
    tracks = _tracks(model, seen, ids, max_num_observations)
    return replace(view, tracks=tracks, looks=_looks(model))


def _tracks(
    model: pycolmap.Reconstruction,
    seen: Observations,
    ids: Indices,
    max_num_observations: int,
) -> str:
    """Return where photographs see the (N,) points, as ``View3D.tracks``."""
    images = registered_images(model)
    order = np.argsort(ids)
    position = np.searchsorted(ids, seen.point_ids, sorter=order)
    numbers = (
        order[np.minimum(position, max(len(ids) - 1, 0))] if len(ids) else position
    )
    is_drawn = np.isin(seen.point_ids, ids)
    by_point = np.argsort(numbers[is_drawn], kind="stable")
    rows = np.flatnonzero(is_drawn)[by_point]
    counts = np.bincount(numbers[rows], minlength=len(ids))
    counts[np.cumsum(counts) > max_num_observations] = 0
    rows = rows[: counts.sum()]
    cameras = [model.cameras[image.camera_id] for image in images]
    sizes = np.array([(camera.width, camera.height) for camera in cameras])
    shares = seen.places[rows] / sizes.reshape(-1, 2)[seen.rows[rows]]
    places = np.rint(np.clip(shares, 0.0, 1.0) * MOST).astype("<u2")
    photographs = seen.rows[rows].astype("<u2")
    head = counts.astype("<u2").tobytes()
    return base64_text(head + photographs.tobytes() + places.tobytes())


def _looks(model: pycolmap.Reconstruction) -> tuple[dict[str, Any], ...]:
    """Return how each camera sees: pose, focal lengths, axis, size, radial distortion."""
    found = []
    for image in registered_images(model):
        camera = model.cameras[image.camera_id]
        pose = image.cam_from_world()
        focals = [camera.mean_focal_length()] * 2
        if len(camera.focal_length_idxs()) > 1:
            focals = [camera.focal_length_x, camera.focal_length_y]
        axis = [camera.principal_point_x, camera.principal_point_y]
        look = {
            "rotation": pose.rotation.matrix().round(7).ravel().tolist(),
            "center": image.projection_center().round(6).tolist(),
            "focal": np.round(focals, 3).tolist(),
            "axis": np.round(axis, 3).tolist(),
            "size": [camera.width, camera.height],
            "radial": radial_distortion(camera),
        }
        found.append(look)
    return tuple(found)


def radial_distortion(camera: pycolmap.Camera) -> list[float]:
    """Fit two terms of radial distortion to a camera of any model.

    Args:
        camera: of which rays through a grid over the image are asked.

    Returns:
        k1 and k2: a ray at the radius r from the axis, at depth 1, is seen at
        r (1 + k1 r^2 + k2 r^4).
    """
    across = np.linspace(0.0, camera.width, NUM_GRID)
    down = np.linspace(0.0, camera.height, NUM_GRID)
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    rays = np.asarray(camera.cam_from_img(pixels), dtype=np.float64)
    is_known = np.isfinite(rays).all(axis=1)
    rays = rays[is_known]
    axis = np.array([camera.principal_point_x, camera.principal_point_y])
    focals = np.array([camera.mean_focal_length()] * 2)
    if len(camera.focal_length_idxs()) > 1:
        focals = np.array([camera.focal_length_x, camera.focal_length_y])
    distorted = (pixels[is_known] - axis) / focals
    squared = (rays**2).sum(axis=1, keepdims=True)
    terms = np.stack([rays * squared, rays * squared**2], axis=-1).reshape(-1, 2)
    found = np.linalg.lstsq(terms, (distorted - rays).ravel(), rcond=None)[0]
    k1, k2 = found.tolist()
    return [round(k1, 6), round(k2, 6)]


def _pyramids(model: pycolmap.Reconstruction) -> tuple[tuple[str, Array], ...]:
    """Return the name and the (5, 3) centre and corners of the view of each camera."""
    images = registered_images(model)
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
