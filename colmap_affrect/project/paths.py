"""Paths as users of the functions give them: as text, too."""

import os
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator

from colmap_affrect.errors import OptionError

PathLike = str | os.PathLike[str]


def as_path(given: PathLike, argument: str = "") -> Path:
    """Return a path.

    Args:
        given: what somebody has given as one.
        argument: its name, for errors.

    Raises:
        OptionError: bytes, an empty text, and anything else that is no path.
    """
    try:
        path = Path(given)
    except TypeError as error:
        kind = type(given).__name__
        named = f"{argument}={given!r}" if argument else repr(given)
        raise OptionError(
            f"give a path as str or os.PathLike, not {kind}", where=named
        ) from error
    # Path takes an empty one for the current folder, which nobody means
    if not os.fspath(given):
        raise OptionError(
            "an empty text is no path", advice="the current folder is '.'"
        )
    if "\0" in str(path):
        raise OptionError("no path holds the character 0", where=f"{str(path)!r}")
    return path


def as_path_or_none(given: PathLike | None, argument: str = "") -> Path | None:
    """Return the same; None, and an empty text, stay what they say: nothing."""
    return None if given is None or given == "" else as_path(given, argument)


GivenPath = Annotated[Path, BeforeValidator(as_path)]
"""Field of options that is given as text, too."""


def resolved(path: Path) -> Path:
    """Return a path without links; that of a pipe, which has no other name, as it is.

    Raises OptionError where links lead in a circle.
    """
    try:
        whole = path.resolve()
    except RuntimeError as error:  # so Python says it
        raise OptionError(
            "links lead in a circle",
            where=path,
            advice="give the path of a file or folder itself",
        ) from error
    return path.absolute() if path.exists() and not whole.exists() else whole
