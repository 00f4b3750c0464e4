"""Extract: photographs into ``features.h5``, cameras, images and keypoints into the database."""

import logging
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.checks import FATAL_FOR_IMAGES, refuse_unusable
from colmap_affrect.errors import (
    ConflictError,
    DatabaseError,
    ImageError,
    StoreError,
    one_line,
    such_as,
)
from colmap_affrect.features.weights import digests
from colmap_affrect.images.photographs import (
    checked_names,
    left_out,
    not_named,
    require_folder,
)
from colmap_affrect.options import Options
from colmap_affrect.parallel.executor import Threads
from colmap_affrect.project.paths import PathLike
from colmap_affrect.project.record import WEIGHTS, Content
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.session.context import Context, Inputs
from colmap_affrect.session.database_export import (
    start_database,
    write_images_and_keypoints,
)
from colmap_affrect.stages import one_image
from colmap_affrect.stages.one_image import ExtractedImage, ImageExtractor, ImageTask

logger = logging.getLogger(__name__)


def extract(
    context: Context,
    inputs: Inputs,
    recipe: Recipe,
    *,
    image_names: Sequence[PathLike] = (),
    later: Mapping[str, Options] | None = None,
    overwrite: bool = False,
) -> StageReport:
    """Extract features of all images and put cameras, images and keypoints into the database.

    An image that cannot be read is reported and passed over. One that cannot be rectified, for
    want of a depth map, is extracted as it is, with a warning. The options of later stages are
    put on record too: ``later``, by name, beside those of the recipe. ``image_names`` are looked at
    in the place of a list on record.
    """
    start = time.perf_counter()
    workspace = context.workspace
    folder = Path(inputs.image_path)
    inputs.check()
    workspace.require_own(folder)
    if inputs.from_database and not workspace.database.exists():
        refuse_unusable(
            Path(inputs.from_database), FATAL_FOR_IMAGES
        )  # before it is on record
    if image_names:
        names = checked_names(folder, image_names, "image_names")
    else:
        names = inputs.names()
    options = recipe.extraction
    known = {} if overwrite else context.features.contents()
    contents = inputs.contents(names, options, known)
    # Those that were there before were seen to be good.
    notes = inputs.check_names(names) if contents != known else {}
    whole = inputs.photographs.without_mask(names)
    extractor = one_image.prepare(options, context.resources, names, context.progress)
    if not overwrite:
        _refuse_other_photographs(workspace, inputs.image_path, contents)
    weights = digests(extractor.weights)
    given = {**inputs.to_mapping(), **options.to_mapping(), WEIGHTS: weights}
    _record(workspace, given, recipe, later or {}, overwrite)
    warnings = notes | _forget_changed(
        context, inputs, contents, are_all=not image_names
    )
    start_database(workspace, inputs)
    done = set(names).intersection(context.features.names())
    missing = [name for name in names if name not in done]
    _refuse_foreign_features(workspace, missing)
    if not (inputs.image_list_path or image_names):
        warnings |= (
            not_named(folder, names) if inputs.from_database else left_out(folder)
        )
    if whole:
        warnings["masks"] = (
            f"{len(whole)} images have none and are used whole, as {whole[0]} is"
        )
    _log_warnings(warnings)
    failures = _extract_missing(context, inputs, extractor, missing, contents, warnings)
    if failures:
        require_folder(folder)  # else it has gone with all that was still to come
    if len(failures) == len(names):
        why = f"none of the {len(names)} images can be used; the first: {failures[names[0]]}"
        raise ImageError(f"{folder}: {why}")
    failures |= write_images_and_keypoints(context)
    new = set(missing) - failures.keys()
    kept = done - failures.keys()
    wall_s = time.perf_counter() - start
    return StageReport("extract", wall_s, len(new), len(kept), failures, warnings)


def _record(
    workspace: Workspace,
    given: Mapping[str, Any],
    recipe: Recipe,
    later: Mapping[str, Options],
    overwrite: bool,
) -> None:
    """Put what was given on record, and the options that later stages take where none are given."""
    plan = dict[str, Any]()
    for stage, options in {**recipe.later_stages, **later}.items():
        plan[stage] = options.to_mapping()
    workspace.record_options(
        "extract", given, plan=plan, recipe=recipe.name, overwrite=overwrite
    )


def _log_warnings(warnings: Mapping[str, str]) -> None:
    """Log what the user should know of the photographs, by kind."""
    for kind, what in warnings.items():
        logger.warning("%s: %s", kind, what)


def _extract_missing(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor,
    names: Sequence[str],
    contents: Mapping[str, Content],
    warnings: dict[str, str],
) -> dict[str, str]:
    """Extract images one by one; return why some cannot be used, and add to the warnings."""
    store = context.features
    images = [(name, 0) for name in names]
    failures = dict[str, str]()
    faded = list[str]()
    white = list[str]()
    with (
        context.progress.stage("extract", len(names), "images") as advance,
        closing(extract_images(context, inputs, extractor, images)) as found_images,
    ):
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
                if found.mask_is_white:
                    white.append(name)
                size = found.image_size
                store.write(name, found.features, size, contents[name], found.lines)
            advance(1)
    if faded:
        warnings["contrast"] = (
            f"is low in {len(faded)} of {len(names)} photographs, such as {one_line(faded[0])}; it "
            "was stretched (--set stretch_contrast=false leaves it as it is)"
        )
        logger.warning("contrast: %s", warnings["contrast"])
    if white:
        warnings["white masks"] = (
            f"{len(white)} masks are white all over, such as that of {one_line(white[0])}, and "
            "leave out nothing; black is where features are not wanted"
        )
        logger.warning("white masks: %s", warnings["white masks"])
    return failures


