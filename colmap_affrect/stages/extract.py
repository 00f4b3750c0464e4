"""Extract: photographs into ``features.h5``, cameras, images and keypoints into the database."""

import logging
import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

from colmap_affrect.colmap import database as colmap_database
from colmap_affrect.colmap.checks import FATAL_FOR_IMAGES, refuse_unusable
from colmap_affrect.errors import (
    ConflictError,
    DatabaseError,
    ImageError,
    Logged,
    Option,
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
from colmap_affrect.project.feature_store import NOT_KNOWN, FeatureStore
from colmap_affrect.project.image_failures import ImageFailure, UnusableImageError
from colmap_affrect.project.paths import PathLike
from colmap_affrect.project.record import WEIGHTS, Content
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning, WarningCode
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
    want of a depth map, is extracted as it is, with a warning.

    Args:
        context: of the workspace.
        inputs: the photographs, and what is known of their cameras.
        recipe: says which features.
        image_names: photographs to extract in the place of all that the inputs name.
        later: options of later stages, by their names; they are put on record beside those of the
            recipe.
        overwrite: discard what there is.

    Returns:
        How many images were extracted now and before, and why others were not.

    Raises:
        ImageError: none of the images can be used.
    """
    start = time.perf_counter()
    workspace = context.workspace
    folder = Path(inputs.image_path)
    inputs.check()
    workspace.require_own(folder)
    _check_source(workspace, inputs)
    names = _names(inputs, image_names)
    known = {} if overwrite else context.features.contents()
    contents = inputs.contents(names, recipe.extraction, known)
    warned = list[StageWarning]()
    if contents != known:  # those that were there before were seen to be good
        warned += inputs.check_names(names)
    without_mask = _mask_warnings(inputs, names)
    extractor = _prepared(context, recipe, known, contents)
    if not overwrite:
        _refuse_other_photographs(workspace, inputs.image_path, contents)
    _record(context, inputs, recipe, later=later or {}, overwrite=overwrite)
    warned += _forget_changed(context, inputs, contents, are_all=not image_names)
    start_database(workspace, inputs)
    done = set(names).intersection(context.features.names())
    missing = [name for name in names if name not in done]
    _refuse_foreign_features(workspace, missing)
    if not (inputs.image_list_path or image_names):
        warned += _warnings_of_the_folder(inputs, names)
    warned += without_mask
    _log_warnings(warned)
    failures, warned_of_images = _extract_missing(
        context, inputs, extractor, names=missing, contents=contents
    )
    _require_one_usable(folder, names, failures)
    failures |= write_images_and_keypoints(context)
    return StageReport(
        name="extract",
        wall_s=time.perf_counter() - start,
        num_done=len(set(missing) - failures.keys()),
        num_kept=len(done - failures.keys()),
        failed=failures,
        warned=(*warned, *warned_of_images),
    )


def _prepared(
    context: Context,
    recipe: Recipe,
    known: Mapping[str, Content],
    now: Mapping[str, Content],
) -> ImageExtractor | None:
    """Return what extracts features; None where nothing is to do, and no networks are loaded.

    Args:
        context: of the workspace.
        recipe: says which features.
        known: what the files held that features are from, by image.
        now: what the files hold, by image.
    """
    if known.keys() >= now.keys() and not _changed(known, now):
        return None
    return one_image.prepare(
        recipe.extraction,
        context.resources,
        list(now),
        context.progress,
        only_first=True,
    )


def _names(inputs: Inputs, image_names: Sequence[PathLike]) -> list[str]:
    """Return the photographs to extract: those that are named, else those of the inputs."""
    if not image_names:
        return inputs.names()
    folder = Path(inputs.image_path)
    return checked_names(folder, names=image_names, where="image_names")


def _check_source(workspace: Workspace, inputs: Inputs) -> None:
    """Refuse a database to begin with that cannot be used, before it is on record."""
    if inputs.from_database and not workspace.database.exists():
        refuse_unusable(Path(inputs.from_database), FATAL_FOR_IMAGES)


def _require_one_usable(
    folder: Path, names: Sequence[str], failures: Mapping[str, ImageFailure]
) -> None:
    if failures:
        require_folder(folder)  # else it has gone with all that was still to come
    if len(failures) == len(names):
        first = failures[names[0]].text()
        raise ImageError(
            (f"none of the {len(names)} images can be used; the first: ", first),
            where=folder,
        )


def _record(
    context: Context,
    inputs: Inputs,
    recipe: Recipe,
    *,
    later: Mapping[str, Options],
    overwrite: bool,
) -> None:
    """Put what was given on record, and the options that later stages take where none are given."""
    weights = one_image.find_weights(recipe.extraction, context.resources)
    options = {
        **inputs.to_mapping(),
        **recipe.extraction.to_mapping(),
        WEIGHTS: digests(weights),
    }
    planned = {**recipe.later_stages, **later}
    context.workspace.record_options(
        "extract",
        options,
        plan={stage: given.to_mapping() for stage, given in planned.items()},
        recipe=recipe.name,
        overwrite=overwrite,
    )


def _mask_warnings(inputs: Inputs, names: Sequence[str]) -> list[StageWarning]:
    """Return a warning of the images that have no mask where masks are given."""
    whole = inputs.photographs.without_mask(names)
    if not whole:
        return []
    return [_warning_of("no_mask", "masks", whole)]


def _warning_of(
    code: WarningCode, about: str, names: Sequence[str], **values: int
) -> StageWarning:
    """Return a warning of images, with their number and the first of them.

    Args:
        code: of the warning.
        about: what it begins with.
        names: of the images.
        values: other numbers that belong to it.
    """
    found: dict[str, int | str] = {"num": len(names), "example": one_line(names[0])}
    return StageWarning(code, about, {**found, **values})


def _warnings_of_the_folder(inputs: Inputs, names: Sequence[str]) -> list[StageWarning]:
    """Return warnings of the photographs of the folder that are not used."""
    folder = Path(inputs.image_path)
    if inputs.from_database:
        return not_named(folder, names)
    return left_out(folder)


def _log_warnings(warned: Iterable[StageWarning]) -> None:
    """Log what the user should know of the photographs."""
    for warning in warned:
        logger.warning("%s", Logged(warning.line))


def _extract_missing(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor | None,
    names: Sequence[str],
    contents: Mapping[str, Content],
) -> tuple[dict[str, ImageFailure], list[StageWarning]]:
    """Extract images one by one; return why some cannot be used, and warnings of others."""
    if not extractor:
        return {}, []
    store = context.features
    images = [(name, 0) for name in names]
    failures = dict[str, ImageFailure]()
    warned = list[StageWarning]()  # of single images, which are logged one by one
    faded = list[str]()
    white = list[str]()  # images whose mask leaves out nothing
    with (
        context.progress.stage("extract", len(names), "images") as advance,
        closing(extract_images(context, inputs, extractor, images)) as found_images,
    ):
        for name, found in zip(names, found_images, strict=True):
            if isinstance(found, UnusableImageError):
                logger.warning("%s", Logged(found.failure.words))
                failures[name] = found.failure
            else:
                if not len(found.features):
                    logger.warning("%s: no features (blank or too small?)", name)
                warned += _warnings_of_image(name, found)
                if found.stretched:
                    faded.append(name)
                if found.mask_is_white:
                    white.append(name)
                store.write(
                    name,
                    features=found.features,
                    image_size=found.image_size,
                    content=contents[name],
                    lines=found.lines,
                )
            advance(1)
    more = list[StageWarning]()
    if faded:
        num = len(names)
        more.append(_warning_of("low_contrast", "contrast", faded, num_images=num))
    if white:
        more.append(_warning_of("white_masks", "white masks", white))
    _log_warnings(more)
    return failures, warned + more


def _warnings_of_image(name: str, found: ExtractedImage) -> list[StageWarning]:
    """Return a warning of an image that was not rectified."""
    if not found.not_rectified:
        return []
    return [StageWarning("not_rectified", name, {"reason": found.not_rectified})]


def extract_images(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor,
    images: Sequence[tuple[str, int]],
) -> Generator[ExtractedImage | UnusableImageError, None, None]:
    """Yield the features of images, or why one cannot be used, in order.

    By default there are as many threads as cores and memory allow.

    Args:
        context: of the workspace.
        inputs: the photographs, and what is known of their cameras.
        extractor: of the recipe.
        images: names and levels of escalation.

    Raises:
        AffrectError: workers do not see the photographs or the depth maps.
    """
    if not images:
        return
    options = extractor.options
    escalated = {name for name, level in images if level}
    if escalated:
        _refuse_changed(context, inputs, names=escalated)
    executor = context.executor or _threads(extractor, images)
    files = inputs.photographs.files(images[0][0])
    if options.depth.path:
        files.append(Path(options.depth.path))
    tasks = _tasks(context, inputs, extractor, images)
    extracted = executor.map(extractor, tasks, files)
    for (name, level), found in zip(images, extracted, strict=True):
        if isinstance(found, ExtractedImage):
            logger.debug("%s: %d features (level %d)", name, len(found.features), level)
            _log_warnings(_warnings_of_image(name, found))
        yield found


def _threads(extractor: ImageExtractor, images: Sequence[tuple[str, int]]) -> Threads:
    """Return as many threads as cores and memory allow."""
    numbers = {level for _, level in images}
    levels = [extractor.options.levels[number] for number in numbers]
    return Threads(min(one_image.num_images_at_once(levels), len(images)))


def _tasks(
    context: Context,
    inputs: Inputs,
    extractor: ImageExtractor,
    images: Iterable[tuple[str, int]],
) -> Iterator[ImageTask]:
    """Yield what is to be done for images of these names and levels."""
    initial = inputs.initial_cameras
    has_database = context.workspace.database.exists()
    cameras = context.graph.cameras if has_database else {}
    uses_depth = extractor.options.uses_depth
    names = inputs.names() if uses_depth else []
    for name, level in images:
        camera = cameras.get(name)
        intrinsics = None
        if uses_depth and camera:
            intrinsics = colmap_database.camera_matrix(camera)
        elif uses_depth:
            intrinsics = initial.matrix(name, names)
        yield ImageTask(
            photographs=inputs.photographs,
            name=name,
            level=level,
            intrinsics=intrinsics,
            camera_size=(camera.width, camera.height) if camera else None,
        )


def _refuse_foreign_features(workspace: Workspace, names: Sequence[str]) -> None:
    """Refuse to replace features of another program in a user's database."""
    if not (workspace.users_database and workspace.database.exists()):
        return
    ids = colmap_database.image_ids(workspace.database)
    with colmap_database.open_database(workspace.database) as database:
        for name in names:
            if name in ids and database.exists_keypoints(ids[name]):
                raise DatabaseError(
                    f"has other features of {name}",
                    where=workspace.database,
                    advice=(
                        "they are not replaced, start a new database from it (",
                        Option("from-database"),
                        ")",
                    ),
                )


# Inputs that have changed since a run began: what was made from them is forgotten, and made again.
# Features depend on photographs, masks and depth maps; matches on the features of two images;
# pairs, the database and all that follows on all images, and on cameras that are given.


def _refuse_other_photographs(
    workspace: Workspace, image_path: str, contents: Mapping[str, Content]
) -> None:
    """Refuse another folder of photographs unless it has some that were worked on."""
    before = (workspace.options_on_record("extract") or {}).get(
        "image_path", image_path
    )
    known = {} if before == image_path else FeatureStore(workspace.features).contents()
    if known and len(_changed(known, contents)) == len(known.keys() & contents.keys()):
        raise ConflictError(
            f"the extract stage was run there with image_path={before!r}, and none "
            f"of the photographs in {image_path} is one of them",
            where=workspace.path,
            advice=(
                "use ",
                Option("overwrite"),
                " to discard the results, or another ",
                Option("output-path"),
            ),
        )


def _changed(known: Mapping[str, Content], now: Mapping[str, Content]) -> list[str]:
    """Return the images whose files are not those any more that their features are from."""
    changed = []
    for name, content in now.items():
        before = known.get(name, NOT_KNOWN).digest
        if before and before != content.digest:
            changed.append(name)
    return changed


def _forget_changed(
    context: Context, inputs: Inputs, contents: Mapping[str, Content], *, are_all: bool
) -> list[StageWarning]:
    """Remove what was made from inputs that have changed since, so that it is made again.

    The changed images lose their features last: a run that is killed before finds them changed
    again. ``contents`` are those of each image now; ``are_all`` says that there are no other
    images. Returns a warning, none if nothing has changed.
    """
    workspace = context.workspace
    known = context.features.contents()
    changed = _changed(known, contents)
    gone = list[str]()
    if are_all and not workspace.users_database:
        gone = sorted(known.keys() - contents.keys())
    cameras = inputs.cameras_digest()
    reasons = [*_counted(changed, "changed"), *_counted(gone, "gone")]
    if known and workspace.input_digest("cameras") != cameras:
        reasons.append("cameras are given otherwise")
    why = ", ".join(reasons)
    if reasons:
        workspace.rewind(f"since it was made, {why}")
        context.graph.forget()
        workspace.pairs.unlink(missing_ok=True)
        lost = {*changed, *gone}
        context.matches.remove(lost)
        if lost:
            context.features.remove(lost)
    _record_new_stamps(context, contents, known)
    workspace.record_input_digests(cameras=cameras)
    if not reasons:
        return []
    values: dict[str, int | str] = {
        "what": why,
        "num_changed": len(changed),
        "num_gone": len(gone),
    }
    return [StageWarning("inputs_changed", inputs.image_path, values)]


def _record_new_stamps(
    context: Context, contents: Mapping[str, Content], known: Mapping[str, Content]
) -> None:
    """Put sizes and times on record of files that hold what they did, and were written again."""
    unchanged = known.keys() & contents.keys() - set(_changed(known, contents))
    others = [name for name in unchanged if known[name] != contents[name]]
    if others:
        context.features.record_contents({name: contents[name] for name in others})


def _counted(names: Sequence[str], what: str) -> list[str]:
    return [f"{len(names)} {what} ({such_as(names)})"] if names else []


def _refuse_changed(context: Context, inputs: Inputs, names: Iterable[str]) -> None:
    """Refuse to add to the features of photographs that have changed."""
    known = context.features.contents()
    now = inputs.contents(names, context.extraction, known)
    there = {name: content for name, content in now.items() if content.digest}
    changed = _changed(known, there)
    if changed:
        what = _counted(changed, "changed")[0]
        raise StoreError(
            f"{what} since their features were extracted",
            where=context.workspace.features,
            advice="run extract again",
        )
