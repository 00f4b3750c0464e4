"""From a folder of photographs to a COLMAP model: the stages one after the other."""

import math
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from colmap_affrect.colmap.by_hand import NOTHING, ByHand, Marks, SizeOf
from colmap_affrect.colmap.cameras import CameraRecord, read_camera_records
from colmap_affrect.colmap.database import fill_descriptors, num_matched_pairs
from colmap_affrect.colmap.database_copy import read_names, read_sizes, schema_version
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import ImageError, OptionError
from colmap_affrect.features.weights import resolve
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.images.reading import header_size
from colmap_affrect.mappers.base import MAPPERS, Mapper, MapperOptions
from colmap_affrect.mappers.existing import Extension, existing_names, read_to_extend
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.options import EffortName
from colmap_affrect.pairs.given_matches import MatchType
from colmap_affrect.pairs.lists import PairOptions, read_pairs
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.progress import SILENT, Forecast, Progress
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import PathLike, TakesPaths, as_path
from colmap_affrect.project.report import (
    ModelSummary,
    ReconstructionReport,
    StageReport,
    installed_versions,
    summed,
)
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.report.pairs import pairs_of_page
from colmap_affrect.report.run_page import write_run_page
from colmap_affrect.stages.advice import advice
from colmap_affrect.stages.climb import climb
from colmap_affrect.stages.context import Context, Inputs, Resources
from colmap_affrect.stages.escalate import escalate, matched_again
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.foreign import ForeignDatabase, copy_verified
from colmap_affrect.stages.guide import guide, guided_counts
from colmap_affrect.stages.map import image_names, map_images, unregistered
from colmap_affrect.stages.match import load_matchers, match
from colmap_affrect.stages.mend import watched
from colmap_affrect.stages.pairs import choose_pairs, listed_pairs
from colmap_affrect.stages.verify import num_verified_inliers, verify_matches


@dataclass(frozen=True, kw_only=True)
class InputOptions(TakesPaths):
    """What runs and comparisons of methods both depend on, beside images and recipes."""

    cameras: CameraOptions = field(default_factory=CameraOptions)  # how images share cameras
    masks: MaskOptions = field(default_factory=MaskOptions)  # where features may be
    pairs: PairOptions = field(default_factory=PairOptions)  # which pairs are matched
    verification: VerificationOptions = field(default_factory=VerificationOptions)
    mapping: MapperOptions = field(default_factory=SparseOptions)  # the mapper and its options
    image_list_path: Path | None = None  # the images to use; None: all below the folder
    from_database: Path | None = None  # with the images, cameras, rigs, frames and pose priors used
    resources: Resources = field(default_factory=Resources)  # weights and device of networks

    def inputs(self, image_path: Path) -> Inputs:
        """Return the photographs of a folder, with their cameras and masks."""
        names = ("image_list_path", "from_database", "cameras", "masks")
        return Inputs.of(image_path, **{name: getattr(self, name) for name in names})


@dataclass(frozen=True, kw_only=True)
class RunOptions(InputOptions):
    """Everything a run depends on beside its images and its output folder."""

    recipe: Recipe = field(default_factory=lambda: load_recipe("default"))
    database_descriptors: bool = False  # also into the database, as COLMAP's matchers need them
    extend: Extension | None = None  # the model that the photographs are registered into
    by_hand: ByHand = NOTHING  # tie points, wrong pairs, photographs to leave out
    effort: EffortName = "normal"  # how much is tried for photographs in need
    max_minutes: float = math.inf  # after which nothing more is tried for photographs in need
    command: tuple[str, ...] = ()  # words of the command line, for advice

    def __post_init__(self) -> None:
        """Refuse what would fail, or do nothing, once the first model is there."""
        super().__post_init__()
        if not self.max_minutes >= 0.0:
            raise OptionError(f"max_minutes {self.max_minutes!r}: must be at least 0")


