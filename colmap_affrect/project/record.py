"""What is on record of a run, ``config.toml``: the options of its stages, and what they were given.

It is read once, when a command begins; what is made of photographs and pairs is in the stores.

What files hold is known by SHA-256 digests, with sizes and times so that an idle run reads none.
"""

import hashlib
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import tomli_w
from pydantic import BaseModel, ConfigDict

from colmap_affrect.errors import Option, WorkspaceError, clipped, damage
from colmap_affrect.options import flat
from colmap_affrect.project.regular_files import read_regular_text, sha256_of_regular


class Content(NamedTuple):
    """What files hold."""

    digest: str = ""  # sha256 of the digests of the files; empty if not known
    # Their sizes and times: while these stay, nobody has to read the files
    stamp: str = ""


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits; read once while it stays as it is."""
    return _sha256(path, _stamp(path))


@lru_cache(maxsize=64)
def _sha256(path: Path, _: str) -> str:
    return sha256_of_regular(path)


def _stamp(path: Path) -> str:
    there = path.stat()
    return f"{there.st_size} {there.st_mtime_ns} {there.st_ctime_ns}"


def stamp_of(paths: Iterable[Path]) -> str:
    """Return sizes and times of files: while these stay, nobody has to read them."""
    return ", ".join(_or_empty(_stamp, path) for path in paths)


def content_of(
    paths: Iterable[Path], known: Content | None = None, options: str = ""
) -> Content:
    """Return what files hold, without reading them if sizes and times are those that are known.

    Args:
        paths: of the files; one that cannot be read counts as empty.
        known: what they held.
        options: a digest of what counts beside them, empty if nothing does.
    """
    files = list(paths)
    stamp = ", ".join([stamp_of(files), options]) if options else stamp_of(files)
    if known and known.stamp == stamp:
        return known
    digests = [_or_empty(file_sha256, path) for path in files]
    if options:
        digests.append(options)
    whole = "\n".join(digests)
    return Content(hashlib.sha256(whole.encode()).hexdigest() if digests else "", stamp)


def _or_empty(read: Callable[[Path], str], path: Path) -> str:
    try:
        return read(path)
    except OSError:
        return ""


Stage = Literal[
    "copy", "extract", "pairs", "match", "verify", "escalate", "guide", "map"
]
STAGES: tuple[str, ...] = get_args(Stage)
# Characters of a value that is told; levels of recipes have thousands; display
MAX_VALUE = 160
FORMAT_VERSION = 13  # counts up when a stage records other options than before; format
MADE_FROM = "made_from"  # digests of given files, and of what was looked at
# What the models that are there were made from, and how many they are
MAPPED = "mapped"
PLANNED = "planned"  # options of stages that have not begun
KEYS = ("recipe", *STAGES, PLANNED, MADE_FROM, MAPPED)

PLACES = {
    "image_path", "image_list_path", "from_database", "cameras.cameras_path", "masks.path",
    "masks.camera_path", "depth.path", "match_list_path", "database",
}  # fmt: skip
"""Options that say where files are: other places are no other options, what the files hold counts
(:mod:`colmap_affrect.project.record`). But none at all is another option."""
WEIGHTS = "weights"  # of a stage: the digests of files, beside its options
OF_DATABASE = {"extract": ("cameras",)}
"""Options of a stage that decide only on the database, which others make anew."""


class ModelInputs(NamedTuple):
    """What models were made from."""

    verified: str  # digest of the database
    by_hand: str = ""  # of what a person said; empty for nothing
    extends: str = ""  # of the model that was extended, or OWN; empty for none


OWN = "own"  # a model of the folder itself is extended


class MappingRecord(BaseModel):
    """The models that are there."""

    model_config = ConfigDict(extra="forbid")
    verified: str
    by_hand: str = ""
    extends: str = ""
    number: int

    @property
    def inputs(self) -> ModelInputs:
        """What they were made from."""
        return ModelInputs(
            verified=self.verified, by_hand=self.by_hand, extends=self.extends
        )


class _Record(BaseModel):
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, dict[str, Any]]  # options by stage
    recipe: str = ""
    planned: dict[Stage, dict[str, Any]] = {}
    made_from: dict[str, str] = {}
    mapped: MappingRecord | None = None


def read_record(path: Path) -> dict[str, Any]:
    """Return the options of the stages that have begun, and under ``planned`` those of others.

    Raises WorkspaceError when the record is damaged or of another version of this package.
    """
    if not path.exists():
        return {}
    mend = (
        "restore it, or use another ",
        Option("output-path"),
        f" than {path.parent}",
    )
    with damage(path, mend, WorkspaceError):
        values = tomllib.loads(read_regular_text(path, "utf-8-sig"))
        if values.pop("format_version", None) != FORMAT_VERSION:
            raise WorkspaceError(
                "was made by another version of colmap-affrect, which cannot be gone "
                "on with",
                where=path.parent,
                advice=("use another ", Option("output-path"), " or remove it"),
            )
        record = _Record(**values).model_dump(exclude_unset=True)
        unknown = record.keys() - set(KEYS)
        if unknown:
            raise ValueError(f"unknown {min(unknown)!r}")
    return record


def rewind_record(record: Mapping[str, Any], stage: str) -> dict[str, Any]:
    """Return a record in which a stage and those after it are only planned, with their options."""
    planned = dict(record.get(PLANNED, {}))
    kept = dict(record)
    for later in STAGES[STAGES.index(stage) :]:
        if later in kept:
            planned[later] = kept.pop(later)
    if planned:
        kept[PLANNED] = planned
    return kept


def record_text(record: Mapping[str, Any]) -> str:
    """Return the content of ``config.toml``."""
    ordered = {key: record[key] for key in KEYS if record.get(key) not in (None, "")}
    return tomli_w.dumps({"format_version": FORMAT_VERSION, **ordered})


def first_difference(
    known: Mapping[str, Any], now: Mapping[str, Any], free: Collection[str] = ()
) -> str:
    """Say where options that make other results differ from those given now.

    Args:
        known: those on record.
        now: those given now.
        free: keys whose values may differ.

    Returns:
        What differs first, empty if nothing does.
    """
    old = flat({key: value for key, value in known.items() if key not in free})
    new = flat({key: value for key, value in now.items() if key not in free})
    for key in sorted(old.keys() | new.keys(), key=_part_names_first):
        before = old.get(key)
        after = new.get(key)
        if before != after and not _may_differ(key, before, after):
            was = clipped(repr(before), MAX_VALUE)
            return f"{key}={was}, and it is {clipped(repr(after), MAX_VALUE)} now"
    return ""


def _part_names_first(key: str) -> tuple[bool, str]:
    """Return by what options are sorted: with another part most other options differ, too."""
    return key.rpartition(".")[2] != "name", key


def _may_differ(key: str, before: object, after: object) -> bool:
    """Tell whether results stay the same though an option has another value."""
    has_both = bool(before and after)
    if key.startswith(f"{WEIGHTS}."):
        return not has_both  # a level waits for its weights
    return key in PLACES and has_both
