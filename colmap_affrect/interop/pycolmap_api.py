"""Functions with the names and signatures of pycolmap's, for scripts that call those.

``pycolmap.`` becomes ``colmap_affrect.`` in ``extract_features``, ``match_exhaustive`` and
``match_image_pairs``; ``incremental_mapping`` follows, pycolmap's or ours. Arguments of
pycolmap that say how photographs, cameras and pairs are read mean the same; those that describe
SIFT have no meaning here and are refused. What a database has no place for (descriptors, scores,
the record of options) is kept in a folder beside it, ``x.affrect`` for ``x.db``: it makes the
functions go on where an earlier call stopped.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import refuse_unusable
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.initial_cameras import record_cameras
from colmap_affrect.colmap.native_options import differences, flat_values
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.colmap.verification import verify as verify_database
from colmap_affrect.errors import OptionError, PairListError
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.mappers.attempts import map_database
from colmap_affrect.mappers.base import MAPPERS, MapperOptions, MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.options import CUSTOM, Options, flat, suggestion
from colmap_affrect.pairs.base import Pair
from colmap_affrect.pairs.lists import exhaustive_pairs, read_pairs
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.report import StageReport
from colmap_affrect.project.workspace import Workspace, temporary_folder
from colmap_affrect.recipes import ExtractionOptions, Recipe, load_recipe
from colmap_affrect.stages.cameras import hold_vote
from colmap_affrect.stages.context import Context, Resources
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.extract import Inputs, extract, recorded_extraction, write_descriptors
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import add_pairs
from colmap_affrect.stages.verify import verify_matches

AnyOptions = TypeVar("AnyOptions", bound=Options)
PathLike = Path | str
GivenMatching = MatcherOptions | Mapping[str, Any] | None
GivenVerification = VerificationOptions | pycolmap.TwoViewGeometryOptions | Mapping[str, Any] | None


def extract_features(
    database_path: PathLike,
    image_path: PathLike,
    image_names: Sequence[str] = (),
    camera_mode: pycolmap.CameraMode | str = "auto",
    reader_options: pycolmap.ImageReaderOptions | Mapping[str, Any] | None = None,
    extraction_options: ExtractionOptions | Mapping[str, Any] | str = "default",
    device: pycolmap.Device | str = "auto",
    *,
    from_database: PathLike | None = None,
    weights_path: PathLike | None = None,
    database_descriptors: bool = False,
    progress: Progress = SILENT,
) -> StageReport:
    """Extract rectified features of photographs into a COLMAP database.

    Images that have features already are passed over. One that cannot be read is named in the
    report, and the others go on. Raises AffrectError for anything that the caller can mend.

    Args:
        database_path: made if it is missing; one that has features of another program is refused.
        image_path: folder of the photographs.
        image_names: names below it; all images by default.
        camera_mode: which images share a camera, as in pycolmap.
        reader_options: as in pycolmap, with camera model and parameters, and masks.
        extraction_options: name of a recipe, its path, its sections, or options.
        device: where networks run.
        from_database: begin ``database_path`` with the images, cameras, rigs, frames and pose
            priors of this one, which stays as it is.
        weights_path: folder with the weights of networks.
        database_descriptors: write descriptors too, as COLMAP's matchers need them.
        progress: where to show progress.
    """
    cameras, masks = _reader_options(reader_options, camera_mode)
    inputs = Inputs.of(
        Path(image_path),
        from_database=Path(from_database) if from_database else None,
        cameras=cameras,
        masks=masks,
    )
    with _context(database_path, device, weights_path, progress) as context:
        report = extract(context, inputs, _recipe(extraction_options), image_names=image_names)
        if database_descriptors:
            write_descriptors(context)
    return report


def match_exhaustive(
    database_path: PathLike,
    matching_options: GivenMatching = None,
    pairing_options: pycolmap.ExhaustivePairingOptions | None = None,  # noqa: ARG001
    verification_options: GivenVerification = None,
    device: pycolmap.Device | str = "auto",
    *,
    random_seed: int | None = None,
    weights_path: PathLike | None = None,
    progress: Progress = SILENT,
) -> tuple[StageReport, ...]:
    """Match and verify all pairs of the images that :func:`extract_features` was given.

    ``matching_options`` are by default those of the recipe; ``verification_options`` are ours, or
    those of pycolmap that have a counterpart, and ``random_seed`` wins over theirs.
    ``pairing_options`` are accepted for pycolmap's sake: the size of blocks does not change
    results. For recipes that escalate, ``device`` is that of networks too, and ``weights_path`` has
    their weights.
    """
    verification = _verification_options(verification_options, random_seed)
    with _context(database_path, device, weights_path, progress) as context:
        pairs = exhaustive_pairs(context.features.names())
        return _match(context, pairs, matching_options, verification)


def match_image_pairs(
    database_path: PathLike,
    matching_options: GivenMatching = None,
    pairing_options: pycolmap.ImportedPairingOptions | Mapping[str, Any] | None = None,
    verification_options: GivenVerification = None,
    device: pycolmap.Device | str = "auto",
    *,
    random_seed: int | None = None,
    weights_path: PathLike | None = None,
    progress: Progress = SILENT,
) -> tuple[StageReport, ...]:
    """Match and verify the pairs of a list; arguments are those of :func:`match_exhaustive`.

    But ``pairing_options`` are needed, with ``match_list_path``, a file of two names per line.
    Raises PairListError without one, or when it names images without features.
    """
    verification = _verification_options(verification_options, random_seed)
    list_path = _match_list_path(pairing_options)
    with _context(database_path, device, weights_path, progress) as context:
        pairs = read_pairs(list_path, context.features.names())
        return _match(context, pairs, matching_options, verification)


def verify(
    database_path: PathLike,
    options: GivenVerification = None,
    *,
    pairs_path: PathLike | None = None,
    check_cameras: bool = False,
    random_seed: int | None = None,
) -> None:
    """Estimate the two-view geometries of the matched pairs of any database that lack one.

    As ``pycolmap.geometric_verification``, with the preset for sparse sets (or ``options``, ours or
    those of pycolmap that have a counterpart). Every match is checked first, because one that
    points at no keypoint ends the process inside COLMAP: DatabaseError. ``pairs_path`` lists the
    pairs to verify, two names per line; all by default. With ``check_cameras`` all verified pairs
    vote on cameras whose focal length is no prior; those that they know become priors.
    """
    path = Path(database_path)
    verification = _verification_options(options, random_seed)
    refuse_unusable(path)
    if pairs_path is None:
        verify_database(path, verification)
    else:
        _verify_pairs(path, read_pairs(Path(pairs_path), list(image_ids(path))), verification)
    if check_cameras:
        with temporary_folder(path.parent) as folder:
            records = folder / "cameras.json"
            record_cameras(path, records)
            hold_vote(path, records, verification, may_share=False)


def _verify_pairs(path: Path, pairs: Sequence[Pair], verification: VerificationOptions) -> None:
    """Verify in a copy that has the matches of these pairs only, and take over what is found."""
    ids = image_ids(path)
    wanted = {(min(pair), max(pair)) for pair in ((ids[one], ids[two]) for one, two in pairs)}
    with temporary_folder(path.parent) as folder:
        copy = folder / "database.db"
        copy_database(path, copy)
        with open_database(copy) as database:
            for pair_id in database.read_num_matches()[0]:
                pair = pycolmap.pair_id_to_image_pair(pair_id)
                if pair not in wanted:
                    database.delete_matches(*pair)
        verify_database(copy, verification)
        with open_database(copy) as verified, open_database(path) as database:
            for pair in sorted(wanted):
                if database.exists_two_view_geometry(*pair):
                    continue
                if verified.exists_two_view_geometry(*pair):
                    geometry = verified.read_two_view_geometry(*pair)
                    database.write_two_view_geometry(*pair, geometry)


def incremental_mapping(
    database_path: PathLike,
    image_path: PathLike,
    output_path: PathLike,
    options: pycolmap.IncrementalPipelineOptions | Mapping[str, Any] | None = None,
    input_path: PathLike = "",
    initial_image_pair_callback: Callable[[], None] | None = None,
    next_image_callback: Callable[[], None] | None = None,
    cancellation_token: pycolmap.CancellationToken | None = None,
) -> dict[int, pycolmap.Reconstruction]:
    """Map any verified database by our mapper and write the models as pycolmap does.

    Args:
        database_path: COLMAP database with two-view geometries.
        image_path: folder of the photographs, for the colours of the points; empty for none.
        output_path: models are written to 0, 1, ... in it, or, with ``input_path``, into it.
        options: what differs from pycolmap's defaults wins over our preset for sparse sets.
        input_path: a model to be extended. Its poses and cameras stay with ``fix_existing_frames``.
        initial_image_pair_callback: called when a first pair is registered.
        next_image_callback: called for every further image.
        cancellation_token: stops mapping when it is cancelled, by InterruptedError as in pycolmap.

    Returns:
        The models by the number of their folder, largest first.
    """
    native = _pipeline_options(options)
    mapper = MAPPERS.make(_mapper_options(native))
    database, output = Path(database_path), Path(output_path)
    refuse_unusable(database)
    existing = None
    if _given_path(input_path):
        extension = Extension(Path(input_path), refine_existing=not native.fix_existing_frames)
        existing = read_existing(extension, database)
    task = MappingTask(
        database,
        Path(image_path) if str(image_path) else None,
        extend=existing,
        cancellation=cancellation_token,
    )
    callbacks = _Callbacks(initial_image_pair_callback, next_image_callback, existing is not None)
    output.mkdir(parents=True, exist_ok=True)
    with temporary_folder(output) as folder:
        found = folder / "sparse"
        try:
            map_database(mapper, task, found, callbacks.show)
        except KeyboardInterrupt as error:
            if cancellation_token and cancellation_token.is_cancelled:
                raise InterruptedError("Operation cancelled") from error
            raise
        models = {int(path.name): pycolmap.Reconstruction(path) for path in found.iterdir()}
        for index in models:
            target = output if existing else output / str(index)
            shutil.copytree(found / str(index), target, dirs_exist_ok=True)
    return dict(sorted(models.items()))


@dataclass
class _Callbacks:
    """pycolmap's callbacks, told of numbers of registered images."""

    begun: Callable[[], None] | None
    following: Callable[[], None] | None
    extends: bool
    count: int = 0

    def show(self, number: int) -> None:
        first = 0
        if not self.count:
            first = number if self.extends else min(number, 2)
            if self.begun:
                self.begun()
        self.count += number
        for _ in range(number - first):
            if self.following:
                self.following()


