"""What files hold: SHA-256 digests, kept with sizes and times so that an idle run reads none.

A store keeps with the features of an image what they were extracted from.
"""

import hashlib
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple


class Content(NamedTuple):
    """What files hold."""

    digest: str = ""  # sha256 of the digests of the files; empty if not known
    stamp: str = ""  # their sizes and times: while these stay, nobody has to read the files


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits; read once while it stays as it is."""
    return _sha256(path, _stamp(path))


@lru_cache(maxsize=64)
def _sha256(path: Path, _: str) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _stamp(path: Path) -> str:
    there = path.stat()
    return f"{there.st_size} {there.st_mtime_ns} {there.st_ctime_ns}"


def stamp_of(paths: Iterable[Path]) -> str:
    """Return sizes and times of files: while these stay, nobody has to read them."""
    return ", ".join(_or_empty(_stamp, path) for path in paths)


def content_of(paths: Iterable[Path], known: Content | None = None) -> Content:
    """Return what files hold, without reading them if sizes and times are those that are known.

    One that cannot be read counts as empty.
    """
    files = list(paths)
    stamp = stamp_of(files)
    if known and known.stamp == stamp:
        return known
    digests = "\n".join(_or_empty(file_sha256, path) for path in files)
    return Content(hashlib.sha256(digests.encode()).hexdigest() if files else "", stamp)


def _or_empty(read: Callable[[Path], str], path: Path) -> str:
    try:
        return read(path)
    except OSError:
        return ""
