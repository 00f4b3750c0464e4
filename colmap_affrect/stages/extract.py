"""Extract: photographs into ``features.h5``, cameras, images and keypoints into the database."""

import logging
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.camera_records import read_camera_records
from colmap_affrect.colmap.checks import FATAL_FOR_IMAGES, refuse_unusable
from colmap_affrect.colmap.database_copy import copy_without_features
from colmap_affrect.colmap.initial_cameras import import_images, record_cameras
from colmap_affrect.errors import ClusterError, DatabaseError, ImageError, OptionError
from colmap_affrect.features.weights import digests as digests_of
from colmap_affrect.images.photographs import checked_names, left_out, not_named
from colmap_affrect.options import Options
from colmap_affrect.parallel.executor import Threads
from colmap_affrect.project.contents import Contents
from colmap_affrect.project.differences import WEIGHTS
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import ExtractionOptions, Recipe
from colmap_affrect.shown import one_line
from colmap_affrect.stages.changes import (
    forget_changed,
    refuse_changed,
    refuse_other_photographs,
)
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.inputs import Inputs
from colmap_affrect.stages.one_image import (
    ExtractedImage,
    ImageExtractor,
    ImageTask,
    num_images_at_once,
    prepare,
)

logger = logging.getLogger(__name__)


def extract(
    context: Context,
    inputs: Inputs,
    recipe: Recipe,
    *,
    image_names: Sequence[str] = (),
    later: Mapping[str, Options] | None = None,
    overwrite: bool = False,
) -> StageReport:
    """Extract features of all images and put cameras, images and keypoints into the database.

    An image that cannot be read is reported and passed over. One that cannot be rectified, for
    want of a depth map, is extracted as it is, with a warning. The options of later stages are
    put on record too: ``later``, by name, beside those of the recipe. ``image_names`` are looked at
    in the place of a list on record; ``overwrite`` discards what is there, and later stages.
    """
    start = time.perf_counter()
    workspace, folder = context.workspace, Path(inputs.image_path)
    inputs.check()
    workspace.require_own(folder)
    _require_usable_cameras(workspace, inputs)
    names = inputs.names()
    names = checked_names(folder, image_names, "image_names") if image_names else names
    contents, options = Contents(workspace.contents), recipe.extraction
    digests = {name: contents.digest(inputs.files(name, options)) for name in names}
    if overwrite or digests != context.features.contents():  # else they were seen to be good
        inputs.check_names(names)
    whole = inputs.photographs.without_mask(names)
    extractor = prepared_recipe(context, options, names)
    if not overwrite:
        refuse_other_photographs(workspace, inputs.image_path, digests)
    _record(workspace, inputs, recipe, extractor, later or {}, overwrite=overwrite)
    warnings = forget_changed(context, inputs, digests, contents, are_all=not image_names)
    _start_database(workspace)
    done = context.features.complete(names)
    missing = [name for name in names if name not in done]
    _refuse_foreign_features(workspace, missing)
    warnings |= _passed_over(inputs, names, whole, is_list=bool(image_names))
    for kind, what in warnings.items():
        logger.warning("%s: %s", kind, what)
    failures = _extract_missing(context, inputs, extractor, missing, digests, warnings)
    if len(failures) == len(names):
        first = failures[names[0]]
        raise ImageError(
            f"{folder}: none of the {len(names)} images can be used; the first: {first}"
        )
    failures |= write_images_and_keypoints(context)
    new, kept = set(missing) - failures.keys(), done - failures.keys()
    wall_s = time.perf_counter() - start
    return StageReport("extract", wall_s, len(new), len(kept), failures, warnings)


def _passed_over(
    inputs: Inputs, names: Sequence[str], whole: Sequence[str], *, is_list: bool
) -> dict[str, str]:
    """Tell which photographs are left out, and which have no mask."""
    folder, found = Path(inputs.image_path), dict[str, str]()
    if not (inputs.image_list_path or is_list):
        found |= not_named(folder, names) if inputs.from_database else left_out(folder)
    if whole:
        found["masks"] = f"{len(whole)} images have none and are used whole, as {whole[0]} is"
    return found


