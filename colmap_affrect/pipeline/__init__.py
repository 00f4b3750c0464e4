"""From a folder of photographs to a COLMAP model: the stages one after the other."""

import math
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack, get_args

from colmap_affrect.colmap.by_hand import ByHand, Marks, SizeOf
from colmap_affrect.colmap.database import fill_descriptors
from colmap_affrect.colmap.database_copy import read_names, read_sizes, schema_version
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import ImageError, Option, OptionError
from colmap_affrect.escalation.escalate import escalate
from colmap_affrect.escalation.map_and_rematch import map_and_rematch
from colmap_affrect.escalation.policy import forecast_of
from colmap_affrect.features.weights import resolve
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.images.reading import header_size
from colmap_affrect.mappers.base import MAPPERS, Mapper, MapperOptions
from colmap_affrect.mappers.existing import (
    Extension,
    as_extension,
    existing_names,
    read_to_extend,
)
from colmap_affrect.mend import mend_and_seal
from colmap_affrect.options import takes_fields_of
from colmap_affrect.pairs.given_matches import MatchType
from colmap_affrect.pairs.lists import PairOptions, read_pairs_once
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.progress import GivenProgress, Progress
from colmap_affrect.project.argument_types import require_bools
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.stage_warnings import StageWarning
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.report.run_results import MappingResult, write_results
from colmap_affrect.session.context import Context, Inputs, Resources
from colmap_affrect.session.run_options import RunKeywords, RunOptions
from colmap_affrect.stages.extract import extract as extract_features
from colmap_affrect.stages.foreign import ForeignDatabase, import_and_verify
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import image_names
from colmap_affrect.stages.map import map_images as map_pairs
from colmap_affrect.stages.match import load_matchers
from colmap_affrect.stages.match import match as match_pairs
from colmap_affrect.stages.pairs import choose_pairs as list_pairs
from colmap_affrect.stages.verify import verify_matches as verify_pairs

# Photographs whose size tells that of all, for the forecast; resource
MAX_NUM_SIZES = 20


@takes_fields_of(RunOptions)
def run(
    image_path: PathLike,
    output_path: PathLike,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    page: bool = True,
    progress: GivenProgress = None,
    **keywords: Unpack[RunKeywords],
) -> RunReport:
    """Extract, match, verify and map; go on where an earlier run stopped.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: options to begin with; None for the usual ones.
        executor: where images and pairs are worked on, e.g. a cluster
            (:func:`colmap_affrect.parallel.cluster.connected`); None: threads of this process.
        overwrite: discard results that are there.
        page: also write ``report.html``.
        progress: True shows it on standard error, False nowhere; None where somebody looks at it,
            on a terminal or in a notebook. See also :class:`Progress`.
        keywords: fields of :class:`RunOptions`, as ``recipe="rectified"``,
            ``cameras={"mode": "single"}`` or ``effort="high"``.

    Returns:
        The report that is also written to ``report.json``, with the models.

    Raises:
        OptionError: for wrong arguments, by their names.
        AffrectError: for anything else that the caller can mend; what is done stays.
    """
    image_path = as_path(image_path, "image_path")
    hint = "; a recipe is given as recipe='NAME'" if isinstance(options, str) else ""
    options = RunOptions.with_keywords(options, keywords, hint=hint)
    require_bools(overwrite=overwrite, page=page)
    context = replace(
        context_of(output_path, progress, options.resources, executor, options.by_hand),
        deadline_s=time.monotonic() + 60 * options.max_minutes,
        effort=options.effort,
        command=options.command,
    )
    with context.progress.never_silent():
        return _run(context, image_path, options, overwrite=overwrite, page=page)


def _run(
    context: Context,
    image_path: Path,
    options: RunOptions,
    *,
    overwrite: bool,
    page: bool,
) -> RunReport:
    """Run all stages in the folder of a context, after everything that can be has been checked."""
    recipe = options.recipe
    workspace = context.workspace
    mapper = MAPPERS.make(options.mapper_options())
    inputs = options.inputs(image_path)
    _check_extension(
        options.extend, mapper, output_path=workspace.path, overwrite=overwrite
    )
    names = _checked_names(inputs, options, mapper)
    folder = Path(inputs.image_path)
    num_pairs = _num_pairs(names, options=options.pairs, image_path=folder)
    usable = options.resources.usable_levels(recipe.extraction)
    megapixels = _megapixels(names, image_path, recipe.extraction.max_image_size_px)
    is_new = overwrite or not workspace.features.exists()
    forecast = forecast_of(
        recipe.levels, usable, len(names), num_pairs, megapixels, is_new=is_new
    )
    context = replace(context, progress=context.progress.with_forecast(forecast))
    _prepare_parts(context, recipe)
    later = options.later_stages()
    if is_new and context.executor is None:
        recipe.matching.load_meanwhile(num_pairs)
    with workspace.locked(), mend_and_seal(context, follows=False, discards=overwrite):
        reports = [
            extract_features(context, inputs, recipe, later=later, overwrite=overwrite),
            list_pairs(context, options.pairs),
            match_pairs(context, recipe.matching),
            verify_pairs(context, options.verification),
        ]
        if not recipe.extraction.escalation:
            reports.append(guide(context, recipe.guided))
        elif options.extend:
            reports += [
                escalate(context, recipe.escalate),
                guide(context, recipe.guided),
            ]
        else:
            reports += map_and_rematch(context, mapper, recipe)
        if options.database_descriptors:
            fill_descriptors(workspace.database, context.features)
        return map_and_report(
            context, mapper, options.extend, earlier=reports, page=page
        )


