"""Map: models of the verified pairs, into ``sparse/``."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shutil import rmtree

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.mappers.attempts import LARGE_MODEL, map_database, read_models
from colmap_affrect.mappers.base import Mapper, MappingTask
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import first_level_database
from colmap_affrect.stages.extract import Inputs
from colmap_affrect.stages.pair_graph import connected_parts
from colmap_affrect.stages.verify import recorded_verification

logger = logging.getLogger(__name__)

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
    if _num_registered(models) < min(num_images, LARGE_MODEL):
        models = _or_first_level(context, mapper, task, models)
    replace_text(path, inputs)
    return StageReport("map", time.perf_counter() - start, len(models)), models


def _or_first_level(
    context: Context, mapper: Mapper, task: MappingTask, models: list[ModelSummary]
) -> list[ModelSummary]:
    """Keep the models of the pairs as they were before they climbed, where those have more images.

    So escalation never loses an image.
    """
    min_num_inliers = recorded_verification(context.workspace).min_num_inliers
    with first_level_database(context) as path:
        parts = connected_parts(verified_pairs(path, min_num_inliers)) if path else []
        if path is None or max(map(len, parts), default=0) <= _num_registered(models):
            return models
        sparse = path.with_name("sparse")
        firsts = map_database(mapper, replace(task, database_path=path), sparse, _ignore)
        if _num_registered(firsts) <= _num_registered(models):
            return models
        logger.info("the model of the pairs before they climbed has more images and is kept")
        rmtree(context.workspace.sparse)
        sparse.rename(context.workspace.sparse)
    return firsts


def _num_registered(models: Sequence[ModelSummary]) -> int:
    return len(models[0].registered_names) if models else 0


def _ignore(_: int) -> None:
    pass


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