def _pipeline_options(given: object) -> pycolmap.IncrementalPipelineOptions:
    if isinstance(given, pycolmap.IncrementalPipelineOptions):
        return given
    if given is not None and not isinstance(given, Mapping):
        raise OptionError(f"options: {type(given).__name__} does not apply here")
    try:
        return pycolmap.IncrementalPipelineOptions(dict(given or {}))
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise OptionError(f"options: {' '.join(str(error).split())}") from error


SET_OTHERWISE = ("random_seed", "image_path", "fix_existing_frames")
"""Options of pycolmap's mapper, in any section, that reach ours by other ways."""


def _mapper_options(native: pycolmap.IncrementalPipelineOptions) -> MapperOptions:
    """Translate what differs from pycolmap's defaults into options of our mapper."""
    usual = pycolmap.IncrementalPipelineOptions()
    known = flat_values(usual)
    for key, value in flat_values(native).items():
        if isinstance(value, list | set) and value != known[key]:
            raise OptionError(f"options: {key}={value} cannot be carried over")
    values = differences(native, usual)
    seed = {"random_seed": native.random_seed} if "random_seed" in values else {}
    kept = {k: v for k, v in values.items() if k.rpartition(".")[2] not in SET_OTHERWISE}
    options: MapperOptions = MAPPERS.options(
        {"name": MAPPERS.default, **seed, "mapper_options": kept}, where="options"
    )
    return options


