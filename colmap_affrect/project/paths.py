"""Paths as users of the functions give them: as text, too."""

import os
from dataclasses import fields
from pathlib import Path

from colmap_affrect.errors import OptionError

PathLike = str | os.PathLike[str]


def as_path(given: PathLike) -> Path:
    """Return a path; OptionError for bytes and anything else that is none."""
    try:
        return Path(given)
    except TypeError as error:
        kind = type(given).__name__
        raise OptionError(f"{given!r}: give a path as str or os.PathLike, not {kind}") from error


def resolved(path: Path) -> Path:
    """Return a path without links; that of a pipe, which has no other name, as it is.

    Raises OptionError where links lead in a circle.
    """
    try:
        whole = path.resolve()
    except RuntimeError as error:  # so Python says it
        raise OptionError(
            f"{path}: links lead in a circle; give the path of a file or folder itself"
        ) from error
    return path.absolute() if path.exists() and not whole.exists() else whole


class TakesPaths:
    """Base of dataclasses whose fields of paths may be given as text."""

    def __post_init__(self) -> None:
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            if field.type in (Path, Path | None) and value is not None:
                object.__setattr__(self, field.name, as_path(value))  # of a frozen one, too
