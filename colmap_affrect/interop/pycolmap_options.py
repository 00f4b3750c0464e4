"""What pycolmap's option objects, or nested dictionaries of their fields, ask of us.

A field of an object that keeps pycolmap's default asks for nothing; a dictionary asks for all that
it names, but -1, which leaves it to pycolmap. What differs is honoured where :data:`HONOURED` has
it, and refused by its name elsewhere.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.native_options import differences, flat_values, resolve
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import OptionError
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.matchers.base import MatcherOptions
from colmap_affrect.options import CUSTOM, flat
from colmap_affrect.project.paths import PathLike, as_path, resolved
from colmap_affrect.recipes import ExtractionOptions, Recipe, load_recipe

Native = TypeVar("Native")  # an option class of pycolmap

VERIFICATION_NAMES = {  # in pycolmap's TwoViewGeometryOptions and in ours
    "min_num_inliers": "min_num_inliers",
    "min_inlier_ratio": "min_inlier_ratio",
    "ransac.max_error": "max_error_px",
    "ransac.max_num_trials": "max_num_trials",
    "ransac.min_inlier_ratio": "ransac_min_inlier_ratio",
    "ransac.random_seed": "random_seed",
}

# where the work is done; of ``use_gpu`` the argument ``device`` decides, as in pycolmap
WHERE = ("num_threads", "use_gpu")

HONOURED: dict[type, tuple[str, ...]] = {  # fields that may differ from their defaults
    pycolmap.FeatureExtractionOptions: ("max_image_size", *WHERE),
    pycolmap.FeatureMatchingOptions: (
        "skip_geometric_verification", "skip_image_pairs_in_same_frame", "guided_matching",
        "rig_verification", *WHERE,
    ),
    pycolmap.TwoViewGeometryOptions: tuple(VERIFICATION_NAMES),
    pycolmap.ExhaustivePairingOptions: ("block_size",),
    pycolmap.ImportedPairingOptions: ("block_size", "match_list_path"),
    pycolmap.SequentialPairingOptions: (
        "overlap", "quadratic_overlap", "expand_rig_images", "loop_detection",
        "loop_detection_period", "loop_detection_num_images", "num_threads",
    ),
    pycolmap.SpatialPairingOptions: tuple(flat_values(pycolmap.SpatialPairingOptions())),
    pycolmap.ImageReaderOptions: (
        "camera_model", "camera_params", "default_focal_length_factor", "mask_path",
        "camera_mask_path",
    ),
}  # fmt: skip

SET_OTHERWISE = ("random_seed", "image_path", "fix_existing_frames")
"""Options of pycolmap's mapper, in any section, that reach ours by other ways."""


def native(given: object, kind: type[Native], argument: str) -> Native:
    """Return pycolmap's options, of a nested dictionary too.

    Args:
        given: options of this class, a dictionary of their fields, or None for the usual ones.
        kind: the class.
        argument: that they came by, for errors.

    Raises:
        OptionError: names a field that is unknown, or that differs from its default and is not
            honoured.
    """
    options = kind()
    if isinstance(given, kind):
        options = given
    elif given is None or isinstance(given, Mapping):
        resolve(
            options=options,
            given=_unusual(_named(given), options),
            option=f"{argument}:",
            owned={},
        )
    else:
        shown = f"{argument}: {type(given).__name__} does not apply here"
        raise OptionError(
            shown, advice=f"give pycolmap.{kind.__name__} or a dictionary of its fields"
        )
    for key, value in _differing(options).items():
        if kind in HONOURED and key not in HONOURED[kind]:
            shown = getattr(value, "name", value)
            raise OptionError(f"{key}={shown} cannot be carried over", where=argument)
    return options


def _differing(options: Any) -> dict[str, Any]:
    """Return the fields that differ from their defaults."""
    return _unusual(flat_values(options), type(options)())


def _unusual(values: Mapping[str, Any], options: Any) -> dict[str, Any]:
    """Return the values, by dotted key, that options do not have."""
    usual = flat_values(options)
    return {
        key: value
        for key, value in values.items()
        if key not in usual or value != usual[key]
    }


