"""Functions with the names and signatures of pycolmap's, for scripts that call those.

``pycolmap.`` becomes ``colmap_affrect.`` in ``extract_features``, ``match_exhaustive`` and
``match_image_pairs``, and ``pycolmap.incremental_mapping`` follows unchanged. Arguments of
pycolmap that say how photographs, cameras and pairs are read mean the same; those that describe
SIFT have no meaning here and are refused. What a database has no place for (descriptors, scores,
the record of options) is kept in a folder beside it, ``x.affrect`` for ``x.db``: it makes the
functions go on where an earlier call stopped.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect import stages
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import refuse_wrong_matches
from colmap_affrect.colmap.verification import verify as verify_database
from colmap_affrect.errors import OptionError, PairListError
from colmap_affrect.escalation import escalate
from colmap_affrect.extraction import Resources
from colmap_affrect.matching.pairs import Pair, exhaustive_pairs, read_pairs
from colmap_affrect.options import (
    CameraOptions,
    ExtractionOptions,
    MaskOptions,
    MatchingOptions,
    Options,
    VerificationOptions,
    flat,
)
from colmap_affrect.outcomes import StageReport
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.workspace import Workspace

AnyOptions = TypeVar("AnyOptions", bound=Options)
PathLike = Path | str
GivenMatching = MatchingOptions | Mapping[str, Any] | None
GivenVerification = VerificationOptions | pycolmap.TwoViewGeometryOptions | Mapping[str, Any] | None

CUSTOM = "custom"
"""Name on record of options that are no recipe."""


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
    report, and the others go on.

    Args:
        database_path: database, made if it is missing. One that has features of another program
            is refused; see ``from_database``.
        image_path: folder of the photographs.
        image_names: names below it; all images by default.
        camera_mode: which images share a camera, as in pycolmap.
        reader_options: as in pycolmap, with camera model and parameters, and masks.
        extraction_options: name of a recipe, its path, or options.
        device: where networks run.
        from_database: begin ``database_path`` with the images, cameras, rigs, frames and pose
            priors of this one, which stays as it is.
        weights_path: folder with the weights of networks.
        database_descriptors: write descriptors too, as COLMAP's matchers need them.
        progress: where to show progress.

    Raises:
        AffrectError: for anything that the caller can mend; what is done stays.
    """
    cameras, masks = _reader_options(reader_options, camera_mode)
    with Workspace.beside(Path(database_path)).locked() as workspace:
        report = stages.extract(
            workspace,
            Path(image_path),
            _recipe(extraction_options),
            cameras,
            masks=masks,
            image_names=image_names,
            from_database=Path(from_database) if from_database else None,
            resources=_resources(device, weights_path),
            progress=progress,
        )
        if database_descriptors:
            stages.write_descriptors(workspace)
    return report


def match_exhaustive(
    database_path: PathLike,
    matching_options: GivenMatching = None,
    pairing_options: pycolmap.ExhaustivePairingOptions | None = None,  # noqa: ARG001
    verification_options: GivenVerification = None,
    device: pycolmap.Device | str = "auto",
    *,
    random_seed: int = 0,
    weights_path: PathLike | None = None,
    progress: Progress = SILENT,
) -> tuple[StageReport, ...]:
    """Match and verify all pairs of the images that :func:`extract_features` was given.

    Args:
        database_path: that of :func:`extract_features`.
        matching_options: by default those of the recipe.
        pairing_options: accepted for pycolmap's sake; the size of blocks does not change results.
        verification_options: ours, or those of pycolmap that have a counterpart.
        device: where networks run, for recipes that escalate.
        random_seed: of verification.
        weights_path: folder with the weights of networks, for recipes that escalate.
        progress: where to show progress.
    """
    verification = _verification_options(verification_options)
    resources = _resources(device, weights_path)
    with Workspace.beside(Path(database_path)).locked() as workspace:
        pairs = exhaustive_pairs(stages.feature_store(workspace).names())
        return _match(
            workspace, pairs, matching_options, verification, random_seed, resources, progress
        )


