"""Map: models of the verified pairs, into ``sparse/``."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.mappers.attempts import map_database, read_models
from colmap_affrect.mappers.base import Mapper, MappingTask
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import Inputs
from colmap_affrect.stages.verify import recorded_verification

INPUTS = "inputs.sha256"
"""File in sparse/ that names the verified pairs the models were made from."""

NUM_BEST_PAIRS = 3
"""Pairs that are named for each image that was not registered."""

STRONGER_RECIPES = ("on-demand", "affnet-shapes")
"""Advised where photographs are missing; the second needs weights."""


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
    task = MappingTask(
        workspace.database,
        Path(Inputs.recorded(workspace).image_path),
        intrinsics_given(workspace),
    )
    if path.exists() and path.read_text() == inputs:
        models = read_models(workspace.sparse, task)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    num_images = len(colmap_database.image_ids(workspace.database))
    with context.progress.stage("map", num_images, "images") as advance:
        models = map_database(mapper, task, workspace.sparse, advance)
    replace_text(path, inputs)
    return StageReport("map", time.perf_counter() - start, len(models)), models


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
    verified = _verified_by_name(workspace.database, min_num_inliers)
    elsewhere = {
        name: f"in another model, sparse/{index}"
        for index, model in reversed(list(enumerate(models)))
        for name in model.registered_names
    }
    registered = set(models[0].registered_names) if models else set()
    taken_out = models[0].taken_out if models else {}
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
        elif name not in verified:
            reasons[name] = "no verified pair"
        else:
            best = sorted(verified[name].items(), key=lambda item: -item[1])[:NUM_BEST_PAIRS]
            pairs = ", ".join(f"{other} ({count} inliers)" for other, count in best)
            why = f"taken out, {taken_out[name]}" if name in taken_out else "not registered"
            reasons[name] = f"{why}; verified with {pairs}"
    return reasons


def _verified_by_name(database_path: Path, min_num_inliers: int) -> dict[str, dict[str, int]]:
    """Return for each image of a verified pair its partners, and how many inliers they share."""
    names = {image_id: name for name, image_id in colmap_database.image_ids(database_path).items()}
    found: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for pair, count in verified_pairs(database_path, min_num_inliers).items():
        first, second = (names[image_id] for image_id in pair)
        found[first][second] = found[second][first] = count
    return dict(found)


def advice(
    context: Context, missing: Collection[str], models: Sequence[ModelSummary]
) -> tuple[str, ...]:
    """Say what may help when images are missing, best first.

    Args:
        context: of a run that has been mapped.
        missing: images that are not in the largest model.
        models: all models, largest first.
    """
    if not missing:
        return ()
    workspace = context.workspace
    min_num_inliers = recorded_verification(workspace).min_num_inliers
    verified = _verified_by_name(workspace.database, min_num_inliers)
    texts = []
    cameras, inputs = colmap_database.all_cameras(workspace.database), Inputs.recorded(workspace)
    same_size = len({(camera.width, camera.height) for camera in cameras}) == 1
    if len(cameras) > 1 and same_size and not any(c.has_prior_focal_length for c in cameras):
        texts.append("--camera-mode single, if one camera took them: all have the same size")
    others = [name for name in STRONGER_RECIPES if name != workspace.recipe()]
    texts.append(f"another method, --recipe {' or '.join(others)}; compare tries several")
    between = [
        f"{name} and {max(inside, key=lambda other: partners[other])}"
        for name, partners in verified.items()
        if name in missing and (inside := partners.keys() - set(missing))
    ][:NUM_BEST_PAIRS]
    places = f"between {', between '.join(between)}" if between else "that show the missing places"
    texts.append(f"more photographs {places}")
    if models and models[0].doubtful and not (inputs.masks.path or inputs.masks.camera_path):
        texts.append("--mask-path, where something moves, repeats or is written over photographs")
    return tuple(texts)