@checks_arguments
def run(
    image_path: PathLike,
    output_path: PathLike,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    page: bool = True,
    progress: Progress = SILENT,
) -> ReconstructionReport:
    """Extract, match, verify and map; go on where an earlier run stopped.

    Returns the report that is also written to ``report.json``. Raises AffrectError for anything
    that the caller can mend; what is done stays.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: see :class:`RunOptions`.
        executor: where images and pairs are worked on, e.g. a cluster
            (:func:`colmap_affrect.parallel.cluster.connected`); None: threads of this process.
        overwrite: discard results that are there.
        page: also write ``report.html``.
        progress: where to show progress.
    """
    image_path, output_path = as_path(image_path), as_path(output_path)
    options = options or RunOptions()
    recipe, mapper = options.recipe, MAPPERS.make(options.mapping)
    inputs = options.inputs(image_path)
    names = inputs.names()  # refuses what cannot be read before anything is made
    _check_extension(options.extend, mapper, output_path, overwrite=overwrite)
    _check_by_hand(options.by_hand, names, mapper, lambda name: header_size(image_path / name))
    forecast = Forecast(len(names), _num_pairs(names, options.pairs, image_path))
    workspace = Workspace(output_path)
    context = _context_of(workspace, options, executor, replace(progress, forecast=forecast))
    if options.extend:
        existing_names(options.extend.model_path, names)
    recipe.extraction.check_depth()
    resolve(recipe.required_weights, options.resources.weights_path, progress=progress)
    load_matchers(context, recipe.extraction, recipe.matching)
    later = {"pairs": options.pairs, "verify": options.verification, "map": mapper.options}
    with workspace.locked(), watched(context, follows=False, discards=overwrite):
        reports = [
            extract(context, inputs, recipe, later=later, overwrite=overwrite),
            choose_pairs(context, options.pairs),
            match(context, recipe.matching),
            verify_matches(context, options.verification),
        ]
        if not recipe.extraction.escalation:
            reports.append(guide(context, recipe.guided))
        elif options.extend:
            reports += [escalate(context, recipe.escalate), guide(context, recipe.guided)]
        else:
            reports += climb(context, mapper, recipe)
        if options.database_descriptors:
            fill_descriptors(workspace.database, context.features)
        return map_and_report(context, mapper, options.extend, earlier=reports, page=page)


def _context_of(
    workspace: Workspace, options: RunOptions, executor: Executor | None, progress: Progress
) -> Context:
    return Context(
        workspace,
        options.resources,
        executor,
        progress,
        deadline_s=time.monotonic() + 60 * options.max_minutes,
        effort=options.effort,
        by_hand=options.by_hand,
        command=options.command,
    )


def _check_by_hand(
    by_hand: ByHand, names: Collection[str], mapper: Mapper, size_of: SizeOf
) -> Marks:
    marks = by_hand.marks(names, size_of)  # refuses what names other photographs, or lies outside
    if by_hand.tie_points_path and mapper.options.name != MAPPERS.default:
        raise OptionError(
            f"--tie-points: the {mapper.options.name} mapper takes none; use --mapper sparse"
        )
    return marks


def _check_extension(
    extend: Extension | None, mapper: Mapper, output_path: Path, *, overwrite: bool
) -> None:
    """Refuse a model that the mapper cannot extend, or that would be discarded before."""
    if not extend:
        return
    if not mapper.options.can_extend:
        raise OptionError(f"--extend: the {mapper.options.name} mapper cannot; use --mapper sparse")
    if overwrite:
        extend.refuse_discarding(output_path)


def _num_pairs(names: Sequence[str], options: PairOptions, image_path: Path) -> int:
    """Return about how many pairs there will be."""
    if options.match_list_path:
        return len(read_pairs(Path(options.match_list_path), names, image_path))
    count = math.comb(len(names), 2)
    is_all = "exhaustive" in options.methods
    return count if is_all else min(count, len(names) * options.num_neighbors)


@checks_arguments
def map_from_database(
    database_path: PathLike,
    output_path: PathLike,
    *,
    image_path: PathLike | None = None,
    cameras: CameraOptions | None = None,
    matches_path: PathLike | None = None,
    match_type: MatchType = "raw",
    match_list_path: PathLike | None = None,
    mapping: MapperOptions | None = None,
    verification: VerificationOptions | None = None,
    extend: Extension | None = None,
    by_hand: ByHand = NOTHING,
    overwrite: bool = False,
    page: bool = True,
    progress: Progress = SILENT,
) -> ReconstructionReport:
    """Map a database of any program; it is copied and stays as it is.

    Pairs without two-view geometry are verified; where no images are matched, they are matched by
    their descriptors.

    Args:
        database_path: the database.
        output_path: folder for all results, made if missing.
        image_path: folder of the photographs, for the colours of the points.
        cameras: what is known of the cameras of its images; which images share one stays.
        matches_path: a file of matches (:mod:`colmap_affrect.pairs.given_matches`).
        match_type: what it has, ``raw`` matches or ``inliers``.
        match_list_path: pairs to match by descriptors; None: all.
        mapping: the mapper and its options.
        verification: of pairs that are not verified.
        extend: a model that the images are registered into.
        by_hand: tie points, wrong pairs, photographs to leave out.
        overwrite: discard results that are there.
        page: also write ``report.html``.
        progress: where to show progress.
    """
    database_path, output_path = as_path(database_path), as_path(output_path)
    mapper = MAPPERS.make(mapping or MAPPERS.options(MAPPERS.default))
    schema_version(database_path)  # refuses what is no database before anything is made
    _check_extension(extend, mapper, output_path, overwrite=overwrite)
    if extend:
        read_to_extend(extend.model_path)
    sizes = read_sizes(database_path)
    _check_by_hand(by_hand, read_names(database_path), mapper, sizes.get)
    foreign = ForeignDatabase(
        database_path,
        as_path(image_path) if image_path else None,
        cameras or CameraOptions(),
        as_path(matches_path) if matches_path else None,
        match_type,
        as_path(match_list_path) if match_list_path else None,
    )
    foreign.check()
    context = Context(Workspace(output_path), progress=progress, by_hand=by_hand)
    with context.workspace.locked(), watched(context, follows=False, discards=overwrite):
        chosen = verification or VerificationOptions()
        report = copy_verified(context, foreign, chosen, overwrite=overwrite)
        return map_and_report(context, mapper, extend, earlier=[report], page=page)


