"""Map: models of the verified pairs, into ``sparse/``."""

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.tables import rows_digest
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.errors import StaleStoreError
from colmap_affrect.features.weights import install_hint
from colmap_affrect.features.weights import missing as missing_weights
from colmap_affrect.mappers.base import Mapper, MappingTask
from colmap_affrect.mappers.existing import ExistingModel, Extension, read_existing, require_extends
from colmap_affrect.mappers.mapping import map_database, read_models
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.reliability import FOCAL_CONTRADICTED, FOCAL_UNKNOWN
from colmap_affrect.mappers.summaries import refuse_edited
from colmap_affrect.pairs.base import Pair
from colmap_affrect.project.report import ModelSummary, StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import measured_inliers
from colmap_affrect.stages.guide import inliers_by_guiding
from colmap_affrect.stages.pairs import listed_pairs

logger = logging.getLogger(__name__)

NUM_BEST_PAIRS = 3  # pairs that are named for each image that was not registered
STRONGER_RECIPE, LEARNED_RECIPE = "on-demand", "on-demand-learned"  # advised; one needs weights

TOO_FEW = "more photographs: two that can be read and show the same from two places make a model"
"""Advised where nothing else would help."""


def map_images(
    context: Context,
    mapper: Mapper,
    extend: Extension | None = None,
    *,
    overwrite: bool = False,
) -> tuple[StageReport, list[ModelSummary]]:
    """Reconstruct; only when the verified pairs, or the model that is extended, have changed.

    Images are registered into the model of ``extend``, or else begin anew; ``overwrite`` discards
    the models that are there. MappingError when the model cannot be extended with these images,
    StaleStoreError when the models that are there extend another one.
    """
    start = time.perf_counter()
    workspace = context.workspace
    workspace.require("verify")
    existing = None
    if extend:
        require_extends(mapper.options)
        existing = read_existing(extend, workspace.database)  # it may be discarded now
    inputs = _inputs(workspace, extend)
    workspace.record_options("map", mapper.options.to_mapping(), overwrite=overwrite)
    known = workspace.made_from("map") if workspace.sparse.exists() else ""
    if known != inputs and " " in known and not extend:
        raise StaleStoreError(
            f"{workspace.sparse}: its model extends another one; give --extend again, or "
            "--overwrite to map from the beginning"
        )
    task = _task(context, existing)
    if known == inputs:
        models = read_models(workspace.sparse, task)
        return StageReport("map", time.perf_counter() - start, 0, len(models)), models
    workspace.refuse_foreign_models()
    refuse_edited(workspace.sparse)
    workspace.record_made_from(map="")  # a run that is killed begins anew
    num_images = len(colmap_database.image_ids(workspace.database))
    with context.progress.stage("map", num_images, "images") as advance:
        models = map_database(mapper, task, workspace.sparse, advance)
    warnings = {}
    workspace.record_made_from(map=inputs)
    if extend and existing and existing.num_other_keypoints:
        warnings[str(extend.model_path)] = (
            f"keypoints of {existing.num_other_keypoints} of its {len(existing.names)} images are "
            "not those of the database: poses and cameras kept, points triangulated anew"
        )
    for where, what in warnings.items():
        logger.warning("%s: %s", where, what)
    wall_s = time.perf_counter() - start
    return StageReport("map", wall_s, len(models), warnings=warnings), models


def _task(context: Context, existing: ExistingModel | None) -> MappingTask:
    """Return what there is to map; another program's database has no matches and depths of ours."""
    workspace = context.workspace
    copied = workspace.is_foreign
    return MappingTask(
        workspace.database,
        workspace.photographs(),
        existing,
        guided={} if copied else inliers_by_guiding(context),
        measured={} if copied else measured_inliers(context),
        cameras=read_camera_records(workspace.cameras),
        may_share=not copied and context.inputs.may_share,
    )


def _inputs(workspace: Workspace, extend: Extension | None) -> str:
    """Return the digests of verified pairs and, after a space, of the model that is extended."""
    geometry = rows_digest(workspace.database)
    if not extend:
        return geometry
    own = extend.model_path.resolve().is_relative_to(workspace.sparse.resolve())
    return f"{geometry} {'own' if own else extend.digest()}"


def image_names(workspace: Workspace) -> list[str]:
    """Return the names of the images of a run, or of the database that was copied."""
    if workspace.is_foreign:
        return sorted(colmap_database.image_ids(workspace.database))
    return Context(workspace).inputs.names()


def num_verified_inliers(workspace: Workspace) -> dict[Pair, int]:
    """Return the number of inliers of each verified pair, by the names of its images."""
    ids = colmap_database.image_ids(workspace.database)
    names = {image_id: name for name, image_id in ids.items()}
    pairs = verified_pairs(workspace.database, _min_num_inliers(workspace))
    return {(names[first], names[second]): count for (first, second), count in pairs.items()}


