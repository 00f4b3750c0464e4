"""Functions with the names and signatures of pycolmap's, for scripts that call those.

Options that describe SIFT keep their defaults or are refused (:mod:`.pycolmap_options`). What a
database has no place for is kept in a folder beside it, ``x.affrect`` for ``x.db``, with which the
functions go on where an earlier call stopped.
"""

import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from typing import Any

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_cancellable
from colmap_affrect.colmap.checks import (
    FATAL_AS_IT_IS,
    FATAL_BEFORE_MAPPING,
    refuse_unusable,
)
from colmap_affrect.colmap.database import (
    generated_pairs,
    image_ids,
    open_database,
    spatial_pairs,
)
from colmap_affrect.colmap.database_verification import verify as verify_database
from colmap_affrect.colmap.verification import VerificationOptions, two_view_options
from colmap_affrect.errors import AffrectError, OptionError, such_as
from colmap_affrect.escalation.escalate import escalate
from colmap_affrect.interop import pycolmap_options as translate
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.matchers.base import MatcherOptions
from colmap_affrect.matchers.guided import GuidedOptions
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.mend import mend_and_seal
from colmap_affrect.pairs.lists import Pair, exhaustive_pairs, read_pairs
from colmap_affrect.pairs.retrieval import retrieved_pairs
from colmap_affrect.parallel.executor import Threads
from colmap_affrect.progress import SILENT, Advance, GivenProgress, Progress
from colmap_affrect.project.argument_types import require_type
from colmap_affrect.project.outputs import new_results, temporary_folder
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none
from colmap_affrect.project.stage_report import StageReport
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.session.context import Context, Inputs, Resources
from colmap_affrect.session.database_export import write_images_and_keypoints
from colmap_affrect.stages import verify as verify_stage
from colmap_affrect.stages.descriptors import described_images, match_database
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import add_pairs

CANCELLED = "Operation cancelled"  # what pycolmap says

# Nested dictionaries are taken for all options of pycolmap
Native = Mapping[str, Any] | None
GivenMatching = pycolmap.FeatureMatchingOptions | MatcherOptions | Native
GivenVerification = VerificationOptions | pycolmap.TwoViewGeometryOptions | Native
Token = pycolmap.CancellationToken | None
Callback = Callable[[], None] | None
Reports = tuple[StageReport, ...]


@dataclass(frozen=True)
class _Images:
    """Images that pairs are chosen of."""

    context: Context
    names: Sequence[str]  # of those that can be matched


Choose = Callable[[_Images, Any], Iterable[Pair]]
"""Takes pycolmap's pairing options, too."""


def extract_features(  # noqa: PLR0913 (arguments are those of pycolmap)
    database_path: PathLike,
    image_path: PathLike,
    image_names: Iterable[PathLike] = (),
    camera_mode: pycolmap.CameraMode | str = "auto",
    reader_options: pycolmap.ImageReaderOptions | Native = None,
    extraction_options: (
        pycolmap.FeatureExtractionOptions | ExtractionOptions | Native | str
    ) = "default",
    device: pycolmap.Device | str = "auto",
    cancellation_token: Token = None,
    *,
    from_database: PathLike | None = None,
    weights_path: PathLike | None = None,
    progress: GivenProgress = None,
) -> StageReport:
    """Extract rectified features of photographs into a COLMAP database.

    Images that have features already are passed over. One that cannot be read is named in the
    report, and warned of (UserWarning).

    Args:
        database_path: the database, which may be new.
        image_path: folder of the photographs.
        image_names: of some of them; by default all.
        camera_mode: as in pycolmap.
        reader_options: what pycolmap's say of cameras and masks.
        extraction_options: a recipe by name or path, or our options; of pycolmap's, the image size
            and where the work is done.
        device: that networks run on.
        cancellation_token: stops by InterruptedError; what is done is kept.
        from_database: begin the database with the images, cameras, rigs, frames and pose priors
            of this one, which stays as it is.
        weights_path: folder with weights of networks.
        progress: True, False, or None for where somebody looks at it.

    Returns:
        How many images were extracted, and why others were not.

    Raises:
        AffrectError: for anything that the caller can mend.
    """
    cameras, masks = translate.reader_options(reader_options, camera_mode)
    original = as_path_or_none(from_database, "from_database")
    inputs = Inputs.of(
        as_path(image_path, "image_path"),
        from_database=original,
        cameras=cameras,
        masks=masks,
    )
    recipe, asked = translate.extraction_recipe(extraction_options)
    require_type("image_names", image_names, kind=Iterable[PathLike])
    shown = _Cancellable(Progress.given(progress), cancellation_token)
    with _context(database_path, device, asked, weights_path, shown) as context:
        report = extract(context, inputs, recipe, image_names=list(image_names))
    if report.failures:  # a script of pycolmap does not look at the report
        first, *_ = report.failures.values()
        warnings.warn(
            f"left out: {such_as(report.failures)}; the first: {first}", stacklevel=2
        )
    return report