def _extended(record: CameraRecord, before: Sequence[str]) -> CameraRecord:
    """Say of a camera that nobody knew but the model that is extended that it is from there."""
    is_known = record.source == "guess" and not set(before).isdisjoint(record.names)
    return replace(record, source="model", lens_mm=0.0) if is_known else record


def map_and_report(
    context: Context,
    mapper: Mapper,
    extend: Extension | None = None,
    *,
    earlier: Sequence[StageReport] = (),
    overwrite: bool = False,
    page: bool = True,
) -> ReconstructionReport:
    """Map a verified workspace and write ``report.json`` and, if wanted, ``report.html``."""
    workspace, options = context.workspace, mapper.options
    names, gone = _names_and_gone(context, may_be_gone=bool(earlier))
    _check_extension(extend, mapper, workspace.path, overwrite=overwrite)
    sizes = read_sizes(workspace.database)
    marks = _check_by_hand(context.by_hand, names, mapper, sizes.get)
    before = existing_names(extend.model_path, names) if extend else []
    report, models = map_images(context, mapper, extend, overwrite=overwrite)
    lost = dict.fromkeys(gone, "is gone since its features were extracted; these are used")
    report = replace(report, warnings={**report.warnings, **lost})
    copied = workspace.is_foreign
    verified = num_verified_inliers(context)
    pair_inliers = {pair: n for pair, n in verified.items() if context.by_hand.allows(*pair)}
    missing = unregistered(context, names, models, pair_inliers)
    again = matched_again(context)
    strongest = max(pair_inliers.values(), default=0)
    result = ReconstructionReport(
        images_total=len(names),
        unregistered=missing,
        models=tuple(models),
        num_pairs=num_matched_pairs(workspace.database) if copied else len(listed_pairs(context)),
        num_verified_pairs=len(pair_inliers),
        stages=summed((*earlier, report)),
        recipe="" if copied else workspace.recipe(),
        versions=installed_versions(),
        preset=options.preset_name,
        verification=context.verification.to_mapping(),
        mapping=options.to_mapping(),
        guided={} if copied else guided_counts(context),
        cameras=_cameras_of(workspace, models, before),
        extended=tuple(before),
        advice=advice(context, missing, models, strongest, again.untried, again.effort),
        by_hand=context.by_hand.texts(),
        effort=again.effort if again.tried or again.untried else "",
        matched_again=again.tried,
        untried=again.untried,
    )
    workspace.page.unlink(missing_ok=True)  # a kill leaves none beside another report
    replace_text(workspace.report, result.to_json())
    if page:
        image_path = workspace.photographs()
        looks, progress = pairs_of_page(context, result, pair_inliers), context.progress
        write_run_page(
            workspace, result, names, pair_inliers, image_path, progress, marks=marks, looks=looks
        )
    return result


def _cameras_of(
    workspace: Workspace, models: Sequence[ModelSummary], before: Sequence[str]
) -> tuple[dict[str, Any], ...]:
    """Return what a report has of the cameras, as the largest model has them.

    Args:
        workspace: with the record of the cameras.
        models: the largest first.
        before: names of the images of the model that was extended.
    """
    largest = models[0] if models else None
    found = list[dict[str, Any]]()
    for camera_id, record in read_camera_records(workspace.cameras).items():
        found.append(_extended(record, before).to_report(camera_id, largest))
    return tuple(found)


def _names_and_gone(context: Context, *, may_be_gone: bool) -> tuple[list[str], list[str]]:
    """Return the names of all photographs, and which are gone since they had features.

    ImageError where none may be gone.
    """
    names = image_names(context)
    if context.workspace.is_foreign:
        return names, []
    gone = sorted(set(context.features.names()) - set(names))
    if gone and not may_be_gone:
        path = context.inputs.image_path
        raise ImageError(f"{path}: {gone[0]} has features, and is gone; run extract again")
    return sorted({*names, *gone}), gone