@contextmanager
def _context(
    database_path: PathLike,
    device: pycolmap.Device | str,
    weights_path: PathLike | None,
    progress: Progress,
) -> Iterator[Context]:
    """Lock the folder beside a database and return what the stages work with."""
    weights = Path(weights_path) if weights_path else None
    resources = Resources(weights, str(getattr(device, "name", device)))
    with Workspace.beside(Path(database_path)).locked() as workspace:
        yield Context(workspace, resources, progress=progress)


def _match(
    context: Context,
    pairs: Sequence[Pair],
    matching_options: GivenMatching,
    verification: VerificationOptions,
) -> tuple[StageReport, ...]:
    matching = None
    if isinstance(matching_options, Mapping):
        matching = MATCHERS.options(matching_options, where="matching_options")
    elif isinstance(matching_options, MatcherOptions):
        matching = matching_options
    elif matching_options is not None:
        raise _not_ours(matching_options, "matching_options", "NearestOptions")
    add_pairs(context, pairs)
    reports = [match(context, matching), verify_matches(context, verification)]
    if recorded_extraction(context.workspace).escalation:
        reports.append(escalate(context))
    return tuple(reports)


def _recipe(options: ExtractionOptions | Mapping[str, Any] | str) -> Recipe:
    if isinstance(options, str):
        return load_recipe(options)
    if isinstance(options, Mapping):
        return Recipe.from_mapping(CUSTOM, options, "extraction_options")
    return Recipe(CUSTOM, extraction=_options(options, ExtractionOptions, "extraction_options"))


