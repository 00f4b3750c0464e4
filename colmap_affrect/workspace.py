"""The output folder: its files, its lock, and the record of the options that made them."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, Timeout

from colmap_affrect.errors import StaleStoreError, WorkspaceError
from colmap_affrect.files import replace_text
from colmap_affrect.options import ExtractionOptions, MatchingOptions, VerificationOptions, flat

logger = logging.getLogger(__name__)

LOCAL = ("image_path", "image_list_path", "from_database", "camera", "match_list_path")
CHOICES = (".name", ".profile")
STAGES = ("extract", "pairs", "match", "verify", "escalate", "map")
FORMAT_VERSION = 2
"""Of ``config.toml``: counts up when a stage records other options than before."""


@dataclass(frozen=True)
class Workspace:
    """Paths below an output folder.

    ``config.toml`` records, by stage, the options that made what is there. A stage that
    is run again with the same options goes on where it stopped; with other options it
    refuses, and ``overwrite`` removes its results and those of the stages after it.

    Attributes:
        path: the folder.
        users_database: database of the user that results go to instead of one in the folder;
            never removed.
    """

    path: Path
    users_database: Path | None = None

    @classmethod
    def beside(cls, database_path: Path) -> Self:
        """Return the workspace of a user's database: ``x.affrect`` beside ``x.db``."""
        return cls(database_path.with_suffix(".affrect"), database_path)

    @property
    def features(self) -> Path:
        """Features by image (HDF5)."""
        return self.path / "features.h5"

    @property
    def pairs(self) -> Path:
        """List of the pairs to match (text)."""
        return self.path / "pairs.txt"

    @property
    def matches(self) -> Path:
        """Raw matches by pair (HDF5)."""
        return self.path / "matches.h5"

    @property
    def database(self) -> Path:
        """COLMAP database."""
        return self.users_database or self.path / "database.db"

    @property
    def sparse(self) -> Path:
        """Folder of the COLMAP models 0, 1, ..."""
        return self.path / "sparse"

    @property
    def report(self) -> Path:
        """Report of the last run (JSON)."""
        return self.path / "report.json"

    @property
    def depth(self) -> Path:
        """Folder of the depth maps that a network made."""
        return self.path / "depth"

    @property
    def config(self) -> Path:
        """Record of the options (TOML)."""
        return self.path / "config.toml"

    @property
    def log(self) -> Path:
        """Log of all runs."""
        return self.path / "run.log"

    @contextmanager
    def locked(self) -> Iterator[Workspace]:
        """Create the folder and keep other runs out of it.

        Raises:
            WorkspaceError: when it cannot be written or another run uses it.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = FileLock(self.path / ".lock")
            lock.acquire(timeout=0)
        except Timeout as error:
            raise WorkspaceError(
                f"{self.path}: another colmap-affrect is working in this folder; wait for it "
                "or use another --output-path"
            ) from error
        except OSError as error:
            raise WorkspaceError(
                f"{self.path}: cannot be used as output folder ({error.strerror or error})"
            ) from error
        try:
            yield self
        finally:
            lock.release()

    def recorded(self) -> dict[str, Any]:
        """Return the options on record by stage; empty where there are none.

        Raises:
            WorkspaceError: when the record is damaged or of another version of this package.
        """
        if not self.config.exists():
            return {}
        try:
            record = tomllib.loads(self.config.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise WorkspaceError(f"{self.config}: damaged ({error}); remove it") from error
        if record.pop("format_version", None) != FORMAT_VERSION:
            raise WorkspaceError(
                f"{self.path}: was made by another version of colmap-affrect, which cannot be "
                "gone on with; use another --output-path or remove it"
            )
        return record

    def recipe(self) -> str:
        """Return the name of the recipe that the features were made with."""
        self.require("extract")
        return str(self.recorded()["recipe"])

    def extraction_options(self) -> ExtractionOptions:
        """Return the options that the features were made with."""
        record = self.require("extract")
        names = {item.name for item in fields(ExtractionOptions)}
        options = {key: value for key, value in record.items() if key in names}
        return ExtractionOptions.from_mapping(options, str(self.config))

    def matching_options(self) -> MatchingOptions:
        """Return the options that the pairs were matched with."""
        return MatchingOptions.from_mapping(self.require("match"), str(self.config))

    def verification_options(self) -> tuple[VerificationOptions, int]:
        """Return the options and the seed that the pairs were verified with."""
        record = dict(self.require("verify"))
        seed = int(record.pop("random_seed"))
        return VerificationOptions.from_mapping(record, str(self.config)), seed

    def claim(
        self, stage: str, options: Mapping[str, Any], *, overwrite: bool = False, recipe: str = ""
    ) -> None:
        """Put the options of a stage on record before it begins.

        Args:
            stage: one of ``STAGES``.
            options: what the results depend on; nested mappings of plain values.
            overwrite: discard the results of this stage and the later ones first.
            recipe: name of the recipe, for the record only.

        Raises:
            StaleStoreError: when other options made the results that are there.
        """
        record = self.recorded()
        self._refuse_foreign_results(record)
        if overwrite:
            self._discard(record, stage)
        known = record.get(stage)
        if known is not None:
            difference = first_difference(known, options)
            if difference:
                raise StaleStoreError(
                    f"{self.path}: the {stage} stage was run there with {difference}; "
                    f"{self._remedy}"
                )
        record[stage] = dict(options)
        record["recipe"] = recipe or record.get("recipe", "")
        ordered = {name: record[name] for name in ("recipe", *STAGES) if name in record}
        replace_text(self.config, dump_toml({"format_version": FORMAT_VERSION, **ordered}))

    @property
    def _remedy(self) -> str:
        if self.users_database:
            return "use a new database (from_database= takes over its images and cameras)"
        return "use --overwrite to redo it and the stages after it, or another --output-path"

    def options_digest(self, *stages: str) -> str:
        """Return a sha256 of the recorded options of stages, those that decide the results.

        Paths and cameras are left out: they do not change features or matches.
        """
        record = self.recorded()
        options = {
            stage: {key: value for key, value in record.get(stage, {}).items() if key not in LOCAL}
            for stage in stages
        }
        return hashlib.sha256(json.dumps(options, sort_keys=True).encode()).hexdigest()

    def require(self, stage: str) -> dict[str, Any]:
        """Return the recorded options of an earlier stage.

        Raises:
            WorkspaceError: when it has not been run.
        """
        record = self.recorded()
        if stage not in record:
            raise WorkspaceError(
                f"{self.path}: the {stage} stage has not been run there; run "
                f"'colmap-affrect {stage}' with this --output-path first"
            )
        options: dict[str, Any] = record[stage]
        return options

    def _refuse_foreign_results(self, record: Mapping[str, Any]) -> None:
        if "extract" in record:
            return
        database = [] if self.users_database else [self.database]
        for path in (*database, self.sparse, self.features, self.matches):
            if path.exists():
                raise StaleStoreError(
                    f"{path}: exists and was not made here; it is left as it is, use "
                    "another --output-path"
                )

    def _discard(self, record: dict[str, Any], stage: str) -> None:
        """Forget a stage and those after it and remove what they made."""
        for later in STAGES[STAGES.index(stage) :]:
            record.pop(later, None)
        first = STAGES.index(stage)
        outdated = [self.sparse, self.report]
        if first <= STAGES.index("verify"):
            outdated.append(self.database)
        if first <= STAGES.index("match"):
            outdated.append(self.matches)
        if first <= STAGES.index("pairs"):
            outdated.append(self.pairs)
        if first == 0:
            outdated.append(self.features)
        for path in outdated:
            logger.info("overwrite: removing %s", path)
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def first_difference(known: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Say where options on record differ from those given now; empty if they do not."""
    old, new = flat(known), flat(now)
    # The name of a rectifier or profile first: with another name most other options differ too.
    for key in sorted(old.keys() | new.keys(), key=lambda key: (not key.endswith(CHOICES), key)):
        if old.get(key) != new.get(key):
            return f"{key}={old.get(key)!r}, and it is {new.get(key)!r} now"
    return ""


def dump_toml(values: Mapping[str, Any], prefix: str = "") -> str:
    """Write nested mappings of numbers, strings, booleans and lists as TOML.

    >>> print(dump_toml({"a": {"x": 1.5, "b": {"y": ["s", True]}}}), end="")
    [a]
    x = 1.5
    <BLANKLINE>
    [a.b]
    y = ["s", true]
    <BLANKLINE>
    """
    plain = {key: value for key, value in values.items() if not isinstance(value, Mapping)}
    text = f"[{prefix}]\n" if prefix and plain else ""
    text += "".join(f"{key} = {_toml_value(value)}\n" for key, value in plain.items())
    text += "\n" if plain else ""
    for key, value in values.items():
        if isinstance(value, Mapping):
            text += dump_toml(value, f"{prefix}.{key}" if prefix else key)
    return text


def _toml_value(value: Any) -> str:
    """Write as JSON, which differs from TOML in mappings, characters beyond 16 bits and DEL."""
    if isinstance(value, Mapping):
        entries = (f"{key} = {_toml_value(item)}" for key, item in value.items())
        return "{" + ", ".join(entries) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_value(item) for item in value) + "]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
