"""Where up is in the models of runs, by the straight lines of their photographs."""

import logging
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.lines import (
    DOWN,
    FOCALS,
    MIN_EVIDENCE,
    SHIFTS,
    Lines,
    upright_of,
)
from colmap_affrect.geometry.upright import agreed_up, upright_rotation
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.workspace import Workspace

logger = logging.getLogger(__name__)

# Photographs of a model whose lines are read; those of more make it no surer; resource
MAX_NUM_ASKED = 500


@dataclass(frozen=True)
class Upright:
    """Where up is in a model."""

    direction: Floats  # (3,) unit vector in the frame of the model
    names: tuple[str, ...]  # photographs whose lines agree
    num_asked: int  # photographs whose lines say something

    def text(self) -> str:
        """Say whose lines tell."""
        return f"by the lines of {len(self.names)} of {self.num_asked} photographs"


def upright_of_run(model_path: Path, model: pycolmap.Reconstruction) -> Upright | None:
    """Return where up is in a model of a run; None where nobody knows, or its frame was given.

    Args:
        model_path: folder of the model, which lies in that of the run.
        model: its content.
    """
    workspace = Workspace(resolved(model_path).parent.parent)
    if not workspace.features.exists():
        return None
    try:
        mapped = workspace.mapping_record
        # A model that extends another one keeps the frame of that
        if mapped is not None and mapped.extends:
            return None
        return _upright(model, FeatureStore(workspace.features))
    except AffrectError as error:
        logger.warning("%s; so the model is not turned upright", error)
        return None


def turn_upright(model: pycolmap.Reconstruction, upright: Upright) -> None:
    """Turn a model so that its z axis points up, and its y axis where the cameras look."""
    ahead = np.mean([_axes(image)[:, 2] for image in _registered(model)], axis=0)
    rotation = upright_rotation(upright.direction, ahead)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation), np.zeros(3)))


def _upright(model: pycolmap.Reconstruction, features: FeatureStore) -> Upright | None:
    images = _registered(model)
    step = math.ceil(len(images) / MAX_NUM_ASKED)
    asked = images[:: max(1, step)]
    lines_of_images = features.lines_of(image.name for image in asked)
    held = []
    names = []
    directions = []
    for image in images:
        axes = _axes(image)
        lines = lines_of_images.get(image.name)
        down = DOWN if lines is None else lines.down
        held.append(-axes[:, :2] @ np.array(down))
        up = (
            None
            if lines is None
            else _up_in_camera(lines, model.cameras[image.camera_id])
        )
        if up is not None:
            names.append(str(image.name))
            directions.append(axes @ up)
    if not names:
        return None
    found = agreed_up(np.array(directions), np.array(held))
    if found is None:
        return None
    direction, agrees = found
    agreeing = tuple(name for name, does in zip(names, agrees, strict=True) if does)
    return Upright(direction, agreeing, len(names))


def _up_in_camera(lines: Lines, camera: pycolmap.Camera) -> Floats | None:
    """Return the (3,) upright by lines for a camera of a model; None where they say little."""
    if lines.likelihood is None:
        return None
    longer_side = max(camera.width, camera.height)
    focal = camera.mean_focal_length() / longer_side
    shift = (camera.principal_point_y - camera.height / 2.0) / longer_side
    row = int(np.abs(np.log(FOCALS / focal)).argmin())
    column = int(np.abs(SHIFTS - shift).argmin())
    if lines.likelihood.log_likelihoods[row, column] < MIN_EVIDENCE:
        return None
    return upright_of(lines.likelihood.rotations[row, column], lines.down)


def _registered(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the registered images in the order of their ids."""
    return [model.images[image_id] for image_id in sorted(model.reg_image_ids())]


def _axes(image: pycolmap.Image) -> Array:
    """Return the (3, 3) axes of a camera as columns, in the frame of the model."""
    return np.asarray(image.cam_from_world().inverse().rotation.matrix())