def _require_usable_cameras(workspace: Workspace, inputs: Inputs) -> None:
    """Refuse cameras of a database that cannot be used before it is on record."""
    path, camera_id = workspace.database, inputs.cameras.existing_camera_id
    if inputs.from_database and not path.exists():
        refuse_unusable(Path(inputs.from_database), FATAL_FOR_IMAGES)
    cameras = colmap_database.all_cameras(path) if camera_id >= 0 and path.exists() else []
    if camera_id >= 0 and all(camera.camera_id != camera_id for camera in cameras):
        raise OptionError(f"existing_camera_id={camera_id}: {path} has no such camera")


def _record(
    workspace: Workspace,
    inputs: Inputs,
    recipe: Recipe,
    extractor: ImageExtractor,
    later: Mapping[str, Options],
    *,
    overwrite: bool,
) -> None:
    weights = digests_of(extractor.weights)
    planned: dict[str, Options] = {"match": recipe.matching, "guide": recipe.guided}
    if recipe.extraction.escalation:
        planned["escalate"] = recipe.escalate
    if recipe.mapping:
        planned["map"] = recipe.mapper_options("sparse")
    planned |= later
    workspace.record_options(
        "extract",
        {**inputs.to_mapping(), **recipe.extraction.to_mapping(), WEIGHTS: weights},
        plan={stage: chosen.to_mapping() for stage, chosen in planned.items()},
        recipe=recipe.name,
        overwrite=overwrite,
    )


def _extract_missing(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor,
    names: Sequence[str],
    digests: Mapping[str, str],
    warnings: dict[str, str],
) -> dict[str, str]:
    """Extract images one by one; return why some cannot be used, and add to the warnings."""
    store = context.features
    failures: dict[str, str] = {}
    faded: list[str] = []
    with context.progress.stage("extract", len(names), "images") as advance:
        images = [(name, 0) for name in names]
        with closing(extract_images(context, inputs, extractor, images)) as found_images:
            for name, found in zip(names, found_images, strict=True):
                if isinstance(found, ImageError):
                    logger.warning("%s", found)
                    failures[name] = str(found)
                else:
                    if not len(found.features):
                        logger.warning("%s: no features (blank or too small?)", name)
                    if found.warning:
                        warnings[name] = found.warning
                    if found.stretched:
                        faded.append(name)
                    store.write(name, found.features, found.image_size, digests[name])
                advance(1)
    if faded:
        warnings["contrast"] = (
            f"is low in {len(faded)} of {len(names)} photographs, such as {one_line(faded[0])}; it "
            "was stretched (--set stretch_contrast=false leaves it as it is)"
        )
        logger.warning("contrast: %s", warnings["contrast"])
    return failures


def prepared_recipe(
    context: Context, options: ExtractionOptions, names: Sequence[str]
) -> ImageExtractor:
    """Prepare a recipe for the images of a workspace, which keeps the depth maps of networks."""
    resources = replace(context.resources, depth_cache_path=context.workspace.depth)
    return prepare(options, resources, names, context.progress)


def extract_images(
    context: Context, inputs: Inputs, extractor: ImageExtractor, images: Sequence[tuple[str, int]]
) -> Generator[ExtractedImage | ImageError, None, None]:
    """Yield the features of images, or why one cannot be used, in order.

    ``images`` are names and levels of escalation. By default there are as many threads as cores and
    memory allow. ClusterError when workers do not see the depth maps.
    """
    if not images:
        return
    if later := {name for name, level in images if level}:
        contents = Contents(context.workspace.contents)
        refuse_changed(
            context, {n: contents.digest(inputs.files(n, extractor.options)) for n in later}
        )
    executor = context.executor or Threads(num_images_at_once(extractor))
    depth_folder = extractor.options.depth.folder
    if depth_folder and not executor.sees([depth_folder]):
        raise ClusterError(
            f"{depth_folder}: the workers of the cluster do not see this folder of depth maps; put "
            "it on storage that all of them share"
        )
    files = inputs.photographs.files(images[0][0])
    is_shared = executor.sees(files)
    tasks: Iterable[ImageTask] = image_tasks(context.workspace, inputs, extractor.options, images)
    if not is_shared:
        tasks = (task.with_files() for task in tasks)
    outcomes = executor.map(extractor, tasks, files if is_shared else ())
    for (name, level), found in zip(images, outcomes, strict=True):
        if isinstance(found, ExtractedImage):
            logger.debug("%s: %d features (level %d)", name, len(found.features), level)
            if found.warning:
                logger.warning("%s: %s", name, found.warning)
        yield found


