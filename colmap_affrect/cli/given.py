"""What the options of a command mean to the library; what is not given is taken from the record."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from colmap_affrect.errors import OptionError, WorkspaceError
from colmap_affrect.options import Options
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.record import WEIGHTS, placeless, read_record
from colmap_affrect.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_affrect.colmap.verification import VerificationOptions
    from colmap_affrect.mappers.base import MapperOptions
    from colmap_affrect.mappers.existing import Extension
    from colmap_affrect.parallel.executor import Executor
    from colmap_affrect.recipes import Recipe
    from colmap_affrect.stages.context import Context, Resources

AnyOptions = TypeVar("AnyOptions", bound=Options)

SECTIONS = {
    "cameras": {
        "camera_mode": "mode", "camera_model": "model", "camera_params": "params",
        "cameras_path": "cameras_path", "focal_length_px": "focal_length_px",
        "principal_point": "principal_point", "ignore_exif": "ignore_exif",
    },
    "masks": {"mask_path": "path", "camera_mask_path": "camera_path"},
    "pairs": {
        "pairs": "methods", "num_neighbors": "num_neighbors", "max_distance_m": "max_distance_m",
        "match_list_path": "match_list_path",
    },
    "matching": {"matcher": "name"},
    "guided": {"guided": "enabled"},
    "depth": {"depth_path": "path", "depth_kind": "kind"},
}  # fmt: skip
"""Options of the command line that are fields of an options class."""


def section(options: argparse.Namespace, name: str) -> dict[str, Any]:
    """Return what is given of a section, by the fields of its options."""
    given = {
        field: getattr(options, argument, None)
        for argument, field in SECTIONS.get(name, {}).items()
    }
    return {
        field: str(value.resolve()) if isinstance(value, Path) else value
        for field, value in given.items()
        if value is not None and value is not False
    }


def over(known: AnyOptions, options: argparse.Namespace, name: str) -> AnyOptions:
    """Return options that are known, and in their place those of a section that are given."""
    return known.from_mapping({**known.to_mapping(), **section(options, name)}, name)


def built(
    options: argparse.Namespace,
    name: str,
    cls: type[AnyOptions],
    recorded: Mapping[str, Any] | None = None,
) -> AnyOptions:
    """Return options of a section: as given, as on record, or their defaults."""
    return over(cls.from_mapping(recorded or {}, "--config"), options, name)


def record(options: argparse.Namespace) -> Mapping[str, Any]:
    """Return the options on record in --config, without places if there are other photographs."""
    path: Path | None = options.config
    if not path:
        if not options.image_path:
            raise OptionError("--image-path: give the folder of the photographs, or --config FILE")
        return {}
    if not path.is_file():
        raise OptionError(f"--config {path}: no such file; give the config.toml of a run")
    try:
        found = read_record(path, path.parent)
    except WorkspaceError as error:
        raise OptionError(f"--config {path}: of another version, or no config.toml") from error
    if "extract" not in found:
        raise OptionError(f"--config {path}: has no options of a run; give its config.toml")
    if not options.image_path:
        return found
    return {key: placeless(v) if isinstance(v, dict) else v for key, v in found.items()}


def inputs(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    record: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the fields of InputOptions, which run and compare have in common."""
    from colmap_affrect.colmap.verification import VerificationOptions
    from colmap_affrect.images.photographs import CameraOptions, MaskOptions
    from colmap_affrect.mappers.base import MAPPERS
    from colmap_affrect.pairs.base import PairOptions

    record = record or {}
    extract = record.get("extract", {})
    listed, database = extract.get("image_list_path"), extract.get("from_database")
    verified = VerificationOptions.from_mapping(record.get("verify", {}), "--config")
    mapped = MAPPERS.options(record["map"], where="--config") if "map" in record else None
    return {
        "cameras": built(options, "cameras", CameraOptions, extract.get("cameras", {})),
        "masks": built(options, "masks", MaskOptions, extract.get("masks", {})),
        "pairs": built(options, "pairs", PairOptions, record.get("pairs", {})),
        "verification": verification(options, verified),
        "mapping": mapping(options, recipe, mapped),
        "image_list_path": options.image_list_path or (Path(listed) if listed else None),
        "from_database": options.from_database or (Path(database) if database else None),
        "resources": resources(options),
    }


def extension(options: argparse.Namespace) -> Extension | None:
    from colmap_affrect.mappers.existing import Extension

    if options.extend:
        return Extension(options.extend, options.refine_existing)
    if options.refine_existing:
        raise OptionError("--refine-existing: only with --extend MODEL")
    return None


def recipe(options: argparse.Namespace, record: Mapping[str, Any] | None = None) -> Recipe:
    """Return the recipe that is named, or the one on record, with single options changed."""
    from colmap_affrect.recipes import Recipe, load_recipe, with_settings
    from colmap_affrect.stages.inputs import Inputs

    changes = [*_settings(options, "matching", "guided"), *options.set, *depth_settings(options)]
    if options.recipe or not record:
        return load_recipe(options.recipe or "default", changes)
    sections = {"match": "matching", "escalate": "escalate", "guide": "guided"}
    values = {
        name: {key: value for key, value in record[stage].items() if key != WEIGHTS}
        for stage, name in sections.items()
        if stage in record
    }
    others = {*Inputs.model_fields, WEIGHTS}
    values |= {key: value for key, value in record["extract"].items() if key not in others}
    values["name"] = record["recipe"]
    return Recipe.from_mapping(with_settings(values, changes), "--config")