def match_image_pairs(
    database_path: PathLike,
    matching_options: GivenMatching = None,
    pairing_options: pycolmap.ImportedPairingOptions | Mapping[str, Any] | None = None,
    verification_options: GivenVerification = None,
    device: pycolmap.Device | str = "auto",
    *,
    random_seed: int = 0,
    weights_path: PathLike | None = None,
    progress: Progress = SILENT,
) -> tuple[StageReport, ...]:
    """Match and verify the pairs of a list; see :func:`match_exhaustive`.

    Args:
        database_path: that of :func:`extract_features`.
        matching_options: by default those of the recipe.
        pairing_options: with ``match_list_path``, two names per line.
        verification_options: ours, or those of pycolmap that have a counterpart.
        device: where networks run, for recipes that escalate.
        random_seed: of verification.
        weights_path: folder with the weights of networks, for recipes that escalate.
        progress: where to show progress.

    Raises:
        PairListError: without a list, or when it names images without features.
    """
    verification = _verification_options(verification_options)
    list_path = _match_list_path(pairing_options)
    resources = _resources(device, weights_path)
    with Workspace.beside(Path(database_path)).locked() as workspace:
        pairs = read_pairs(list_path, stages.feature_store(workspace).names())
        return _match(
            workspace, pairs, matching_options, verification, random_seed, resources, progress
        )


def verify(
    database_path: PathLike,
    options: GivenVerification = None,
    *,
    random_seed: int = 0,
) -> None:
    """Estimate the two-view geometries of the matched pairs of any database that lack one.

    As ``pycolmap.geometric_verification``, with the preset for sparse sets; every match is
    checked first, because one that points at no keypoint ends the process inside COLMAP.

    Raises:
        DatabaseError: when the database cannot be used, or has such matches.
    """
    path = Path(database_path)
    verification = _verification_options(options)
    refuse_wrong_matches(path)
    verify_database(path, verification, random_seed)


def _match(
    workspace: Workspace,
    pairs: Sequence[Pair],
    matching_options: GivenMatching,
    verification: VerificationOptions,
    random_seed: int,
    resources: Resources,
    progress: Progress,
) -> tuple[StageReport, ...]:
    matching = _recorded_matching(workspace)
    if matching_options is not None:
        matching = _options(matching_options, MatchingOptions, "matching_options")
    stages.add_pairs(workspace, pairs)
    reports = [
        stages.match(workspace, matching, progress=progress),
        stages.verify_matches(workspace, verification, random_seed, progress=progress),
    ]
    if workspace.extraction_options().escalation:
        reports.append(escalate(workspace, resources=resources, progress=progress))
    return tuple(reports)


def _recorded_matching(workspace: Workspace) -> MatchingOptions:
    """Return the matching options of the recipe that the features were made with."""
    name = workspace.recipe()
    return MatchingOptions() if name == CUSTOM else load_recipe(name).matching


def _recipe(options: ExtractionOptions | Mapping[str, Any] | str) -> Recipe:
    if isinstance(options, str):
        return load_recipe(options)
    extraction = _options(options, ExtractionOptions, "extraction_options")
    return Recipe(CUSTOM, "", extraction, MatchingOptions())


def _options(given: object, kind: type[AnyOptions], argument: str) -> AnyOptions:
    if isinstance(given, kind):
        return given
    if isinstance(given, Mapping):
        return kind.from_mapping(given, argument)
    raise OptionError(
        f"{argument}: {type(given).__name__} does not apply here; give "
        f"colmap_affrect.{kind.__name__} or a dictionary"
    )


def _verification_options(given: object) -> VerificationOptions:
    if given is None:
        return VerificationOptions()
    if not isinstance(given, pycolmap.TwoViewGeometryOptions):
        return _options(given, VerificationOptions, "verification_options")
    values, usual = (flat(o.todict()) for o in (given, pycolmap.TwoViewGeometryOptions()))
    for key, value in values.items():
        if key not in VERIFICATION_NAMES and value != usual[key]:
            raise OptionError(f"verification_options: {key}={value} cannot be carried over")
    return VerificationOptions(**{ours: values[key] for key, ours in VERIFICATION_NAMES.items()})


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
            close = difflib.get_close_matches(key, usual, n=1, cutoff=0.0)
            raise OptionError(
                f"reader_options: unknown option '{key}' (did you mean '{close[0]}'?)"
            )
    known = {**usual, **values}
    mode = str(getattr(camera_mode, "name", camera_mode)).lower().replace("_", "-")
    cameras = CameraOptions(
        mode=mode,
        model=str(known["camera_model"]),
        params=str(known["camera_params"]),
        default_focal_length_factor=float(known["default_focal_length_factor"]),
        existing_camera_id=int(known["existing_camera_id"]),
    )
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


def _resources(device: pycolmap.Device | str, weights_path: PathLike | None) -> Resources:
    return Resources(
        Path(weights_path) if weights_path else None, str(getattr(device, "name", device))
    )
