"""Cameras of one model as those of another, which other programs can read."""

from collections.abc import Callable

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import known_model
from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.geometry.arrays import Array

GRID = 41  # pixels on a side of an image that are compared; resource
MAX_STEPS = 50  # resource
STEP = 1e-6  # of numeric derivatives, of what a parameter has, or of 1
# Relative change of the errors from which on nothing gets better; numeric
SMALL = 1e-10
MAX_DAMPING = 1e12  # numeric


def with_camera_model(model: pycolmap.Reconstruction, name: str) -> dict[int, float]:
    """Give all cameras of a reconstruction another model, fitted to what they do.

    Args:
        model: the reconstruction, which is changed.
        name: of the camera model, as COLMAP has it.

    Returns:
        The largest distance in px at which any point of an image lands elsewhere, by the id of
        those cameras that had another model.

    Raises:
        OptionError: for a model that is none, or that fits no camera.
    """
    try:
        known_model(name)
    except ValueError as error:
        raise OptionError(Option("camera-model", error)) from error
    differences = {}
    for camera_id, camera in sorted(model.cameras.items()):
        if camera.model_name == name:
            continue
        fitted, difference_px = fitted_camera(camera, name)
        differences[camera_id] = difference_px
        camera.model = fitted.model
        camera.params = fitted.params.tolist()
    return differences


def fitted_camera(camera: pycolmap.Camera, name: str) -> tuple[pycolmap.Camera, float]:
    """Return a camera of another model that does the same, and by how much it fails to.

    Args:
        camera: any camera.
        name: of the camera model.

    Returns:
        The camera, with the id and size of the given one, and the largest distance in px of what
        the two make of one ray, on a grid over the whole image.

    Raises:
        AffrectError: where no point of the image has a ray.
    """
    pixels, rays = _grid(camera)
    focal_px = float(camera.mean_focal_length())
    size = camera.width, camera.height
    fitted = pycolmap.Camera.create_from_model_name(
        camera.camera_id, name, focal_px, *size
    )
    fitted.has_prior_focal_length = camera.has_prior_focal_length
    fitted.principal_point_x = camera.principal_point_x
    fitted.principal_point_y = camera.principal_point_y

    def errors(params: Array) -> Array:
        fitted.params = params.tolist()
        found = np.asarray(fitted.img_from_cam(rays), np.float64) - pixels
        return np.where(np.isfinite(found), found, max(size)).ravel()

    best = _least_squares(errors, fitted.params.copy())
    distances = np.linalg.norm(errors(best).reshape(-1, 2), axis=1)
    return fitted, float(distances.max())


def _grid(camera: pycolmap.Camera) -> tuple[Array, Array]:
    """Return (N, 2) px all over an image, and their rays as (N, 3) points at depth 1."""
    columns = np.linspace(0.0, camera.width, GRID)
    rows = np.linspace(0.0, camera.height, GRID)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    flat = np.asarray(camera.cam_from_img(pixels), np.float64)
    has_ray = np.isfinite(flat).all(axis=1)
    if not has_ray.any():
        raise AffrectError(
            "no point of its images has a ray", where=f"camera {camera.camera_id}"
        )
    flat = flat[has_ray]
    return pixels[has_ray], np.column_stack([flat, np.ones(len(flat))])


def _least_squares(errors: Callable[[Array], Array], params: Array) -> Array:
    """Return the parameters with the least sum of squares, by Levenberg and Marquardt."""
    damping = 1e-3
    current = errors(params)
    cost = float(current @ current)
    for _ in range(MAX_STEPS):
        jacobian = _derivatives(errors, params, current)
        normal = jacobian.T @ jacobian
        gradient = jacobian.T @ current
        scales = np.diag(np.maximum(np.diag(normal), 1e-12))
        before = cost
        while damping < MAX_DAMPING:
            trial = params - np.linalg.solve(normal + damping * scales, gradient)
            found = errors(trial)
            if float(found @ found) < cost:
                params = trial
                current = found
                cost = float(found @ found)
                damping /= 10
                break
            damping *= 10
        if before - cost <= SMALL * cost:
            break
    return params


def _derivatives(
    errors: Callable[[Array], Array], params: Array, current: Array
) -> Array:
    columns = []
    for index, value in enumerate(params):
        step = STEP * max(1.0, abs(value))
        moved = params.copy()
        moved[index] += step
        columns.append((errors(moved) - current) / step)
    return np.stack(columns, axis=1)