def changes(given: object, kind: type, argument: str) -> dict[str, Any]:
    """Return the fields that are asked for.

    Args:
        given: what :func:`native` takes.
        kind: a class of :data:`HONOURED`.
        argument: that the options came by, for errors.

    Returns:
        Values by dotted key: of fields that a dictionary names, or that are not the usual ones.

    Raises:
        OptionError: names a field that we do not have.
    """
    options: Any = native(given, kind, argument)
    named = _named(given)
    asked = {}
    for key, value in flat_values(options).items():
        if key in named and value != -1:
            asked[key] = value
    asked |= _differing(options)
    return {key: value for key, value in asked.items() if key in HONOURED[kind]}


def _named(given: object) -> Mapping[str, Any]:
    return flat(given) if isinstance(given, Mapping) else {}


def extraction_recipe(given: object) -> tuple[Recipe, dict[str, Any]]:
    """Return the recipe that is named or given in any form, and what pycolmap's options ask for."""
    if isinstance(given, str):
        return load_recipe(given), {}
    if isinstance(given, ExtractionOptions):
        return Recipe(**{**dict(given), "name": CUSTOM}), {}
    asked = changes(given, pycolmap.FeatureExtractionOptions, "extraction_options")
    recipe = load_recipe("default")
    if "max_image_size" in asked:
        recipe = recipe.changed(name=CUSTOM, max_image_size_px=asked["max_image_size"])
    return recipe, asked


def matching_options(given: object) -> tuple[MatcherOptions | None, dict[str, Any]]:
    """Return our options, None for those of the recipe, and what pycolmap's options ask for."""
    if isinstance(given, MatcherOptions):
        return given, {}
    return None, changes(given, pycolmap.FeatureMatchingOptions, "matching_options")


def verification_options(given: object, random_seed: int | None) -> VerificationOptions:
    """Return ours, with what pycolmap's options change; a seed that is given wins."""
    argument = "verification_options"
    if isinstance(given, VerificationOptions):
        options = given
    else:
        asked = changes(given, pycolmap.TwoViewGeometryOptions, argument)
        values = {VERIFICATION_NAMES[key]: value for key, value in asked.items()}
        if "max_error_px" in values:  # in pixels of the files
            values["scale_max_error"] = False
        options = VerificationOptions.from_mapping(values, argument)
    if random_seed is None:
        return options
    return options.changed(random_seed=random_seed)


def reader_options(
    given: object, camera_mode: object
) -> tuple[CameraOptions, MaskOptions]:
    """Return what pycolmap's options say of cameras and masks."""
    known = native(given, pycolmap.ImageReaderOptions, "reader_options")
    cameras = CameraOptions.from_mapping(
        {
            "mode": str(getattr(camera_mode, "name", camera_mode))
            .lower()
            .replace("_", "-"),
            "model": known.camera_model,
            "params": known.camera_params,
            "default_focal_length_factor": known.default_focal_length_factor,
        },
        "camera_mode, reader_options",
    )
    masks = MaskOptions(
        path=given_path(known.mask_path), camera_path=given_path(known.camera_mask_path)
    )
    return cameras, masks


def given_path(path: PathLike) -> str:
    """Return an absolute path, or nothing for pycolmap's '.', which stands for none."""
    given = Path() if path == "" else as_path(path)
    return "" if given == Path() else str(resolved(given))


def mapper_options(asked: object) -> MapperOptions:
    """Translate what is asked of pycolmap's mapper into options of ours."""
    given = native(asked, pycolmap.IncrementalPipelineOptions, "options")
    for key, value in _differing(given).items():
        if isinstance(value, list | set):
            raise OptionError(f"{key}={value} cannot be carried over", where="options")
    kept = {}
    values = differences(given, pycolmap.IncrementalPipelineOptions(), _named(asked))
    for key, value in values.items():
        name = key.rpartition(".")[2]
        if name not in SET_OTHERWISE:
            kept[key] = value
    ours: dict[str, Any] = {"name": MAPPERS.default, "mapper_options": kept}
    if given.random_seed >= 0:
        ours["random_seed"] = given.random_seed
    options: MapperOptions = MAPPERS.options(ours, where="options")
    return options
