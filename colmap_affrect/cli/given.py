"""What the flags of a command mean to the library; stages take the rest from the record."""

import argparse
import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect.cli.flags import FLAGS
from colmap_affrect.colmap.by_hand import NOTHING, ByHand
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.errors import Option, OptionError
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.mappers.base import MapperOptions
from colmap_affrect.mappers.existing import Extension
from colmap_affrect.matchers.base import MATCHERS, MatcherOptions
from colmap_affrect.options import Options, flat
from colmap_affrect.pairs.lists import PairOptions
from colmap_affrect.parallel.executor import Executor
from colmap_affrect.pipeline.single_stages import one_stage
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe, load_recipe, with_settings
from colmap_affrect.session.context import Context, Resources

AnyOptions = TypeVar("AnyOptions", bound=Options)


def over(known: AnyOptions, options: argparse.Namespace, section: str) -> AnyOptions:
    """Return options with what is given of a section in their place.

    Args:
        known: options.
        options: the parsed ones, with destinations such as ``cameras.mode``.
        section: the first part of these, as ``cameras``.

    Raises:
        OptionError: names the flags of the section that are given.
    """
    given = known.to_mapping()
    flags = []
    for flag, settings in FLAGS.items():
        place, _, field = settings.get("dest", "").rpartition(".")
        value = getattr(options, f"{place}.{field}", None)
        if place == section and value is not None:
            given[field] = str(resolved(value)) if isinstance(value, Path) else value
            flags.append(flag)
    return known.from_mapping(given, ", ".join(flags))


def inputs(options: argparse.Namespace, recipe: Recipe | None = None) -> dict[str, Any]:
    """Return the fields of InputOptions."""
    return {
        "cameras": over(CameraOptions(), options, "cameras"),
        "masks": over(MaskOptions(), options, "masks"),
        "pairs": over(PairOptions(), options, "pairs"),
        "verification": verification(options),
        "mapping": mapping(options, recipe),
        "image_list_path": options.image_list_path,
        "from_database": options.from_database,
        "resources": resources(options),
    }


def refuse_without_database(options: argparse.Namespace) -> None:
    """Refuse what is only for the database of another program."""
    if options.image_path:
        raise OptionError(
            ("only with ", Option("from-database")),
            where=Option("image-path"),
            advice="else that of extract is used",
        )
    cameras = over(CameraOptions(), options, "cameras")
    given = options.matches_path, options.match_type, options.match_list_path
    if cameras != CameraOptions() or any(given):
        raise OptionError(
            ("matches and cameras are given with ", Option("from-database")),
            advice="of own photographs, extract and match take them",
        )


def extension(options: argparse.Namespace) -> Extension | None:
    if options.refine_existing and not options.extend:
        raise OptionError(
            ("only with ", Option("extend"), " MODEL"), where=Option("refine-existing")
        )
    if not options.extend:
        return None
    return Extension(
        model_path=options.extend, refine_existing=bool(options.refine_existing)
    )


def by_hand(options: argparse.Namespace) -> ByHand:
    return ByHand(
        tie_points_path=options.tie_points_path,
        rejected=tuple(options.rejected),
        left_out=tuple(options.left_out),
    )


def recipe(options: argparse.Namespace) -> Recipe:
    return load_recipe(
        options.recipe or "default", [*options.set, *depth_settings(options)]
    )


def depth_settings(options: argparse.Namespace) -> list[str]:
    """Return the change of a recipe that --depth-path asks for."""
    path = folder("depth-path", options.depth_path)
    return [f"depth.path={json.dumps(str(resolved(path)))}"] if path else []


def matching(known: MatcherOptions, options: argparse.Namespace) -> MatcherOptions:
    """Return a matcher with what --set changes of it; perhaps it is another one."""
    values = with_settings({"matching": known.to_mapping()}, options.set)
    if len(values) > 1:
        raise OptionError(
            "only options of matching can be changed here", where=Option("set")
        )
    changed: MatcherOptions = MATCHERS.options(values["matching"], where=Option("set"))
    return changed


def verification(
    options: argparse.Namespace, known: VerificationOptions | None = None
) -> VerificationOptions:
    """Return the preset that is given, or what is known."""
    if options.preset or not known:
        known = VerificationOptions.preset(options.preset or "sparse")
    return known.changed(**_seed(options))


def mapping(
    options: argparse.Namespace,
    recipe: Recipe | None = None,
    known: MapperOptions | None = None,
) -> MapperOptions:
    """Return the mapper that is given, or what is known.

    Args:
        options: the parsed ones.
        recipe: of the run; None for the usual one.
        known: options on record, which hold where none are given; None if there are none.
    """
    given: dict[str, Any] = _seed(options)
    if options.mapper_options:
        native = with_settings({}, options.mapper_options, "mapper-options")
        given["mapper_options"] = flat(native)
    if options.preset or options.mapper or not known:
        recipe = recipe or Recipe()
        known = recipe.mapper_options(options.preset or "sparse", options.mapper or "")
    return known.changed(**given)


def _seed(options: argparse.Namespace) -> dict[str, int]:
    return {} if options.random_seed is None else {"random_seed": options.random_seed}


def resources(options: argparse.Namespace) -> Resources:
    return Resources(
        weights_path=folder("weights", options.weights),
        device=options.device or "auto",
    )


def folder(flag: str, path: Path | None) -> Path | None:
    """Refuse a folder to read that is not there."""
    if path and not path.is_dir():
        where = Option(flag, path)
        raise OptionError(
            "no such folder", where=where, advice="give one that is there"
        )
    return path


def executor(options: argparse.Namespace) -> AbstractContextManager[Executor | None]:
    """Use the cluster that was named, None if there is none."""
    if not options.scheduler:
        return nullcontext()
    from colmap_affrect.parallel.cluster import connected

    return connected(options.scheduler)


@contextmanager
def context(options: argparse.Namespace) -> Iterator[Context]:
    """Lock the output folder and return what the stages work with."""
    with executor(options) as where:
        found = Context(
            Workspace(options.output_path),
            resources(options),
            where,
            options.progress,
            by_hand=by_hand(options) if options.command == "map" else NOTHING,
            command=options.words,
        )
        with one_stage(options.command, found, overwrite=bool(options.overwrite)):
            yield found