def _options(given: object, kind: type[AnyOptions], argument: str) -> AnyOptions:
    if isinstance(given, kind):
        return given
    if isinstance(given, Mapping):
        return kind.from_mapping(given, argument)
    raise _not_ours(given, argument, kind.__name__)


def _not_ours(given: object, argument: str, name: str) -> OptionError:
    return OptionError(
        f"{argument}: {type(given).__name__} does not apply here; give colmap_affrect.{name} or a "
        "dictionary"
    )


def _verification_options(given: object, random_seed: int | None) -> VerificationOptions:
    seed: dict[str, Any] = {} if random_seed is None else {"random_seed": random_seed}
    if given is None:
        return VerificationOptions(**seed)
    if not isinstance(given, pycolmap.TwoViewGeometryOptions):
        return _options(given, VerificationOptions, "verification_options").changed(**seed)
    values, usual = (flat(o.todict()) for o in (given, pycolmap.TwoViewGeometryOptions()))
    for key, value in values.items():
        if key not in VERIFICATION_NAMES and value != usual[key]:
            raise OptionError(f"verification_options: {key}={value} cannot be carried over")
    ours = {name: values[key] for key, name in VERIFICATION_NAMES.items()}
    return VerificationOptions.preset("colmap", **{**ours, **seed})


VERIFICATION_NAMES = {
    "min_num_inliers": "min_num_inliers",
    "min_inlier_ratio": "min_inlier_ratio",
    "ransac.max_error": "max_error_px",
    "ransac.max_num_trials": "max_num_trials",
    "ransac.min_inlier_ratio": "ransac_min_inlier_ratio",
}
"""Names in pycolmap's TwoViewGeometryOptions and in ours."""


def _reader_options(given: object, camera_mode: object) -> tuple[CameraOptions, MaskOptions]:
    usual = pycolmap.ImageReaderOptions().todict()
    values = given.todict() if isinstance(given, pycolmap.ImageReaderOptions) else given or {}
    if not isinstance(values, Mapping):
        raise OptionError(f"reader_options: expected options, got {given!r}")
    for key in values:
        if key not in usual:
            raise OptionError(f"reader_options: unknown option '{key}'{suggestion(key, usual)}")
    known = {**usual, **values}
    mode = str(getattr(camera_mode, "name", camera_mode)).lower().replace("_", "-")
    given_cameras = {
        "mode": mode,
        "model": str(known["camera_model"]),
        "params": str(known["camera_params"]),
        "default_focal_length_factor": known["default_focal_length_factor"],
        "existing_camera_id": known["existing_camera_id"],
    }
    cameras = CameraOptions.from_mapping(given_cameras, "camera_mode, reader_options")
    return cameras, MaskOptions(
        path=_given_path(known["mask_path"]), camera_path=_given_path(known["camera_mask_path"])
    )


def _given_path(path: PathLike) -> str:
    """Return an absolute path, or nothing for pycolmap's '.', which stands for none."""
    return "" if Path(path) == Path() else str(Path(path).resolve())


def _match_list_path(given: object) -> Path:
    if isinstance(given, Mapping):
        path = given.get("match_list_path", "")
    else:
        path = getattr(given, "match_list_path", "")
    if Path(path) == Path():
        raise PairListError("pairing_options: give match_list_path, a file with two names per line")
    return Path(path)
