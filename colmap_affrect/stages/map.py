"""Map: models of the verified pairs, into ``sparse/``."""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.by_hand import NOTHING
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database_verification import verify
from colmap_affrect.colmap.model_files import model_folder
from colmap_affrect.errors import ConflictError, Option
from colmap_affrect.geometry.lines import SHIFTED_SIGMA, LineCamera
from colmap_affrect.mappers.base import MappedModel, Mapper, MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.mappers.mapping import map_database, read_models, read_summaries
from colmap_affrect.mappers.pair_graph import PairGraph, cameras_of, poses_of
from colmap_affrect.mappers.wrong_models import ThrownAway, read_thrown_away
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.reasons import Missing
from colmap_affrect.project.record import OWN, ModelInputs
from colmap_affrect.project.report import NO_MODEL, ModelSummary
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.session.context import Context
from colmap_affrect.session.view_graph import ViewGraph
from colmap_affrect.stages.verify import extracted_px

# Pairs that are named for each image that was not registered; display
NUM_BEST_PAIRS = 3


def map_images(
    context: Context,
    mapper: Mapper,
    extend: Extension | None = None,
    *,
    begins_with_models: bool = False,
    overwrite: bool = False,
) -> tuple[StageReport, list[ModelSummary]]:
    """Reconstruct; only when the verified pairs, or the model that is extended, have changed.

    Args:
        context: of the workspace, whose pairs are verified.
        mapper: what makes models.
        extend: the model that images are registered into; None: models begin anew.
        begins_with_models: models begin with those that are there.
        overwrite: discard the models that are there.

    Returns:
        What was done, and the summaries of the models.

    Raises:
        AffrectError: the model cannot be extended with these images.
        StoreError: the models that are there extend another one.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    inputs = _inputs(context, extend)
    workspace.record_options("map", mapper.options.to_mapping(), overwrite=overwrite)
    known = None if workspace.lacks_models() else workspace.model_inputs()
    if known and known != inputs and known.extends and not extend:
        raise ConflictError(
            "its model extends another one",
            where=workspace.sparse,
            advice=(
                "give ",
                Option("extend"),
                " again, or ",
                Option("overwrite"),
                " to map from the beginning",
            ),
        )
    if known == inputs:
        models = read_summaries(workspace.sparse)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    workspace.refuse_foreign_models()
    read_summaries(workspace.sparse)  # refuses edited ones
    said_before = known.by_hand if known else ""
    before = list[MappedModel]()
    if begins_with_models and said_before == inputs.by_hand:
        before = read_models(workspace.sparse)
    context.graph.close()  # mappers open the database, and SQLite's own copy copies it
    task = _task(context, extend, before)
    workspace.record_mapping(None)  # a run that is killed begins anew
    with context.progress.stage("map", len(context.graph.ids), "images") as advance:
        models = map_database(mapper, task, workspace.sparse, advance)
    workspace.record_mapping(inputs)
    wall_s = time.perf_counter() - start
    return StageReport("map", wall_s, len(models)), models


def _task(
    context: Context, extend: Extension | None, before: Sequence[MappedModel]
) -> MappingTask:
    """Return what is mapped, and make its database; that of others has no matches of ours."""
    workspace = context.workspace
    copied = workspace.is_foreign
    path, tie_points = _make_mapped_database(context)
    unmeasured = [] if copied else unmeasured_pairs(context)
    return MappingTask(
        database_path=path,
        image_path=workspace.photographs(),
        extend=read_existing(extend, path) if extend else None,
        previous_models=before,
        unmeasured_pairs=frozenset(unmeasured),
        cameras=read_camera_records(workspace.cameras),
        lines={} if copied else line_cameras(context),
        may_share=not copied and context.inputs.may_share,
        tie_points=tie_points,
    )


def _make_mapped_database(
    context: Context,
) -> tuple[Path, Mapping[str, Mapping[str, int]]]:
    """Make the database that is mapped, a copy where somebody has changed something by hand.

    Returns:
        Its path, and the keypoints of tie points: indices by point and image name.
    """
    workspace = context.workspace
    by_hand = context.by_hand
    workspace.mapped_database.unlink(missing_ok=True)
    if by_hand == NOTHING:
        return workspace.database, {}
    path = workspace.mapped_database
    tie_points = by_hand.copy_database(workspace.database, path)
    if by_hand.masks_path:  # pairs that lost matches have no geometry any more
        sizes_px = None if workspace.is_foreign else extracted_px(context)
        verify(path, context.verification, sizes_px)
    return path, tie_points


def line_cameras(context: Context) -> dict[str, LineCamera]:
    """Return what the straight lines of photographs say of their cameras, by image name.

    None of photographs whose focal length the user gives, nor of those that have hardly any lines.
    Optical axes of crops may be anywhere, whatever the lines say of that.
    """
    not_given = list[str]()
    crops = list[str]()
    for record in read_camera_records(context.workspace.cameras).values():
        if record.source != "given":
            not_given.extend(record.names)
        if record.uncropped_px:
            crops.extend(record.names)
    cameras = dict[str, LineCamera | None]()
    findings = context.features.line_findings() if not_given else {}
    for name in sorted(findings.keys() & not_given):
        cameras[name] = findings[name].camera
    for name, lines in context.features.lines_of(crops).items():
        cameras[name] = lines.camera(SHIFTED_SIGMA)
    return {name: camera for name, camera in cameras.items() if camera}


def unmeasured_pairs(context: Context) -> list[Pair]:
    """Return the pairs whose matches are of local affine frames that were not measured.

    There are none where no level of the recipe measures frames.
    """
    is_measured = [level.features.has_shapes for level in context.extraction.levels]
    if not any(is_measured):
        return []
    pairs = context.usable(context.listed_pairs())
    levels = context.matches.levels(pairs)
    return [pair for pair, level in levels.items() if not is_measured[level]]


def _inputs(context: Context, extend: Extension | None) -> ModelInputs:
    """Return what is mapped, and of which model that is extended."""
    if not extend:
        return context.current_model_inputs()
    folder = resolved(model_folder(extend.model_path))
    own = folder.is_relative_to(resolved(context.workspace.sparse))
    return context.current_model_inputs(OWN if own else extend.digest())


def agreements(
    verified: ViewGraph, model: pycolmap.Reconstruction
) -> dict[Pair, float]:
    """Return the share of inliers that agrees with a model by verified pair of a database.

    The strongest pairs of each photograph in the model count, the lower id of the database first.
    """
    with verified.open_to_read() as database:
        graph = PairGraph.of(database, 1)
    # The model may have other ids than the database.
    model_ids = {image.name: image_id for image_id, image in model.images.items()}
    model_poses = poses_of(model)
    model_cameras = cameras_of(model)
    poses = {}
    cameras = {}
    for image_id, name in graph.names.items():
        model_id = model_ids.get(name)
        if model_id in model_poses:
            poses[image_id] = model_poses[model_id]
            cameras[image_id] = model_cameras[model_id]
    found = dict[Pair, float]()
    for pair in graph.pairs_inside(poses):
        first, second = pair.ids
        names = (graph.names[first], graph.names[second])
        found[names] = graph.agreement(pair, poses, cameras)
    return found


def image_names(context: Context) -> list[str]:
    """Return the names of the images of a run, or of the database that was copied."""
    if context.workspace.is_foreign:
        context.workspace.require("verify")
        return sorted(context.graph.ids)
    return context.inputs.names()


def unregistered(
    context: Context,
    names: Sequence[str],
    models: Sequence[ModelSummary],
    pair_inliers: Mapping[Pair, int],
) -> dict[str, Missing]:
    """Tell for each image outside the largest model why it is not in it.

    Args:
        context: of the workspace.
        names: of all images.
        models: the largest first.
        pair_inliers: the numbers of inliers of the verified pairs.

    Returns:
        Reasons by image name.
    """
    partners: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for (first, second), count in pair_inliers.items():
        partners[first][second] = count
        partners[second][first] = count
    largest = models[0] if models else NO_MODEL
    registered = set(largest.registered_names)
    thrown_away = read_thrown_away(context.workspace.sparse)
    reasons = dict[str, Missing]()
    for name in names:
        if name in registered:
            continue
        why = _why_not_mapped(context, name, models, partners)
        reasons[name] = why or _why_lost(name, partners[name], largest, thrown_away)
    return reasons


def _why_not_mapped(
    context: Context,
    name: str,
    models: Sequence[ModelSummary],
    partners: Mapping[str, Mapping[str, int]],
) -> Missing | None:
    """Return why an image could not be in the largest model; None where it could.

    Args:
        context: of the workspace.
        name: of the image.
        models: the largest first.
        partners: inliers of verified pairs, by both images.
    """
    for number, model in enumerate(models[1:], start=1):
        if name not in model.registered_names:
            continue
        if name in models[0].taken_out:
            doubts = models[0].taken_out[name]
            return Missing("another_place", number, doubts=doubts)
        tied = set[str]()
        for inside in model.registered_names:
            tied |= partners.get(inside, {}).keys()
        is_apart = tied <= {*model.registered_names}
        return Missing("another_group" if is_apart else "another_model", number)
    if name in context.by_hand.left_out:
        return Missing("left_out")
    num_keypoints = context.graph.num_keypoints
    if name not in num_keypoints:
        return Missing("unreadable")
    return None if num_keypoints[name] else Missing("no_features")


def _why_lost(
    name: str,
    partners: Mapping[str, int],
    largest: ModelSummary,
    thrown_away: ThrownAway,
) -> Missing:
    """Return why an image with features is not in the largest model, by its verified pairs.

    Args:
        name: of the image.
        partners: inliers of its verified pairs, by the other image.
        largest: the largest model.
        thrown_away: what is known of models that were not kept.
    """
    if not partners:
        return Missing("no_verified_pair")
    best = dict(sorted(partners.items(), key=lambda item: -item[1])[:NUM_BEST_PAIRS])
    if name in thrown_away.doubts:
        doubts = thrown_away.doubts[name]
        return Missing("wrong_model", partners=best, doubts=doubts)
    if name in largest.taken_out:
        return Missing("taken_out", partners=best, doubts=largest.taken_out[name])
    return Missing("not_registered", partners=best)