def _settings(options: argparse.Namespace, *names: str) -> list[str]:
    return [
        f"{name}.{key}={json.dumps(value)}"
        for name in names
        for key, value in section(options, name).items()
    ]


def depth_settings(options: argparse.Namespace) -> list[str]:
    """Return the changes of a recipe that the options of depth maps ask for."""
    folder("--depth-path", options.depth_path)
    files = ['depth.name="files"'] if options.depth_path else []
    return [*files, *_settings(options, "depth")]


def resources(options: argparse.Namespace) -> Resources:
    from colmap_affrect.stages.context import Resources

    return Resources(folder("--weights", options.weights), options.device)


def folder(option: str, path: Path | None) -> Path | None:
    """Refuse a folder to read that is not there."""
    if path and not path.is_dir():
        raise OptionError(f"{option} {path}: no such folder; give one that is there")
    return path


@contextmanager
def executor(options: argparse.Namespace) -> Iterator[Executor | None]:
    """Use the cluster that was named, None if there is none."""
    if not options.scheduler:
        yield None
        return
    from colmap_affrect.parallel.cluster import connected

    with connected(options.scheduler) as cluster:
        yield cluster


@contextmanager
def context(options: argparse.Namespace) -> Iterator[Context]:
    """Lock the output folder and return what the stages work with."""
    from colmap_affrect.stages.context import Context
    from colmap_affrect.stages.mend import watched

    with Workspace(options.output_path).locked() as workspace, executor(options) as where:
        found = Context(workspace, resources(options), where, progress(options))
        is_first = options.command == "extract"
        discards = is_first and options.overwrite
        maps = options.command == "map"
        with watched(found, follows=not is_first, maps=maps, discards=discards):
            yield found


def verification(
    options: argparse.Namespace, known: VerificationOptions | None = None
) -> VerificationOptions:
    """Return the preset that is given, or what is known."""
    from colmap_affrect.colmap.verification import VerificationOptions

    if known and not options.preset:
        return known.changed(**_seed(options))
    return VerificationOptions.preset(options.preset or "sparse", **_seed(options))


def _seed(options: argparse.Namespace) -> dict[str, int]:
    return {} if options.random_seed is None else {"random_seed": options.random_seed}


def mapping(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    known: MapperOptions | None = None,
) -> MapperOptions:
    """Return the mapper that is given, or what is known."""
    from colmap_affrect.recipes import Recipe

    native = key_values("--mapper-options", options.mapper_options)
    given = {**_seed(options), **({"mapper_options": native} if native else {})}
    if known and not (options.preset or options.mapper):
        return known.changed(**given)
    recipe = recipe or Recipe()
    return recipe.mapper_options(options.preset or "sparse", options.mapper or "", **given)


def key_values(option: str, settings: Sequence[str]) -> dict[str, str]:
    """Split settings at their first '='; OptionError where there is none, or no key."""
    found = {}
    for setting in settings:
        key, separator, value = setting.partition("=")
        if not separator or not key.strip():
            raise OptionError(f"{option} {setting}: expected KEY=VALUE")
        found[key.strip()] = value
    return found


def changed(known: AnyOptions, options: argparse.Namespace, name: str) -> AnyOptions:
    """Return a section of the recipe with what is given of it, and by --set."""
    from colmap_affrect.recipes import Recipe, with_settings

    settings = [*_settings(options, name), *options.set]
    values = with_settings({name: known.to_mapping()}, settings)
    if len(values) > 1:
        raise OptionError(f"--set: only options of {name} can be changed here")
    found: AnyOptions = getattr(Recipe.from_mapping(values, "--set"), name)
    return found


def distance(text: str) -> tuple[str, str, float]:
    """Read A,B,METRES."""
    try:
        first, second, length = text.split(",")
        return first, second, float(length)
    except ValueError as error:
        raise OptionError(
            f"--distance {text}: expected A,B,METRES with a decimal point, such as a.jpg,b.jpg,2.5"
        ) from error


def progress(options: argparse.Namespace) -> Progress:
    return SILENT if options.quiet else Progress(sys.stderr)


def weight_keys(names: Sequence[str]) -> list[str]:
    """Return keys of weights once each.

    Names of recipes stand for what these need, ``aliked`` and ``lightglue`` for all of that name.
    """
    from colmap_affrect.features.weights import WEIGHT_FILES
    from colmap_affrect.recipes import load_recipe, recipe_names

    keys: list[str] = []
    for name in names:
        alike = [key for key in WEIGHT_FILES if key == name or key.startswith(f"{name}-")]
        keys += load_recipe(name).weights if name in recipe_names() else alike or [name]
    return list(dict.fromkeys(keys))