def _matching(kind: type) -> Callable[[Choose], Callable[..., Reports]]:
    """Make a function that matches and verifies the pairs that another one chooses."""

    def decorate(choose: Choose) -> Callable[..., Reports]:
        def matched(
            database_path: PathLike,
            matching_options: GivenMatching = None,
            pairing_options: object = None,
            verification_options: GivenVerification = None,
            device: pycolmap.Device | str = "auto",
            cancellation_token: Token = None,
            *,
            random_seed: int | None = None,
            weights_path: PathLike | None = None,
            progress: GivenProgress = None,
        ) -> Reports:
            """Arguments are those of pycolmap, and a few more.

            Args:
                database_path: the database.
                matching_options: those of pycolmap or ours; by default those of the recipe.
                pairing_options: those of pycolmap.
                verification_options: those of pycolmap or ours.
                device: that networks run on.
                cancellation_token: stops by InterruptedError; what is done is kept.
                random_seed: of verification.
                weights_path: folder with weights of networks.
                progress: True, False, or None for where somebody looks at it.

            Returns:
                What each stage did.
            """
            pairing: Any = translate.native(pairing_options, kind, "pairing_options")
            verification = translate.verification_options(
                verification_options, random_seed
            )
            matching, asked = translate.matching_options(matching_options)
            shown = _Cancellable(Progress.given(progress), cancellation_token)
            with _context(database_path, device, asked, weights_path, shown) as context:
                names = _described(context)
                if names:
                    pairs = choose(_Images(context, names), pairing)
                    return _match_descriptors(
                        context, pairs, matching, verification, asked
                    )
                context.workspace.require("extract")
                write_images_and_keypoints(context)
                pairs = choose(_Images(context, context.features.names()), pairing)
                return _match(
                    context, pairs, matching, verification, asked, cancellation_token
                )

        matched.__name__ = matched.__qualname__ = choose.__name__
        texts = (choose.__doc__ or "", matched.__doc__ or "")
        matched.__doc__ = "\n\n".join(map(cleandoc, texts))
        return matched

    return decorate


@_matching(pycolmap.ExhaustivePairingOptions)
def match_exhaustive(
    images: _Images, _: pycolmap.ExhaustivePairingOptions
) -> Iterable[Pair]:
    """Match and verify all pairs of the images that :func:`extract_features` was given."""
    return exhaustive_pairs(images.names)


@_matching(pycolmap.SequentialPairingOptions)
def match_sequential(
    images: _Images, options: pycolmap.SequentialPairingOptions
) -> list[Pair]:
    """Match images that follow each other by name.

    With ``loop_detection`` also images that are alike as a whole, which needs no vocabulary tree:
    as many as ``loop_detection_num_images`` of every ``loop_detection_period``th image.
    """
    context = images.context
    num_alike = math.ceil(
        options.loop_detection_num_images / max(1, options.loop_detection_period)
    )
    in_order = type(options)({**options.todict(), "loop_detection": False})
    path = context.workspace.database
    pairs = generated_pairs(path, pycolmap.SequentialPairGenerator, in_order)
    if options.loop_detection:
        context.workspace.require("extract")
        names = [
            name for name, count in context.features.num_keypoints().items() if count
        ]
        pairs += retrieved_pairs(
            names, context.features.read, num_alike, context.progress
        )
    return pairs


@_matching(pycolmap.SpatialPairingOptions)
def match_spatial(
    images: _Images, options: pycolmap.SpatialPairingOptions
) -> list[Pair]:
    """Match images near to each other; DatabaseError when fewer than two have a position."""
    return spatial_pairs(images.context.workspace.database, options)


@_matching(pycolmap.ImportedPairingOptions)
def match_image_pairs(
    images: _Images, options: pycolmap.ImportedPairingOptions
) -> Iterable[Pair]:
    """Match and verify the pairs of a list, ``match_list_path``, a file of two names per line.

    Raises AffrectError without one, or when it names images without features.
    """
    path = translate.given_path(options.match_list_path)
    if not path:
        raise AffrectError(
            "give match_list_path, a file with two names per line",
            where="pairing_options",
        )
    return read_pairs(Path(path), images.names)


