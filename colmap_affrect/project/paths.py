"""Paths as users of the functions give them: as text, too."""

import os
from dataclasses import fields
from pathlib import Path

from colmap_affrect.errors import OptionError
from colmap_affrect.project.argument_types import require_type, types_of_fields

PathLike = str | os.PathLike[str]


def as_path(given: PathLike) -> Path:
    """Return a path; OptionError for bytes, an empty text and anything else that is none."""
    try:
        path = Path(given)
    except TypeError as error:
        kind = type(given).__name__
        raise OptionError(f"{given!r}: give a path as str or os.PathLike, not {kind}") from error
    if not os.fspath(given):  # Path takes it for the current folder, and nobody means that
        raise OptionError("an empty text is no path; the current folder is '.'")
    if "\0" in str(path):
        raise OptionError(f"{str(path)!r}: no path holds the character 0")
    return path


def resolved(path: Path) -> Path:
    """Return a path without links; that of a pipe, which has no other name, as it is."""
    whole = path.resolve()
    return path.absolute() if path.exists() and not whole.exists() else whole


class TakesPaths:
    """Base of dataclasses that refuse values of a wrong type; paths may be given as text."""

    def __post_init__(self) -> None:
        kinds = types_of_fields(type(self))
        for field in fields(self):  # type: ignore[arg-type]
            value, kind = getattr(self, field.name), kinds[field.name]
            require_type(field.name, value, kind)
            if kind in (Path, Path | None) and value is not None:
                object.__setattr__(self, field.name, as_path(value))  # of a frozen one, too
