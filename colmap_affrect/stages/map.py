"""Map: models of the verified pairs, into ``sparse/``."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import num_long_tracks, write_model
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.mappers.attempts import map_database, read_models
from colmap_affrect.mappers.base import Mapper, MappingTask
from colmap_affrect.mappers.exact import exact_only
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import Inputs
from colmap_affrect.stages.guide import exact_inliers, guided_counts, verified_inliers
from colmap_affrect.stages.verify import recorded_verification

INPUTS = "inputs.sha256"
"""File in sparse/ that names the verified pairs the models were made from."""


def map_images(
    context: Context, mapper: Mapper, *, overwrite: bool = False
) -> tuple[StageReport, list[ModelSummary]]:
    """Reconstruct; the models are mapped anew only when the verified pairs have changed.

    Args:
        context: with verified pairs.
        mapper: with its options.
        overwrite: discard the models that are there.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    workspace.record_options("map", mapper.options.to_mapping(), overwrite=overwrite)
    inputs = colmap_database.geometry_digest(workspace.database)
    path = workspace.sparse / INPUTS
    if path.exists() and path.read_text() == inputs:
        models = read_models(workspace.sparse)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    task = MappingTask(
        workspace.database,
        Path(Inputs.recorded(workspace).image_path),
        intrinsics_given(workspace),
    )
    num_images = len(colmap_database.image_ids(workspace.database))
    with context.progress.stage("map", num_images, "images") as advance:
        models = map_database(mapper, task, workspace.sparse, advance)
    if guided_counts(context):
        adjust_exactly(context, mapper)
        models = read_models(workspace.sparse)
    replace_text(path, inputs)
    return StageReport("map", time.perf_counter() - start, len(models)), models


def adjust_exactly(context: Context, mapper: Mapper) -> None:
    """Adjust models by exact matches where these suffice; see :mod:`..mappers.exact`."""
    workspace = context.workspace
    exact, verified = exact_inliers(context), verified_inliers(context)
    refine = not (intrinsics_given(workspace) and mapper.options.keep_given_intrinsics)
    for folder in (path for path in workspace.sparse.iterdir() if path.name.isdigit()):
        model = pycolmap.Reconstruction(folder)
        if exact_only(model, exact, verified, refine_intrinsics=refine):
            shutil.rmtree(folder)
            write_model(model, folder)


def intrinsics_given(workspace: Workspace) -> bool:
    """Tell whether the user gave the camera parameters."""
    return bool(Inputs.recorded(workspace).cameras.params)


def num_verified_pairs(workspace: Workspace) -> int:
    """Return the number of pairs with a two-view geometry."""
    min_num_inliers = recorded_verification(workspace).min_num_inliers
    return len(verified_pairs(workspace.database, min_num_inliers))


def unregistered(
    context: Context, names: Sequence[str], models: Sequence[ModelSummary]
) -> dict[str, str]:
    """Tell for each image outside the largest model why it is not in it."""
    workspace = context.workspace
    num_keypoints = context.features.num_keypoints()
    ids = colmap_database.image_ids(workspace.database)
    min_num_inliers = recorded_verification(workspace).min_num_inliers
    verified = verified_pairs(workspace.database, min_num_inliers)
    in_pairs = {image_id for pair in verified for image_id in pair}
    elsewhere = {
        name: f"in another model, sparse/{index}"
        for index, model in reversed(list(enumerate(models)))
        for name in model.registered_names
    }
    registered = set(models[0].registered_names) if models else set()
    reasons = {}
    for name in names:
        if name in registered:
            continue
        if name in elsewhere:
            reasons[name] = elsewhere[name]
        elif name not in num_keypoints or name not in ids:
            reasons[name] = "unreadable"
        elif not num_keypoints[name]:
            reasons[name] = "no features"
        elif ids[name] not in in_pairs:
            reasons[name] = "no verified pair"
        else:
            reasons[name] = "not registered"
    return reasons


def images_in_need(context: Context, min_num_tracks: int) -> set[str]:
    """Return the images that are not in the largest model, or there see few of its points.

    Args:
        context: after mapping.
        min_num_tracks: an image that sees fewer points of three images or more is in need.
    """
    workspace = context.workspace
    names = set(colmap_database.image_ids(workspace.database))
    path = workspace.sparse / "0"
    if not path.exists() or len(names) < 3:
        return names if len(names) > 2 else set()
    counts = num_long_tracks(path)
    return {name for name in names if counts.get(name, 0) < min_num_tracks}