def _min_num_inliers(workspace: Workspace) -> int:
    """Return how many inliers a verified pair has; another program had its own threshold."""
    return 1 if workspace.is_foreign else Context(workspace).verification.min_num_inliers


def unregistered(
    context: Context, names: Sequence[str], models: Sequence[ModelSummary]
) -> dict[str, str]:
    """Tell for each image outside the largest model why it is not in it."""
    workspace = context.workspace
    num_keypoints = colmap_database.keypoint_counts(workspace.database)
    ids = colmap_database.image_ids(workspace.database)
    verified = _verified_by_name(workspace)
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


def _verified_by_name(workspace: Workspace) -> Mapping[str, dict[str, int]]:
    """Return for each image of a verified pair its partners, and how many inliers they share."""
    found: defaultdict[str, dict[str, int]] = defaultdict(dict)
    for (first, second), count in num_verified_inliers(workspace).items():
        found[first][second] = found[second][first] = count
    return found


def advice(
    context: Context, missing: Collection[str], models: Sequence[ModelSummary]
) -> tuple[str, ...]:
    """Say what may help when images are missing or the largest model is doubtful, best first."""
    against = [models[0].doubtful, models[0].taken_out] if models else []
    doubts = "; ".join(why for reasons in against for why in reasons.values())
    if not missing and not doubts:
        return ()
    workspace = context.workspace
    num_keypoints = colmap_database.keypoint_counts(workspace.database)
    if sum(map(bool, num_keypoints.values())) < 2:
        return (TOO_FEW,)
    missing = [name for name in missing if name in num_keypoints]  # nothing helps unreadable ones
    if not missing and not doubts:
        return ()
    recipes = [] if workspace.is_foreign else _other_recipes(context)
    texts = []
    if FOCAL_CONTRADICTED in doubts:
        texts.append("run again without the given focal lengths, or with others: they do not fit")
    if missing:
        texts += recipes
    has_cameras = workspace.is_foreign or Context(workspace).inputs.from_database
    if FOCAL_UNKNOWN in doubts and not has_cameras:
        texts.append(
            "run again with --focal-length-px or --cameras-path, if a camera or its lens is known: "
            "several focal lengths fit"
        )
    if workspace.is_foreign:
        texts.append("run --from-database, with --image-path, makes new features for its images")
    else:
        masks = Context(workspace).inputs.masks
        if not (masks.path or masks.camera_path):
            texts.append(
                "run again with --mask-path, if things move, repeat or are written on the "
                "photographs"
            )
    if doubts and not missing:
        texts += recipes
    if missing:
        texts.append(f"more photographs {_missing_places(workspace, missing)}")
    return tuple(texts)


def _other_recipes(context: Context) -> list[str]:
    recipe, texts = context.workspace.recipe(), []
    if recipe not in (STRONGER_RECIPE, LEARNED_RECIPE):
        texts.append(
            f"run again with --recipe {STRONGER_RECIPE}, which tries more warps where photographs "
            "are missing or weakly connected"
        )
    if recipe != LEARNED_RECIPE:
        weights = load_recipe(LEARNED_RECIPE).weights
        gone = missing_weights(weights, context.resources.weights_path)
        get = f"{install_hint(gone)}colmap-affrect weights fetch {' '.join(weights)}"
        first = f" (first: {get})" if gone else ""
        texts.append(f"run again with --recipe {LEARNED_RECIPE}, if light or age differ{first}")
    return texts


def _missing_places(workspace: Workspace, missing: Collection[str]) -> str:
    """Name what lies beside missing images: the best partners that they have in the model."""
    verified = _verified_by_name(workspace)
    between = [
        f"between {name} and {max(inside, key=lambda other: partners[other])}"
        for name, partners in verified.items()
        if name in missing and (inside := partners.keys() - set(missing))
    ][:NUM_BEST_PAIRS]
    return ", ".join(between) or "that show the missing places"


def contradicting_pairs(context: Context) -> dict[str, int]:
    """Return how many verified pairs of each level of a recipe the largest model contradicts."""
    names = [level.name for level in context.extraction.levels]
    path = context.workspace.sparse / "0"
    if len(names) < 2 or not path.exists():
        return {}
    graph, model = PairGraph.read(context.workspace.database), pycolmap.Reconstruction(path)
    found = {frozenset(graph.names[i] for i in ids) for ids in graph.contradicted(model)}
    pairs = [pair for pair in listed_pairs(context) if frozenset(pair) in found]
    levels = Counter(context.matches.levels(pairs).values())
    return {names[level]: levels[level] for level in sorted(levels)}