def _described(context: Context) -> list[str]:
    """Return the images with descriptors of a database that no function of ours has filled."""
    workspace = context.workspace
    if "extract" in workspace.started_stages or not workspace.database.exists():
        return []
    return described_images(workspace.database)


def _match_descriptors(
    context: Context,
    pairs: Iterable[Pair],
    matching: MatcherOptions | None,
    verification: VerificationOptions,
    asked: Mapping[str, Any],
) -> Reports:
    """Match and verify pairs of images by the descriptors that another program has made."""
    nearest = matching if isinstance(matching, NearestOptions) else None
    if matching and not nearest:
        raise OptionError(
            "descriptors of a database take NearestOptions alone",
            where="matching_options",
        )
    refused = sorted(asked.keys() & {"guided_matching", "rig_verification"})
    if refused:
        raise OptionError("not for descriptors of another program", where=refused[0])
    path = context.workspace.database
    begun = time.perf_counter()
    refuse_unusable(path)
    listed = list(pairs)
    if asked.get("skip_image_pairs_in_same_frame"):
        listed = _of_different_frames(path, listed)
    num = match_database(path, listed, nearest, progress=context.progress)
    between = time.perf_counter()
    reports = [StageReport("match", between - begun, num, len(listed) - num)]
    if not asked.get("skip_geometric_verification"):
        with context.progress.stage("verify", num, "pairs") as advance:
            verify_database(path, verification, advance=advance)
        reports.append(StageReport("verify", time.perf_counter() - between, num, 0))
    return tuple(reports)


def _match(
    context: Context,
    pairs: Iterable[Pair],
    matching: MatcherOptions | None,
    verification: VerificationOptions,
    asked: Mapping[str, Any],
    token: Token,
) -> Reports:
    """Match and verify pairs, and do what pycolmap's options ask for besides."""
    known = set(context.features.names())
    pairs = [pair for pair in pairs if known.issuperset(pair)]
    if asked.get("skip_image_pairs_in_same_frame"):
        pairs = _of_different_frames(context.workspace.database, pairs)
    add_pairs(context, pairs)
    reports = [match(context, matching)]
    if asked.get("skip_geometric_verification"):
        return tuple(reports)
    reports.append(verify_stage.verify_matches(context, verification))
    if context.extraction.escalation:
        reports.append(escalate(context))
    if asked.get("rig_verification"):
        rigs = pycolmap.GeometricVerifierOptions(rig_verification=True)
        path = context.workspace.database
        native = two_view_options(verification)
        run_cancellable(
            lambda token: pycolmap.geometric_verification(
                path, rigs, two_view_geometry_options=native, cancellation_token=token
            ),
            token,
        )
    if asked.get("guided_matching"):
        reports.append(guide(context, GuidedOptions(enabled="always")))
    return tuple(reports)


def verify_matches(
    database_path: PathLike,
    pairs_path: PathLike | None = None,
    options: GivenVerification = None,
    cancellation_token: Token = None,
) -> None:
    """Estimate the two-view geometries of the matched pairs of a list that lack one.

    Args:
        database_path: any database.
        pairs_path: list of two names per line; None stands for all pairs.
        options: ours, or those of pycolmap that have a counterpart; None for the preset for sparse
            sets.
        cancellation_token: stops by InterruptedError; what is done is kept.

    Raises:
        DatabaseError: a match points at no keypoint.
    """
    path = as_path(database_path, "database_path")
    pairs = None
    verification = translate.verification_options(options, None)
    refuse_unusable(path, FATAL_BEFORE_MAPPING, warns=True)
    with _Cancellable(SILENT, cancellation_token).stage(
        "verify", 0, "pairs"
    ) as advance:
        if pairs_path is not None:
            ids = image_ids(path)
            pairs = set[tuple[int, int]]()
            for first, second in read_pairs(
                as_path(pairs_path, "pairs_path"), list(ids)
            ):
                pairs.add((min(ids[first], ids[second]), max(ids[first], ids[second])))
        verify_database(path, verification, advance=advance, pairs=pairs)


def _of_different_frames(path: Path, pairs: Sequence[Pair]) -> list[Pair]:
    """Leave out pairs of images that were taken at once; one without a frame is on its own."""
    with open_database(path) as database:
        frames = {
            image.name: image.frame_id if image.has_frame_id() else image.name
            for image in database.read_all_images()
        }
    return [
        (first, second) for first, second in pairs if frames[first] != frames[second]
    ]


