"""Map: models of the verified pairs, into ``sparse/``."""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import NOTHING
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.model_files import model_folder
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.mappers.mapping import map_database, model_folders, read_summaries
from colmap_affrect.mappers.pair_graph import PairGraph, cameras_of, poses_of
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import unmeasured_pairs

NUM_BEST_PAIRS = 3  # pairs that are named for each image that was not registered


def map_images(
    context: Context,
    mapper: Mapper,
    extend: Extension | None = None,
    *,
    goes_on: bool = False,
    overwrite: bool = False,
) -> tuple[StageReport, list[ModelSummary]]:
    """Reconstruct; only when the verified pairs, or the model that is extended, have changed.

    Images are registered into the model of ``extend``, or else begin anew; ``overwrite`` discards
    the models that are there. AffrectError when the model cannot be extended with these images,
    StoreError when the models that are there extend another one.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    inputs = _inputs(context, extend)
    workspace.record_options("map", mapper.options.to_mapping(), overwrite=overwrite)
    known = "" if workspace.lacks_models() else workspace.made_from("map")
    if known != inputs and " " in known and not extend:
        raise StoreError(
            f"{workspace.sparse}: its model extends another one; give --extend again, or "
            "--overwrite to map from the beginning"
        )
    if known == inputs:
        models = read_summaries(workspace.sparse)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    workspace.refuse_foreign_models()
    known_models = read_summaries(workspace.sparse)  # refuses edited ones
    before = list[MappedModel]()
    is_same = known.partition("+")[2] == inputs.partition("+")[2]  # as it was said by hand
    if goes_on and known_models and is_same:
        for folder, known_model in zip(model_folders(workspace.sparse), known_models, strict=True):
            model = pycolmap.Reconstruction(str(folder))
            before.append(MappedModel(model, known_model.bridges, known_model.moves))
    task = _task(context, extend, before)
    workspace.record_made_from(map="")  # a run that is killed begins anew
    num_images = len(colmap_database.image_ids(workspace.database))
    with context.progress.stage("map", num_images, "images") as advance:
        models = map_database(mapper, task, workspace.sparse, advance)
    workspace.record_mapped(inputs)
    wall_s = time.perf_counter() - start
    return StageReport("map", wall_s, len(models)), models


def _task(context: Context, extend: Extension | None, before: Sequence[MappedModel]) -> MappingTask:
    """Return what there is to map; another program's database has no matches and depths of ours."""
    workspace, by_hand = context.workspace, context.by_hand
    copied, path = workspace.is_foreign, workspace.database
    workspace.mapped_database.unlink(missing_ok=True)
    tie_points: Mapping[str, Mapping[str, int]] = {}
    if by_hand != NOTHING:
        path = workspace.mapped_database
        tie_points = by_hand.copy_database(workspace.database, path)
    return MappingTask(
        path,
        workspace.photographs(),
        read_existing(extend, path) if extend else None,
        before,
        unmeasured=frozenset() if copied else frozenset(unmeasured_pairs(context)),
        cameras=read_camera_records(workspace.cameras),
        may_share=not copied and context.inputs.may_share,
        tie_points=tie_points,
    )


def _inputs(context: Context, extend: Extension | None) -> str:
    """Return digests of what is mapped and, after a space, of the model that is extended."""
    verified = context.verified_digest()
    if not extend:
        return verified
    folder = resolved(model_folder(extend.model_path))
    own = folder.is_relative_to(resolved(context.workspace.sparse))
    return f"{verified} {'own' if own else extend.digest()}"


def agreements(path: Path, model: pycolmap.Reconstruction) -> dict[Pair, float]:
    """Return the share of inliers that agrees with a model by verified pair of a database.

    The strongest pairs of each photograph in the model count, the lower id of the database first.
    """
    graph = PairGraph.read(path, 1)
    ids = {name: image_id for image_id, name in graph.names.items()}  # the model may have others
    same = {i: ids[image.name] for i, image in model.images.items() if image.name in ids}
    poses = {same[i]: pose for i, pose in poses_of(model).items() if i in same}
    cameras = {same[i]: camera for i, camera in cameras_of(model).items() if i in same}
    pairs = graph.pairs_inside(poses)
    shares = {pair.ids: graph.agreement(pair, poses, cameras) for pair in pairs}
    return {(graph.names[one], graph.names[two]): n for (one, two), n in shares.items()}


def image_names(context: Context) -> list[str]:
    """Return the names of the images of a run, or of the database that was copied."""
    if context.workspace.is_foreign:
        context.workspace.require("verify")
        return sorted(colmap_database.image_ids(context.workspace.database))
    return context.inputs.names()


def unregistered(
    context: Context,
    names: Sequence[str],
    models: Sequence[ModelSummary],
    pair_inliers: Mapping[Pair, int],
) -> dict[str, str]:
    """Tell for each image outside the largest model why it is not in it.

    ``pair_inliers`` are the numbers of inliers of the verified pairs.
    """
    num_keypoints = colmap_database.keypoint_counts(context.workspace.database)
    partners: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for (first, second), count in pair_inliers.items():
        partners[first][second] = partners[second][first] = count
    elsewhere = {
        name: f"in another model, sparse/{index}"
        for index, model in reversed(list(enumerate(models)))
        for name in model.registered_names
    }
    registered = set(models[0].registered_names) if models else set()
    taken_out = models[0].taken_out if models else {}
    reasons = {}
    for name in [name for name in names if name not in registered]:
        if name in elsewhere:
            reasons[name] = elsewhere[name]
        elif name in context.by_hand.left_out:
            reasons[name] = "left out by hand"
        elif name not in num_keypoints:
            reasons[name] = "unreadable"
        elif not num_keypoints[name]:
            reasons[name] = "no features"
        elif name not in partners:
            reasons[name] = "no verified pair"
        else:
            best = sorted(partners[name].items(), key=lambda item: -item[1])[:NUM_BEST_PAIRS]
            pairs = ", ".join(f"{other} ({count} inliers)" for other, count in best)
            why = f"taken out, {taken_out[name]}" if name in taken_out else "not registered"
            reasons[name] = f"{why}; verified with {pairs}"
    return reasons
