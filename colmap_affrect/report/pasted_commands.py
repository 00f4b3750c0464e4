"""Commands to paste: those that were given, with other options or with more of them."""

import itertools
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.session.context import Context, Inputs

MAPPER_FLAGS: Collection[str] = ("--mapper", "--mapper-options")
CAMERA_FLAGS: Mapping[str, str] = {
    "mode": "--camera-mode",
    "model": "--camera-model",
    "params": "--camera-params",
    "cameras_path": "--cameras-path",
    "focal_length_px": "--focal-length-px",
    "focal_mm": "--focal-mm",
    "film_width_mm": "--film-width-mm",
    "principal_point": "--principal-point",
}
"""By the names of ``CameraOptions``; each has a value."""


def again(context: Context, *words: str) -> str:
    """Return the command that was given with more words, to go on in the same folder.

    Args:
        context: has the command that was given.
        words: a flag with its value; left out where the command has them.

    Returns:
        The command, for a shell.
    """
    path = str(context.workspace.path)
    base = context.command or ("colmap-affrect", "map", "--output-path", path)
    more = [] if {*words} <= {*base} else words
    return shlex.join([*base, *more])


def without(command: Sequence[str], flags: Collection[str]) -> list[str]:
    """Leave out flags and all of their values.

    Args:
        command: words of a command.
        flags: each takes one value or several.

    Returns:
        The other words.
    """
    kept = list[str]()
    is_left_out = False
    num_values = 0
    for word in command:
        num_values += 1
        if word.startswith("--"):
            is_left_out = word.partition("=")[0].replace("_", "-") in flags
            num_values = int("=" in word)
        elif num_values > 1 and word.startswith("-"):
            is_left_out = False  # a short flag, not the first value
        if not is_left_out:
            kept.append(word)
    return kept


def anew(context: Context, *words: str, leave_out: Collection[str] = ()) -> str:
    """Return a command for other options, which take the place of those that were given.

    Args:
        context: has the command that was given.
        words: flags with their values.
        leave_out: flags that are left out with their values.

    Returns:
        The command, with a new output folder.
    """
    flags = [word for word in words if word.startswith("--")]
    command = without(_run_command(context), [*flags, *leave_out])
    return shlex.join(_beside(context, [*command, *words]))


def with_default_mapper(context: Context, *words: str) -> str:
    """Return the command that maps the same with the default mapper.

    What was run as a whole, and the database of another program, get a new output folder; of a run
    by stages only the models are made anew.

    Args:
        context: has the command that was given.
        words: flags with their values.

    Returns:
        The command.
    """
    command = without(context.command, MAPPER_FLAGS)
    mapper = ["--mapper", MAPPERS.default]
    workspace = context.workspace
    if command[1:2] != ["map"] and not workspace.is_foreign:
        return anew(context, *words, leave_out=MAPPER_FLAGS)
    if workspace.is_foreign:
        if "--from-database" not in command:
            database = str(workspace.database)
            command = ["colmap-affrect", "map", "--from-database", database]
        return shlex.join(_beside(context, [*command, *mapper, *words]))
    return shlex.join([*command, *mapper, *words, "--overwrite"])


def _beside(context: Context, command: Sequence[str]) -> list[str]:
    """Return a command with a new output folder beside that of the run."""
    path = context.workspace.path
    numbered = (
        path.with_name(f"{path.name}-{number}") for number in itertools.count(2)
    )
    new = next(place for place in numbered if not place.exists())
    return [*without(command, ["--output-path"]), "--output-path", str(new)]


def _run_command(context: Context) -> Sequence[str]:
    """Return the words of the command that ran all stages, or those of one for the same inputs."""
    if context.command[1:2] == ("run",):
        return context.command
    workspace = context.workspace
    photos = str(workspace.photographs() or Path("photos"))
    command = ["colmap-affrect", "run", "--image-path", photos]
    if workspace.is_foreign:
        return command
    return [*command, *_input_flags(context.inputs)]


def _input_flags(inputs: Inputs) -> list[str]:
    """Return flags that say of photographs and cameras what is on record, with their values."""
    values = {
        "--image-list-path": inputs.image_list_path,
        "--from-database": inputs.from_database,
        "--mask-path": inputs.masks.path,
        "--camera-mask-path": inputs.masks.camera_path,
    }
    usual = CameraOptions()
    for name, flag in CAMERA_FLAGS.items():
        value = getattr(inputs.cameras, name)
        values[flag] = f"{value}" if value != getattr(usual, name) else ""
    flags = list[str]()
    for flag, text in values.items():
        if text:
            flags += [flag, text]
    return [*flags, "--ignore-exif"] if inputs.cameras.ignore_exif else flags