def incremental_mapping(
    database_path: PathLike,
    image_path: PathLike,
    output_path: PathLike,
    options: pycolmap.IncrementalPipelineOptions | Native = None,
    input_path: PathLike = "",
    initial_image_pair_callback: Callback = None,
    next_image_callback: Callback = None,
    cancellation_token: Token = None,
) -> dict[int, pycolmap.Reconstruction]:
    """Map any verified database by our mapper and write the models as pycolmap does.

    Args:
        database_path: the database.
        image_path: folder of the photographs, for the colours of the points.
        output_path: models are written to 0, 1, ... in it, or, with ``input_path``, into it.
        options: those that differ from pycolmap's defaults, or that a dictionary names, win over
            our preset for sparse sets.
        input_path: a model to be extended.
        initial_image_pair_callback: is called when the first images are registered.
        next_image_callback: is called for each further image.
        cancellation_token: stops by InterruptedError.

    Returns:
        The models by the number of their folder, largest first.
    """
    native = translate.native(options, pycolmap.IncrementalPipelineOptions, "options")
    mapper = MAPPERS.make(translate.mapper_options(options))
    database = as_path(database_path, "database_path")
    output = as_path(output_path, "output_path")
    refuse_unusable(database, FATAL_AS_IT_IS)
    with temporary_folder(output) as folder:
        existing = None
        if translate.given_path(input_path):
            extension = Extension(
                model_path=as_path(input_path),
                refine_existing=not native.fix_existing_frames,
            )
            existing = read_existing(extension, database)
        task = MappingTask(
            database,
            as_path_or_none(image_path, "image_path"),
            extend=existing,
            cancellation=cancellation_token,
        )
        extends = existing is not None
        show = _calling(
            initial_image_pair_callback, next_image_callback, extends=extends
        )
        try:
            map_database(mapper, task, folder / "sparse", show)
        except KeyboardInterrupt as error:
            if cancellation_token and cancellation_token.is_cancelled:
                raise InterruptedError(CANCELLED) from error
            raise
        return _written(folder / "sparse", output, extends=extends)


def _written(
    found: Path, output: Path, *, extends: bool
) -> dict[int, pycolmap.Reconstruction]:
    """Read models and move their files to where pycolmap writes them."""
    models = {int(path.name): pycolmap.Reconstruction(path) for path in found.iterdir()}
    files = list(found.glob("*/*"))
    targets = []
    for path in files:
        folder = output if extends else output / path.parent.name
        targets.append(folder / path.name)
    with new_results(*targets, replaces=True) as made:
        for path, new in zip(files, made, strict=True):
            path.replace(new)
    return dict(sorted(models.items()))


def _calling(
    begun: Callback, following: Callback, *, extends: bool
) -> Callable[[int], None]:
    """Return what calls pycolmap's callbacks for a number of newly registered images.

    The first are a pair, or all images of the model that is extended: that is one call.
    """
    is_first = True

    def show(number: int) -> None:
        nonlocal is_first
        calls = [following] * number
        if is_first:
            calls = [begun] if extends else [begun, *calls[2:]]
        is_first = False
        for call in filter(None, calls):
            call()

    return show


class _Cancellable(Progress):
    """Shows progress as another does, and raises InterruptedError once a token is cancelled."""

    def __init__(self, shown: Progress, token: Token) -> None:
        super().__init__()
        self._shown = shown
        self._token = token

    @contextmanager
    def stage(
        self, name: str, total: int, unit: str, part: str = ""
    ) -> Iterator[Advance]:
        """Show a stage, and look at the token whenever something is done.

        Args:
            name: of the stage.
            total: number of steps.
            unit: what the steps are.
            part: what is done in this stage now.

        Raises:
            InterruptedError: the token is cancelled.
        """
        self._check()
        with self._shown.stage(name, total, unit, part) as advance:

            def advance_or_end(count: int) -> None:
                advance(count)
                self._check()

            yield advance_or_end

    def _check(self) -> None:
        if self._token and self._token.is_cancelled:
            raise InterruptedError(CANCELLED)


@contextmanager
def _context(
    database_path: PathLike,
    device: pycolmap.Device | str,
    asked: Mapping[str, Any],
    weights_path: PathLike | None,
    progress: Progress,
) -> Iterator[Context]:
    """Lock the folder beside a database and return what the stages work with."""
    weights = as_path_or_none(weights_path, "weights_path")
    resources = Resources(
        weights_path=weights, device=str(getattr(device, "name", device))
    )
    threads = asked.get("num_threads", -1)
    executor = Threads(threads) if threads > 0 else None
    with Workspace.beside(
        as_path(database_path, "database_path")
    ).locked() as workspace:
        context = Context(workspace, resources, executor, progress)
        with mend_and_seal(context):
            yield context