def extract_images(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor,
    images: Sequence[tuple[str, int]],
) -> Generator[ExtractedImage | ImageError, None, None]:
    """Yield the features of images, or why one cannot be used, in order.

    ``images`` are names and levels of escalation. By default there are as many threads as cores and
    memory allow. AffrectError when workers do not see the photographs or the depth maps.
    """
    if not images:
        return
    if later := {name for name, level in images if level}:
        _refuse_changed(context, inputs, later)
    levels = [extractor.options.levels[k] for k in {k for _, k in images}]
    num = one_image.num_images_at_once(levels)
    executor = context.executor or Threads(min(num, len(images)))
    files = inputs.photographs.files(images[0][0])
    if extractor.options.depth.path:
        files.append(Path(extractor.options.depth.path))
    path = context.workspace.database
    initial = inputs.initial_cameras
    known = context.graph.cameras if path.exists() else {}
    names = inputs.names() if extractor.options.uses_depth else []

    def task(name: str, level: int) -> ImageTask:
        camera = known.get(name)
        intrinsics = None
        if extractor.options.uses_depth:
            matrix = colmap_database.camera_matrix
            intrinsics = matrix(camera) if camera else initial.matrix(name, names)
        size = (camera.width, camera.height) if camera else None
        return ImageTask(inputs.photographs, name, level, intrinsics, size)

    tasks = (task(*image) for image in images)
    for (name, level), found in zip(
        images, executor.map(extractor, tasks, files), strict=True
    ):
        if isinstance(found, ExtractedImage):
            logger.debug("%s: %d features (level %d)", name, len(found.features), level)
            if found.warning:
                logger.warning("%s: %s", name, found.warning)
        yield found


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


# Inputs that have changed since a run began: what was made from them is forgotten, and made again.
# Features depend on photographs, masks and depth maps; matches on the features of two images;
# pairs, the database and all that follows on all images, and on cameras that are given.


def _refuse_other_photographs(
    workspace: Workspace, image_path: str, contents: Mapping[str, Content]
) -> None:
    """Refuse another folder of photographs unless it has some that were worked on."""
    before = (workspace.planned("extract") or {}).get("image_path", image_path)
    known = {} if before == image_path else FeatureStore(workspace.features).contents()
    if known and len(_changed(known, contents)) == len(known.keys() & contents.keys()):
        raise ConflictError(
            f"{workspace.path}: the extract stage was run there with image_path={before!r}, and "
            f"none of the photographs in {image_path} is one of them; use --overwrite to discard "
            "the results, or another --output-path"
        )


def _changed(known: Mapping[str, Content], now: Mapping[str, Content]) -> list[str]:
    """Return the images whose files are not those any more that their features are from."""
    both = [name for name in now if name in known and known[name].digest]
    return [name for name in both if known[name].digest != now[name].digest]


def _forget_changed(
    context: Context, inputs: Inputs, contents: Mapping[str, Content], *, are_all: bool
) -> dict[str, str]:
    """Remove what was made from inputs that have changed since, so that it is made again.

    The changed images lose their features last: a run that is killed before finds them changed
    again. ``contents`` are those of each image now; ``are_all`` says that there are no other
    images. Returns one line by the folder of the photographs, empty if nothing has changed.
    """
    workspace = context.workspace
    store = context.features
    known = store.contents()
    changed = _changed(known, contents)
    are_all = are_all and not workspace.users_database
    gone = sorted(known.keys() - contents.keys()) if are_all else []
    cameras = inputs.cameras_digest()
    has_others = bool(known) and workspace.made_from("cameras") != cameras
    other_cameras = ["cameras are given otherwise"] if has_others else []
    lines = [*_counted(changed, "changed"), *_counted(gone, "gone"), *other_cameras]
    if lines:
        workspace.rewind(f"since it was made, {', '.join(lines)}")
        context.graph.forget()
        workspace.pairs.unlink(missing_ok=True)
        context.matches.remove({*changed, *gone})
        if changed or gone:
            store.remove({*changed, *gone})
    left = known.keys() & contents.keys() - set(changed)
    if other := {
        name: contents[name] for name in left if known[name] != contents[name]
    }:
        store.record_contents(other)
    workspace.record_made_from(cameras=cameras)
    if not lines:
        return {}
    return {
        inputs.image_path: f"{', '.join(lines)}; all that hangs on them is made again"
    }


def _counted(names: Sequence[str], what: str) -> list[str]:
    return [f"{len(names)} {what} ({such_as(names)})"] if names else []


def _refuse_changed(context: Context, inputs: Inputs, names: Iterable[str]) -> None:
    """Refuse to add to the features of photographs that have changed."""
    known = context.features.contents()
    now = inputs.contents(names, context.extraction, known)
    there = {name: content for name, content in now.items() if content.digest}
    if changed := _counted(_changed(known, there), "changed"):
        raise StoreError(
            f"{context.workspace.features}: {changed[0]} since their features were extracted; run "
            "extract again"
        )