def image_tasks(
    workspace: Workspace,
    inputs: Inputs,
    options: ExtractionOptions,
    images: Iterable[tuple[str, int]],
) -> Iterator[ImageTask]:
    """Yield what is to be done for images; cameras are read where rectification depends on them."""
    known = {}
    if workspace.database.exists():
        known = colmap_database.read_cameras(workspace.database)
    initial = inputs.initial_cameras
    names = inputs.names() if options.uses_depth else []
    for name, level in images:
        camera = known.get(name)
        intrinsics = None
        if options.uses_depth:
            intrinsics = (
                colmap_database.camera_matrix(camera) if camera else initial.matrix(name, names)
            )
        size = (camera.width, camera.height) if camera else None
        yield ImageTask(inputs.photographs, name, level, intrinsics, size)


def _start_database(workspace: Workspace) -> None:
    """Make the database from the one that the extract stage was given, unless it is there."""
    original = workspace.require("extract")["from_database"]
    if original and not workspace.database.exists():
        copy_without_features(Path(original), workspace.database)


def _refuse_foreign_features(workspace: Workspace, names: Sequence[str]) -> None:
    """Refuse to replace features of another program in a user's database."""
    if not (workspace.users_database and workspace.database.exists()):
        return
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        foreign = [n for n in names if n in ids and database.exists_keypoints(ids[n])]
    if foreign:
        raise DatabaseError(
            f"{workspace.database}: has other features of {foreign[0]}; they are not replaced, "
            "start a new database from it (from_database, --from-database)"
        )


def write_images_and_keypoints(context: Context) -> dict[str, str]:
    """Bring the database up to date; return the images that COLMAP does not take, with reasons."""
    workspace, store = context.workspace, context.features
    _start_database(workspace)
    inputs = Inputs.recorded(workspace)
    counts = store.num_keypoints()
    rejected = import_images(
        workspace.database, Path(inputs.image_path), list(counts), inputs.cameras
    )
    original = Path(inputs.from_database) if inputs.from_database else None
    record_cameras(
        workspace.database,
        workspace.cameras,
        None if original else inputs.initial_cameras,
        read_camera_records(original.with_name(workspace.cameras.name)) if original else None,
    )
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        for name, count in counts.items():
            if name in ids and not colmap_database.has_keypoints(database, ids[name], count):
                colmap_database.write_keypoints(
                    database, ids[name], store.read_frames(name), store.level_ends(name)
                )
    reason = f"COLMAP does not take it (camera mode {inputs.cameras.mode})"
    return dict.fromkeys(rejected, reason)


def write_descriptors(context: Context) -> None:
    """Write the descriptors of all images into the database as COLMAP's matchers take them."""
    features, path = context.features, context.workspace.database
    ids = colmap_database.image_ids(path)
    counts = {name: count for name, count in features.num_keypoints().items() if name in ids}
    with colmap_database.open_database(path) as database:
        written = {name: database.num_descriptors_for_image(ids[name]) for name in counts}
        if any(written[name] not in (0, count) for name, count in counts.items()):
            database.clear_descriptors()  # from before an escalation; COLMAP cannot replace them
            written = dict.fromkeys(counts, 0)
        for name, count in counts.items():
            if count and not written[name]:
                descriptors = features.read(name).descriptors
                colmap_database.write_descriptors(database, ids[name], descriptors)
