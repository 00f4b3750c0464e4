"""Single stages as functions, each from what the stages before have left in the output folder."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Unpack

from colmap_affrect.colmap.by_hand import ByHand
from colmap_affrect.colmap.database import fill_descriptors
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.mappers.existing import Extension, as_extension
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.mend import mend_and_seal
from colmap_affrect.options import takes_fields_of
from colmap_affrect.pairs.lists import PairOptions
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.pipeline import context_of, map_and_report, mapper_of
from colmap_affrect.progress import GivenProgress
from colmap_affrect.project.argument_types import require_bools
from colmap_affrect.project.paths import PathLike, as_path
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.report.run_report import RunReport
from colmap_affrect.session.context import Context, Resources
from colmap_affrect.session.run_options import RunKeywords, RunOptions
from colmap_affrect.stages.extract import extract as extract_features
from colmap_affrect.stages.match import match as match_pairs
from colmap_affrect.stages.pairs import choose_pairs as list_pairs
from colmap_affrect.stages.verify import verify_matches as verify_pairs


@contextmanager
def one_stage(
    name: str, context: Context, *, overwrite: bool = False
) -> Iterator[Context]:
    """Lock the folder of a context for one stage, and bring its database up to date before.

    Args:
        name: of the stage.
        context: of the folder.
        overwrite: the stage discards what is there.
    """
    is_first = name == "extract"
    with (
        context.progress.never_silent(),
        context.workspace.locked(),
        mend_and_seal(
            context,
            follows=not is_first,
            maps=name == "map",
            discards=is_first and overwrite,
        ),
    ):
        yield context


@takes_fields_of(RunOptions)
def extract(
    image_path: PathLike,
    output_path: PathLike,
    options: RunOptions | None = None,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: GivenProgress = None,
    **keywords: Unpack[RunKeywords],
) -> StageReport:
    """Extract features into ``features.h5``, cameras and keypoints into ``database.db``.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: see :func:`run`; those of later stages are kept for these.
        executor: see :func:`run`.
        overwrite: discard results that are there.
        progress: see :func:`run`.
        keywords: see :func:`run`.

    Returns:
        How many images were extracted, and why others were not.
    """
    image_path = as_path(image_path, "image_path")
    options = RunOptions.with_keywords(options, keywords)
    require_bools(overwrite=overwrite)
    inputs = options.inputs(image_path)
    later = options.later_stages()
    context = context_of(output_path, progress, options.resources, executor)
    with one_stage("extract", context, overwrite=overwrite):
        report = extract_features(
            context, inputs, options.recipe, later=later, overwrite=overwrite
        )
        if options.database_descriptors:
            fill_descriptors(context.workspace.database, context.features)
    return report


def choose_pairs(
    output_path: PathLike,
    pairs: PairOptions | Mapping[str, Any] | None = None,
    *,
    overwrite: bool = False,
    progress: GivenProgress = None,
) -> StageReport:
    """Write ``pairs.txt``, which says which images are matched.

    Args:
        output_path: folder that :func:`extract` was given.
        pairs: which; None: as :func:`extract` was told, else all.
        overwrite: discard the results of this and later stages.
        progress: see :func:`run`.
    """
    require_bools(overwrite=overwrite)
    chosen = None if pairs is None else PairOptions.given(pairs, "pairs")
    with one_stage("pairs", context_of(output_path, progress)) as context:
        return list_pairs(context, chosen, overwrite=overwrite)


def match(
    output_path: PathLike,
    matching: MatcherOptions | Mapping[str, Any] | str | None = None,
    *,
    resources: Resources | Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: GivenProgress = None,
) -> StageReport:
    """Match the pairs of ``pairs.txt``, into ``matches.h5`` and ``database.db``.

    Args:
        output_path: folder that :func:`choose_pairs` was given.
        matching: the matcher and its options, or its name; None: that of the recipe.
        resources: weights and device of networks.
        executor: see :func:`run`.
        overwrite: discard the results of this and later stages.
        progress: see :func:`run`.
    """
    require_bools(overwrite=overwrite)
    matcher = None if matching is None else MATCHERS.options(matching, "matching")
    context = context_of(output_path, progress, resources, executor)
    with one_stage("match", context):
        return match_pairs(context, options=matcher, overwrite=overwrite)


def verify(
    output_path: PathLike,
    verification: VerificationOptions | Mapping[str, Any] | None = None,
    *,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: GivenProgress = None,
) -> StageReport:
    """Estimate the two-view geometries of the matched pairs, into ``database.db``.

    Args:
        output_path: folder that :func:`match` was given.
        verification: its options; None: as :func:`extract` was told.
        executor: see :func:`run`.
        overwrite: discard the results of this and later stages.
        progress: see :func:`run`.
    """
    require_bools(overwrite=overwrite)
    chosen = None
    if verification is not None:
        chosen = VerificationOptions.given(verification, "verification")
    context = context_of(output_path, progress, executor=executor)
    with one_stage("verify", context):
        return verify_pairs(context, chosen, overwrite=overwrite)


def map_images(
    output_path: PathLike,
    mapping: MapperOptions | Mapping[str, Any] | str | None = None,
    *,
    extend: Extension | PathLike | None = None,
    by_hand: ByHand | Mapping[str, Any] | None = None,
    overwrite: bool = False,
    page: bool = True,
    progress: GivenProgress = None,
) -> RunReport:
    """Make models of the verified pairs, in ``sparse/0``, ``sparse/1`` and so on.

    Args:
        output_path: folder that :func:`verify` was given.
        mapping: the mapper and its options, or its name; None: as :func:`extract` was told.
        extend: a model that the images are registered into, or its folder.
        by_hand: tie points, wrong pairs, photographs to leave out.
        overwrite: discard the models that are there.
        page: also write ``report.html``.
        progress: see :func:`run`.

    Returns:
        The report that is also written to ``report.json``, with the models.
    """
    require_bools(overwrite=overwrite, page=page)
    extension = as_extension(extend)
    chosen = None if mapping is None else mapper_of(mapping)
    with one_stage(
        "map", context_of(output_path, progress, by_hand=by_hand)
    ) as context:
        mapper = chosen or MAPPERS.make(context.mapping)
        return map_and_report(
            context, mapper, extend=extension, overwrite=overwrite, page=page
        )