def _checked_names(inputs: Inputs, options: RunOptions, mapper: Mapper) -> list[str]:
    """Return the names of the photographs, after all that is said of them has been checked."""
    names = inputs.names()
    inputs.check()
    folder = Path(inputs.image_path)

    def size_of(name: str) -> tuple[int, int] | None:
        return header_size(folder / name)

    _check_by_hand(options.by_hand, names, mapper, size_of)
    if options.extend:
        existing_names(options.extend.model_path, names)
    return names


def _prepare_parts(context: Context, recipe: Recipe) -> None:
    """Find, or download, whatever the parts of a recipe need, before anything is computed."""
    recipe.extraction.check_depth()
    weights_path = context.resources.weights_path
    resolve(recipe.required_weights, weights_path, progress=context.progress)
    load_matchers(context, recipe.extraction, options=recipe.matching)


def _check_by_hand(
    by_hand: ByHand, names: Collection[str], mapper: Mapper, size_of: SizeOf
) -> Marks:
    # Refuses marks that name other photographs, or lie outside of theirs
    marks = by_hand.marks(names, size_of)
    if by_hand.tie_points_path and mapper.options.name != MAPPERS.default:
        raise OptionError(
            f"the {mapper.options.name} mapper takes none",
            where=Option("tie-points"),
            advice=("use ", Option("mapper"), " sparse"),
        )
    return marks


def _check_extension(
    extend: Extension | None, mapper: Mapper, output_path: Path, *, overwrite: bool
) -> None:
    """Refuse a model that the mapper cannot extend, or that would be discarded before."""
    if not extend:
        return
    if not mapper.options.can_extend:
        raise OptionError(
            f"the {mapper.options.name} mapper cannot",
            where=Option("extend"),
            advice=("use ", Option("mapper"), " sparse"),
        )
    if overwrite:
        extend.refuse_discarding(output_path)


def _num_pairs(names: Sequence[str], options: PairOptions, image_path: Path) -> int:
    """Return about how many pairs there will be."""
    if options.match_list_path:
        return len(read_pairs_once(Path(options.match_list_path), names, image_path))
    count = math.comb(len(names), 2)
    is_all = "exhaustive" in options.methods
    return count if is_all else min(count, len(names) * options.num_neighbors)


