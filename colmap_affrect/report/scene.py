"""Cameras and points of models, in one frame, to be drawn in a page."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from colmap_affrect.colmap.model_files import read_model
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Array, Bytes
from colmap_affrect.report.pictures import base64_text

MAX_NUM_POINTS, MAX_NUM_POINTS_OF_PAGE = 20_000, 40_000  # of a model, and of all that are on a page
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
    # (N, 3) uint16 positions from -1 to 1 and then (N, 3) uint8 colours, as base64
    points: str = ""
    # name and (5, 3) centre and corners of the pyramid of each camera
    cameras: tuple[tuple[str, Array], ...] = ()
    note: str = ""  # what is special about it; empty if nothing is

    def script_data(self, index: Mapping[str, int], kinds: Mapping[str, str]) -> dict[str, Any]:
        """Return what the script of the page reads.

        ``index`` is that of the photographs on the page, ``kinds`` the names of the colours that
        the style has for their cameras.
        """
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


@dataclass(frozen=True)
class Model:
    """A model as arrays."""

    names: tuple[str, ...]
    centers: Array  # (M, 3) of the cameras
    axes: Array  # (M, 3, 3) rotations world_from_camera
    half_sizes: Array  # (M, 2) half width and height of the view at depth 1
    points: Array  # (N, 3)
    colors: Bytes  # (N, 3)

    def transformed(self, scale: float, rotation: Array, translation: Array) -> Self:
        """Return it after x -> scale rotation x + translation."""
        return replace(
            self,
            centers=scale * self.centers @ rotation.T + translation,
            axes=rotation @ self.axes,
            points=scale * self.points @ rotation.T + translation,
        )


def read_scene(paths: Mapping[str, Path | None]) -> list[View3D]:
    """Read models, bring them into the frame of the largest, and prepare them for the page.

    ``paths`` are the folders by the names that the page has for the models; None for no model.
    """
    models, notes = read_models(paths)
    views = {name: _view(model, notes.get(name, "")) for name, model in models.items()}
    return [views.get(name) or View3D(note=notes[name]) for name in paths]


def read_models(paths: Mapping[str, Path | None]) -> tuple[dict[str, Model], dict[str, str]]:
    """Read models and bring them into the frame of the largest.

    Returns the models, and what is special about them or why they are missing, by name.
    """
    models: dict[str, Model] = {}
    notes = {name: "There is no model." for name, path in paths.items() if path is None}
    max_num_points = min(MAX_NUM_POINTS, MAX_NUM_POINTS_OF_PAGE // max(1, len(paths)))
    for name, path in paths.items():
        try:
            if path is not None:
                models[name] = _read(path, max_num_points)
        except AffrectError as error:
            notes[name] = f"The model cannot be shown: {error}"
    return (_in_one_frame(models, notes) if models else {}), notes


def _read(path: Path, max_num_points: int) -> Model:
    model = read_model(path)
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    cameras = [model.cameras[image.camera_id] for image in images]
    ids = np.array(sorted(model.point3D_ids()), dtype=np.int64)
    if len(ids) > max_num_points:
        ids = np.random.default_rng(0).choice(ids, max_num_points, replace=False)
    points = [model.points3D[point_id] for point_id in ids.tolist()]
    return Model(
        tuple(image.name for image in images),
        np.array([image.projection_center() for image in images]).reshape(-1, 3),
        np.array([image.cam_from_world().rotation.matrix().T for image in images]),
        np.array([np.array([c.width, c.height]) / c.mean_focal_length() / 2 for c in cameras]),
        np.array([point.xyz for point in points]).reshape(-1, 3),
        np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3),
    )


def _in_one_frame(models: Mapping[str, Model], notes: dict[str, str]) -> dict[str, Model]:
    """Align models with the largest, turn what is up upwards, and scale the view to radius 1."""
    reference = max(models, key=lambda name: len(models[name].names))
    upright = _upright(models[reference])
    framed = {}
    for name, model in models.items():
        if name == reference:
            framed[name] = upright
        elif similarity := similarity_of(model, upright):
            framed[name] = model.transformed(*similarity)
        else:
            framed[name] = _upright(model)
            notes[name] = (
                f"Shares fewer than two photographs at different places with the model of "
                f"{reference}: drawn in a frame of its own."
            )
    return framed


def similarity_of(source: Model, target: Model) -> tuple[float, Array, Array] | None:
    """Estimate scale, rotation and translation target_from_source from the shared images.

    Medians, so that single misplaced cameras do not matter. None with fewer than two shared
    images at different places.
    """
    shared = [name for name in source.names if name in target.names]
    rows = [source.names.index(name) for name in shared]
    columns = [target.names.index(name) for name in shared]
    if len(shared) < 2:
        return None
    rotations = target.axes[columns] @ np.swapaxes(source.axes[rows], 1, 2)
    agreement = np.einsum("iab,jab->ij", rotations, rotations)
    rotation = rotations[int(np.argmax(np.median(agreement, axis=1)))]
    first, second = np.triu_indices(len(shared), 1)
    centers, goals = source.centers[rows], target.centers[columns]
    lengths = np.linalg.norm(centers[first] - centers[second], axis=1)
    goal_lengths = np.linalg.norm(goals[first] - goals[second], axis=1)
    apart = (lengths > 1e-9) & (goal_lengths > 1e-9)
    if not apart.any():
        return None
    scale = float(np.median(goal_lengths[apart] / lengths[apart]))
    translation = np.median(goals - scale * centers @ rotation.T, axis=0)
    return scale, rotation, translation


def _upright(model: Model) -> Model:
    """Turn a model so that z is up, as cameras are held on average, and y is where they look.

    The middle of cameras and points goes to the origin, and the scale is that of the view.
    """
    up = -model.axes[:, :, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-6:
        up = -model.axes[0, :, 1]
    up /= np.linalg.norm(up)
    along = np.cross(model.axes[:, :, 2].mean(axis=0), up)
    if np.linalg.norm(along) < MIN_COMMON_DIRECTION:  # they look in all directions
        along = np.linalg.svd(up[None])[2][1]
    along /= np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up])
    centers, points = model.centers @ rotation.T, model.points @ rotation.T
    spread = np.linalg.norm(points - np.median(points, axis=0), axis=1) if len(points) else []
    inner = points[spread <= np.percentile(spread, POINT_PERCENTILE)] if len(points) else points
    held = np.concatenate([inner, centers])
    middle = (held.min(axis=0) + held.max(axis=0)) / 2
    radius = RADIUS_MARGIN * max(float(np.linalg.norm(held - middle, axis=1).max()), 1e-9)
    return model.transformed(1 / radius, rotation, -middle / radius)


def _view(model: Model, note: str) -> View3D:
    inside = np.abs(model.points).max(axis=1, initial=0.0) <= 1.0
    points, colors = model.points[inside], model.colors[inside]
    if not colors.any():
        colors = np.full_like(colors, 128)
    colors = (DARKEST + colors.astype(np.float64) / 255 * COLOR_RANGE).astype(np.uint8)
    quantised = np.rint((points + 1.0) / 2.0 * np.iinfo(np.uint16).max).astype("<u2")
    return View3D(
        len(points),
        base64_text(quantised.tobytes() + colors.tobytes()),
        tuple(zip(model.names, _pyramids(model), strict=True)),
        note,
    )


def _pyramids(model: Model) -> Array:
    """Return the (M, 5, 3) centre and corners of the view of each camera."""
    half = np.minimum(model.half_sizes, MAX_HALF_WIDTH)
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    corners = np.ones((len(half), 4, 3))
    corners[:, :, :2] = signs * half[:, None]
    turned = np.einsum("mab,mcb->mca", model.axes, corners * CAMERA_DEPTH)
    return np.concatenate([model.centers[:, None], model.centers[:, None] + turned], axis=1)
