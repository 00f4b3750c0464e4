"""What is on record of a run, ``config.toml``: the options of its stages, and what they were given.

The record is read once, when a command begins; what is made of photographs and pairs is in the
stores.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import tomli_w
from pydantic import BaseModel, ConfigDict

from colmap_affrect.errors import OptionError, WorkspaceError, damage
from colmap_affrect.options import flat, suggestion

Stage = Literal["copy", "extract", "pairs", "match", "verify", "escalate", "guide", "map"]
STAGES: tuple[str, ...] = get_args(Stage)
COPY_STAGES = ("copy", "verify", "map")  # of a folder in which another program's database is mapped
FORMAT_VERSION = 6  # counts up when a stage records other options than before
MADE_FROM = "made_from"  # digests of given files, and of the verified pairs that were mapped
KEYS = ("recipe", "begun", *STAGES, MADE_FROM)

PLACES = {
    "image_path", "image_list_path", "from_database", "cameras.cameras_path", "masks.path",
    "masks.camera_path", "depth.path", "match_list_path", "database",
}  # fmt: skip
"""Options that say where files are: other places are no other options, what the files hold counts
(:mod:`colmap_affrect.project.contents`). But none at all is another option."""
GIVEN = "given"  # what stands in the place of such an option when options are compared
WEIGHTS = "weights"  # of a stage: the digests of files, beside its options


class _Record(BaseModel):
    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, dict[str, Any]]  # options by stage
    recipe: str = ""
    begun: list[Stage] = []
    made_from: dict[str, str] = {}


def read_record(path: Path, folder: Path) -> dict[str, Any]:
    """Return the options by stage, and under ``begun`` the stages that have been run with them.

    Raises WorkspaceError when the record is damaged or of another version of this package.
    """
    if not path.exists():
        return {}
    with damage(path, f"restore it, or use another --output-path than {folder}", WorkspaceError):
        values = tomllib.loads(path.read_text(encoding="utf-8"))
        if values.pop("format_version", None) != FORMAT_VERSION:
            raise WorkspaceError(
                f"{folder}: was made by another version of colmap-affrect, which cannot be "
                "gone on with; use another --output-path or remove it"
            )
        if unknown := sorted(values.keys() - set(KEYS)):
            raise OptionError(
                f"{path}: unknown {unknown[0]!r}{suggestion(unknown[0], STAGES)}; correct it, or "
                "use another --output-path"
            )
        record = _Record(**values).model_dump(exclude_unset=True)
        if lacking := set(record.get("begun", [])) - record.keys():
            raise ValueError(f"options of {min(lacking)} are missing")
    return record


def record_text(record: Mapping[str, Any]) -> str:
    """Return the content of ``config.toml``."""
    ordered = {key: record[key] for key in KEYS if record.get(key) not in (None, "")}
    return tomli_w.dumps({"format_version": FORMAT_VERSION, **ordered})


def placeless(options: Mapping[str, Any], there: str = "", prefix: str = "") -> dict[str, Any]:
    """Return options without places of files; ``there`` stands where one is given."""
    found = dict(options)
    for key, value in options.items():
        if isinstance(value, Mapping):
            found[key] = placeless(value, there, f"{prefix}{key}.")
        elif value and prefix + key in PLACES:
            found[key] = there
    return found


def first_difference(known: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Say where options on record differ from those given now; empty if they do not."""
    old, new = flat(known), flat(now)
    # The name of a part first: with another one most other options differ too.
    keys = sorted(old.keys() | new.keys(), key=lambda key: (key.rpartition(".")[2] != "name", key))
    for key in keys:
        if old.get(key) != new.get(key):
            return f"{key}={old.get(key)!r}, and it is {new.get(key)!r} now"
    return ""