def _megapixels(names: Sequence[str], image_path: Path, max_size_px: int) -> float:
    """Return about how many megapixels photographs have at the size of processing.

    Args:
        names: of the photographs, of which some are looked at.
        image_path: their folder.
        max_size_px: longest side that is worked with.
    """
    step = max(1, len(names) // MAX_NUM_SIZES)
    found = []
    for name in names[::step]:
        size = header_size(image_path / name)
        if size is not None:
            shrinking = min(1.0, max_size_px / max(size))
            found.append(size[0] * size[1] * shrinking**2 / 1e6)
    return len(names) * sum(found) / len(found) if found else 0.0


def context_of(
    output_path: PathLike,
    progress: GivenProgress,
    resources: Resources | Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    by_hand: ByHand | Mapping[str, Any] | None = None,
) -> Context:
    """Return where a stage works and with what."""
    path = as_path(output_path, "output_path")
    if not (executor is None or callable(getattr(executor, "map", None))):
        raise OptionError(
            "has no method 'map'",
            where=f"executor={executor!r}",
            advice="give an Executor",
        )
    if path.is_file():
        wanted = "give the output folder of a run; map_database and verify_matches take databases"
        raise OptionError(
            "is a file", where=f"output_path={str(path)!r}", advice=wanted
        )
    return Context(
        workspace=Workspace(path),
        resources=Resources.given(resources, "resources"),
        executor=executor,
        progress=Progress.given(progress),
        by_hand=ByHand.given(by_hand, "by_hand"),
    )


def map_database(  # noqa: PLR0913 (all but two are keywords)
    database_path: PathLike,
    output_path: PathLike,
    *,
    image_path: PathLike | None = None,
    cameras: CameraOptions | Mapping[str, Any] | None = None,
    matches_path: PathLike | None = None,
    match_type: MatchType = "raw",
    match_list_path: PathLike | None = None,
    mapping: MapperOptions | Mapping[str, Any] | str | None = None,
    verification: VerificationOptions | Mapping[str, Any] | None = None,
    extend: Extension | PathLike | None = None,
    by_hand: ByHand | Mapping[str, Any] | None = None,
    overwrite: bool = False,
    page: bool = True,
    progress: GivenProgress = None,
) -> RunReport:
    """Map a database of any program; it is copied and stays as it is.

    Pairs without two-view geometry are verified; where no images are matched, they are matched by
    their descriptors.

    Args:
        database_path: the database.
        output_path: folder for all results, made if missing.
        image_path: folder of the photographs, for the colours of the points.
        cameras: what is known of its cameras; which images share one stays.
        matches_path: a file of matches (:mod:`colmap_affrect.pairs.given_matches`).
        match_type: what it has, ``raw`` matches or ``inliers``.
        match_list_path: pairs to match by descriptors; None: all.
        mapping: the mapper and its options, or its name; None for the sparse mapper.
        verification: of pairs that are not verified.
        extend: a model that the images are registered into, or its folder.
        by_hand: tie points, wrong pairs, photographs to leave out.
        overwrite: discard results that are there.
        page: also write ``report.html``.
        progress: see :func:`run`.

    Returns:
        The report that is also written to ``report.json``, with the models.
    """
    require_bools(overwrite=overwrite, page=page)
    foreign = ForeignDatabase(
        path=as_path(database_path, "database_path"),
        image_path=as_path_or_none(image_path, "image_path"),
        cameras=CameraOptions.given(cameras, "cameras"),
        matches_path=as_path_or_none(matches_path, "matches_path"),
        match_type=match_type,
        match_list_path=as_path_or_none(match_list_path, "match_list_path"),
    )
    context = context_of(output_path, progress, by_hand=by_hand)
    mapper = mapper_of(mapping)
    chosen = VerificationOptions.given(verification, "verification")
    extension = as_extension(extend)
    _check_foreign(context, foreign, mapper, extend=extension, overwrite=overwrite)
    with (
        context.progress.never_silent(),
        context.workspace.locked(),
        mend_and_seal(context, follows=False, discards=overwrite),
    ):
        report = import_and_verify(
            context, foreign, verification=chosen, overwrite=overwrite
        )
        return map_and_report(
            context, mapper, extend=extension, earlier=[report], page=page
        )


def mapper_of(mapping: MapperOptions | Mapping[str, Any] | str | None) -> Mapper:
    """Return the mapper that is given by its options or name; None: the usual one."""
    return MAPPERS.make(MAPPERS.options(mapping or MAPPERS.default, "mapping"))


def _check_foreign(
    context: Context,
    foreign: ForeignDatabase,
    mapper: Mapper,
    extend: Extension | None,
    *,
    overwrite: bool,
) -> None:
    """Refuse what cannot be mapped, or not so, before anything is made."""
    if foreign.match_type not in get_args(MatchType):
        raise OptionError(
            "give 'raw' or 'inliers'", where=f"match_type={foreign.match_type!r}"
        )
    schema_version(foreign.path)
    _check_extension(
        extend, mapper, output_path=context.workspace.path, overwrite=overwrite
    )
    if extend:
        read_to_extend(extend.model_path)
    sizes = read_sizes(foreign.path)
    _check_by_hand(
        context.by_hand,
        names=read_names(foreign.path),
        mapper=mapper,
        size_of=sizes.get,
    )
    foreign.check()


def map_and_report(
    context: Context,
    mapper: Mapper,
    extend: Extension | None = None,
    *,
    earlier: Sequence[StageReport] = (),
    overwrite: bool = False,
    page: bool = True,
) -> RunReport:
    """Map a verified workspace and write ``report.json`` and, if wanted, ``report.html``.

    Args:
        context: of the workspace, whose pairs are verified.
        mapper: that makes the models.
        extend: a model that the images are registered into.
        earlier: what the stages before have done in this run.
        overwrite: discard the models that are there.
        page: also write ``report.html``.

    Returns:
        The report that is also written to ``report.json``.
    """
    workspace = context.workspace
    names, gone = _names_and_gone(context, may_be_gone=bool(earlier))
    _check_extension(extend, mapper, output_path=workspace.path, overwrite=overwrite)
    cameras = context.graph.cameras.items()
    sizes = {name: (camera.width, camera.height) for name, camera in cameras}
    marks = _check_by_hand(context.by_hand, names, mapper, size_of=sizes.get)
    before = existing_names(extend.model_path, names) if extend else []
    report, models = map_pairs(context, mapper, extend, overwrite=overwrite)
    lost = [StageWarning("photograph_gone", name) for name in gone]
    report = replace(report, warned=(*report.warned, *lost))
    result = MappingResult(
        options=mapper.options,
        names=names,
        extended=before,
        marks=marks,
        models=models,
        stages=(*earlier, report),
    )
    return write_results(context, result, page=page)


def _names_and_gone(
    context: Context, *, may_be_gone: bool
) -> tuple[list[str], list[str]]:
    """Return the names of all photographs, and which are gone since they had features.

    ImageError where none may be gone.
    """
    names = image_names(context)
    if context.workspace.is_foreign:
        return names, []
    gone = sorted(set(context.features.names()) - set(names))
    if gone and not may_be_gone:
        path = context.inputs.image_path
        raise ImageError(
            f"{gone[0]} has features, and is gone",
            where=path,
            advice="run extract again",
        )
    return sorted({*names, *gone}), gone
