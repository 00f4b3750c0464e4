"""Examines output folders and COLMAP databases, which are only read, as runs read them."""

import shlex
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.checks import CHECKS, check_database
from colmap_affrect.colmap.database_copy import newest_schema_version, refuse_newer
from colmap_affrect.colmap.model_files import SUMMARY, registered_names
from colmap_affrect.doctor.findings import Diagnosis
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, WorkspaceError, such_as
from colmap_affrect.mappers.summaries import model_folders, read_summary
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.record import STAGES
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context

Read = TypeVar("Read")

MAX_ITEMS_SHOWN = 5
SAME_RUN = "give the same 'run' or 'extract' again (run.log has the command)"


def examine_database(diagnosis: Diagnosis, path: Path, advice: str = "") -> bool:
    """Examine a COLMAP database; return whether it is usable.

    ``advice`` is what to do about problems, where it is not what ``CHECKS`` says.
    """
    try:
        version, newest = refuse_newer(path), newest_schema_version()
        tables, problems = check_database(path)
    except DatabaseError as error:
        recover = "'sqlite3 FILE .recover' may save a part of a damaged database"
        diagnosis.add("error", path, _without_path(path, error), advice or recover)
        return False
    quoted = shlex.quote(str(path))
    if version < newest:
        copy = shlex.quote(str(path.with_suffix(".old.db")))
        diagnosis.add(
            "note", path,
            f"has the tables of an older COLMAP (schema {version}, now {newest}); COLMAP 4 and "
            "pycolmap change them as soon as they open it, and an older COLMAP cannot read it "
            "any more",
            f"keep a copy: cp {quoted} {copy}",
        )  # fmt: skip
    diagnosis.checked.append(f"{path}: {tables.summary()}")
    for kind in sorted(problems, key=list(CHECKS).index):
        what, usual = CHECKS[kind]
        items = f" ({len(problems[kind])}): {such_as(problems[kind], MAX_ITEMS_SHOWN)}"
        diagnosis.add("error", path, f"{what}{items}", advice or usual.format(path=quoted))
    return True


def examine_folder(diagnosis: Diagnosis, path: Path) -> None:
    """Examine an output folder, unless somebody is working in it."""
    workspace = Workspace(path)
    if path.suffix == ".affrect" and not workspace.database.exists():
        workspace = Workspace(path, path.with_suffix(".db"))
    if not workspace.config.exists():
        if not workspace.database.exists():
            what = "neither an output folder of colmap-affrect nor one with a database.db"
            advice = "give the --output-path of a run, or a COLMAP database"
            diagnosis.add("error", path, what, advice)
            return
        what = "is no output folder of colmap-affrect (it has no config.toml)"
        diagnosis.add(
            "note", path, f"{what}; only its database is checked",
            "use another --output-path for colmap-affrect",
        )  # fmt: skip
        examine_database(diagnosis, workspace.database)
        return
    with ExitStack() as stack:
        try:
            stack.enter_context(workspace.locked())
        except (WorkspaceError, OptionError) as error:
            in_use = isinstance(error.__cause__, TimeoutError)
            writable = "make it writable before running anything in it"
            advice = "run doctor again when it is done" if in_use else writable
            diagnosis.add("warning", path, _without_path(path, error), advice)
            if in_use:
                return
        _Examination(diagnosis, workspace).examine()


class _Examination:
    """Examines an output folder that nobody else is working in."""

    def __init__(self, diagnosis: Diagnosis, workspace: Workspace) -> None:
        self.diagnosis, self.workspace = diagnosis, workspace
        self.path, self.quoted = workspace.path, shlex.quote(str(workspace.path))

    def examine(self) -> None:
        """Read every file as runs do."""
        database, context = self.workspace.database, Context(self.workspace)
        record = self._read(self.workspace.config, self._record)
        done = self._stages(record) if record is not None else []
        self._read(self.workspace.cameras, lambda: read_camera_records(self.workspace.cameras))
        for store in (context.features, context.matches, context.guided) if done else ():
            self._read(store.path, store.check_all)
            self.diagnosis.checked.append(f"{store.path}: all values")
        if "extract" in done:
            self._require(self.workspace.features)
            names = self._read(self.path, lambda: list(context.inputs.names()))
            if names and "match" in done:
                listed = self.workspace.pairs
                again = f"run 'colmap-affrect pairs --output-path {self.quoted} --overwrite'"
                self._read(listed, lambda: read_pairs(listed, names), again)
        if done and not self._require(database):
            return
        if database.exists():
            remake = f"remove it and {SAME_RUN}: it is made anew"
            advice = remake if done and not self.workspace.users_database else ""
            is_usable = examine_database(self.diagnosis, database, advice)
            if is_usable and "map" in done:
                self._models()

    def _read(self, path: Path, read: Callable[[], Read], advice: str = "") -> Read | None:
        """Read a file as runs do; None, and what the reader says, if that cannot be done."""
        try:
            return read()
        except AffrectError as error:
            what, _, usual = _without_path(path, error).partition("; ")
            restore = f"restore it, or use another --output-path than {self.quoted}"
            self.diagnosis.add("error", path, what, advice or usual or restore)
            return None

    def _require(self, path: Path) -> bool:
        if not path.exists():
            self.diagnosis.add("error", path, "is missing", f"{SAME_RUN} to make it anew")
        return path.exists()

    def _record(self) -> Mapping[str, Any]:
        context, record = Context(self.workspace), self.workspace.recorded()
        if "extract" in self.workspace.begun:
            _ = context.inputs, context.extraction
        _ = context.pairing, context.matching, context.verification, context.escalation
        _ = context.guiding, context.mapping
        return record

    def _stages(self, record: Mapping[str, Any]) -> list[str]:
        done = [stage for stage in STAGES if stage in record.get("begun", [])]
        stages, recipe = ", ".join(done) or "none", record.get("recipe", "")
        self.diagnosis.checked.append(f"{self.path}: stages on record: {stages}; recipe {recipe}")
        return done

    def _models(self) -> None:
        sparse = self.workspace.sparse
        sizes = [self._read(f, partial(self._num_images, f)) for f in model_folders(sparse)]
        listed = ", ".join(str(size) for size in sizes if size) or "no"
        self.diagnosis.checked.append(f"{sparse}: models of {listed} images")

    def _num_images(self, folder: Path) -> int:
        """Return how many images a model has; StoreError if it is damaged."""
        if not read_summary(folder):
            remake = f"run 'colmap-affrect map --output-path {self.quoted} --overwrite'"
            what = "is missing or damaged: how the model came about is not known any more"
            self.diagnosis.add("error", folder / SUMMARY, what, remake)
        return len(registered_names(folder))


def _without_path(path: Path, error: Exception) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}/") or type(error).__name__
