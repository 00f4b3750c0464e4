"""What the options of a command mean to the library; what is not given is taken from the record."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from colmap_affrect.errors import OptionError, WorkspaceError
from colmap_affrect.options import Options, suggestion
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.record import WEIGHTS, placeless, read_record
from colmap_affrect.project.workspace import Workspace

if TYPE_CHECKING:
    from colmap_affrect.colmap.verification import VerificationOptions
    from colmap_affrect.images.photographs import CameraOptions, MaskOptions
    from colmap_affrect.mappers.base import MapperOptions
    from colmap_affrect.mappers.existing import Extension
    from colmap_affrect.pairs.base import PairOptions
    from colmap_affrect.parallel.executor import Executor
    from colmap_affrect.recipes import Recipe
    from colmap_affrect.stages.context import Context, Resources


def record(options: argparse.Namespace) -> dict[str, Any]:
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
    _refuse_unknown(found["extract"], f"--config {path}")
    if not options.image_path:
        return found
    return {key: placeless(value) if isinstance(value, dict) else value
            for key, value in found.items()}  # fmt: skip


def _refuse_unknown(names: Iterable[str], where: str) -> None:
    """Refuse options of extraction that no run has recorded: typos of an editor."""
    from colmap_affrect.recipes import ExtractionOptions
    from colmap_affrect.stages.inputs import Inputs

    known = {*Inputs.model_fields, *ExtractionOptions.model_fields, WEIGHTS}
    for name in names:
        if name not in known:
            raise OptionError(f"{where}: unknown {name!r}{suggestion(name, known)}")


def inputs(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    record: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the fields of InputOptions, which run and compare have in common."""
    record = record or {}
    extract = record.get("extract", {})
    listed, database = extract.get("image_list_path"), extract.get("from_database")
    return {
        "cameras": _or_recorded(cameras(options), extract.get("cameras")),
        "masks": _or_recorded(masks(options), extract.get("masks")),
        "pairs": pair_options(options, record.get("pairs")),
        "verification": verification(options, record.get("verify")),
        "mapping": mapping(options, recipe, record.get("map")),
        "image_list_path": options.image_list_path or (Path(listed) if listed else None),
        "from_database": options.from_database or (Path(database) if database else None),
        "resources": resources(options),
        "focal_vote": options.focal_vote,
    }


AnyOptions = TypeVar("AnyOptions", bound=Options)


def _or_recorded(given: AnyOptions, recorded: Mapping[str, Any] | None) -> AnyOptions:
    if not recorded or given != type(given)():
        return given
    return type(given).from_mapping(recorded, "--config")


def extension(options: argparse.Namespace) -> Extension | None:
    from colmap_affrect.mappers.existing import Extension

    if options.extend:
        return Extension(options.extend, options.refine_existing)
    if options.refine_existing:
        raise OptionError("--refine-existing: only with --extend MODEL")
    return None


def recipe(options: argparse.Namespace, record: Mapping[str, Any] | None = None) -> Recipe:
    """Return the recipe that is named, or the one on record, with single options changed."""
    from colmap_affrect.recipes import ExtractionOptions, Recipe, load_recipe, with_settings

    given = {"matching.name": options.matcher, "guided.enabled": options.guided}
    settings = [f"{key}={json.dumps(value)}" for key, value in given.items() if value]
    settings += [*options.set, *depth_settings(options)]
    if options.recipe or not record:
        return load_recipe(options.recipe or "default", settings)
    sections = {"match": "matching", "escalate": "escalate", "guide": "guided"}
    values = {
        name: {key: value for key, value in record[stage].items() if key != WEIGHTS}
        for stage, name in sections.items()
        if stage in record
    }
    known = ExtractionOptions.model_fields
    values |= {key: value for key, value in record["extract"].items() if key in known}
    return Recipe.from_mapping(record["recipe"], with_settings(values, settings), "--config")


def depth_settings(options: argparse.Namespace) -> list[str]:
    path, model = options.depth_path, options.depth_model
    if path and not path.is_dir():
        raise OptionError(f"--depth-path {path}: no such folder; give the folder of the depth maps")
    given = {
        "name": "monocular" if model else "files" if path else None,
        "path": _text(path),
        "model": model,
        "kind": options.depth_kind,
    }
    return [f"depth.{key}={json.dumps(value)}" for key, value in given.items() if value]


def resources(options: argparse.Namespace) -> Resources:
    from colmap_affrect.stages.context import Resources

    return Resources(weights_folder(options), options.device)


def weights_folder(options: argparse.Namespace) -> Path | None:
    path: Path | None = options.weights
    if path and not path.is_dir():
        raise OptionError(f"--weights {path}: no such folder; give the folder of the weights")
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
        with watched(found, follows=not is_first, discards=discards):
            yield found


def cameras(options: argparse.Namespace) -> CameraOptions:
    from colmap_affrect.images.photographs import CameraOptions

    return CameraOptions(
        mode=options.camera_mode,
        model=options.camera_model,
        params=options.camera_params,
        ignore_exif=options.ignore_exif,
        cameras_path=_text(options.cameras_path),
        focal_length_px=options.focal_length_px,
        principal_point=options.principal_point,
    )


def masks(options: argparse.Namespace) -> MaskOptions:
    from colmap_affrect.images.photographs import MaskOptions

    return MaskOptions(path=_text(options.mask_path), camera_path=_text(options.camera_mask_path))


def _text(path: Path | None) -> str:
    return str(path.resolve()) if path else ""


def pair_options(
    options: argparse.Namespace, recorded: Mapping[str, Any] | None = None
) -> PairOptions:
    """Return what is given on the command line, over what is on record."""
    from colmap_affrect.pairs.base import PairOptions

    given = {
        "methods": options.pairs,
        "num_neighbors": options.num_neighbors,
        "max_distance_m": options.max_distance_m,
        "match_list_path": _text(options.match_list_path) or None,
    }
    chosen = {key: value for key, value in given.items() if value is not None}
    return PairOptions.from_mapping({**(recorded or {}), **chosen}, "pairs")


def verification(
    options: argparse.Namespace, recorded: Mapping[str, Any] | None = None
) -> VerificationOptions:
    """Return the preset that is given, or what is on record."""
    from colmap_affrect.colmap.verification import VerificationOptions

    if recorded and not options.preset:
        return VerificationOptions(**{**recorded, **seed(options)})
    return VerificationOptions.preset(options.preset or "sparse", **seed(options))


def seed(options: argparse.Namespace) -> dict[str, int]:
    return {} if options.random_seed is None else {"random_seed": options.random_seed}


def mapping(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    recorded: Mapping[str, Any] | None = None,
) -> MapperOptions:
    """Return the mapper that is given, or what is on record."""
    from colmap_affrect.mappers.base import MAPPERS
    from colmap_affrect.recipes import Recipe

    native = key_values("--mapper-options", options.mapper_options)
    given = {**seed(options), **({"mapper_options": native} if native else {})}
    if recorded and not (options.preset or options.mapper):
        found: MapperOptions = MAPPERS.options({**recorded, **given})
        return found
    recipe = recipe or Recipe("")
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


def changed(context: Context, stage: str, section: str, settings: Sequence[str]) -> dict[str, Any]:
    """Return the options on record of a stage, a section of the recipe, some of them changed."""
    from colmap_affrect.recipes import with_settings

    values = with_settings({section: context.workspace.planned(stage) or {}}, settings)
    if len(values) > 1:
        raise OptionError(f"--set: only options of {section} can be changed here")
    changed: dict[str, Any] = values[section]
    return changed


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
