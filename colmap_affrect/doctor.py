"""What is wrong with an output folder, a COLMAP database, a model or the installation.

Nothing is changed: databases are examined in a copy. No run can begin in a folder meanwhile.
Files are read as runs read them, and what their readers say is what is found.
"""

import dataclasses
import json
import shlex
from collections.abc import Callable, Collection
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar, get_args

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.checks import CHECKS, WARNED, check_database
from colmap_affrect.colmap.database_copy import newest_schema_version, refuse_newer
from colmap_affrect.colmap.model_files import has_model, model_folder, read_given_model
from colmap_affrect.colmap.tables import (
    NoDatabaseError,
    open_read_only,
    read_tables,
)
from colmap_affrect.errors import (
    AffrectError,
    Option,
    OptionError,
    WorkspaceError,
    such_as,
    with_flags,
)
from colmap_affrect.features.weights import WEIGHT_FILES, find, is_published, remedy
from colmap_affrect.mappers.mapping import model_folders, read_summary
from colmap_affrect.options import Summarized, documented
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context

Read = TypeVar("Read")
Severity = Literal["error", "warning", "note"]
"""A program fails, or results are wrong; something is missing from results; worth knowing."""
SEVERITIES: tuple[Severity, ...] = get_args(Severity)
MAX_ITEMS_SHOWN = 5  # display
# Problems of databases that may be of use to COLMAP
HARMLESS = WARNED | {"camera-panorama"}
WRITABLE = "make it writable before running anything in it"
SAME_RUN = "give the same 'run' or 'extract' again (run.log has the command)"


@documented
@dataclass(frozen=True)
class Finding:
    """One thing that was found."""

    severity: Severity
    """``error``, ``warning`` or ``note``."""
    where: str
    """File, folder or part of the installation."""
    what: str
    """What is wrong with it."""
    advice: str
    """What helps."""


@documented
@dataclass
class Diagnosis(Summarized):
    """The result of an examination: what was looked at, and what was found, the worst first."""

    checked: list[str] = field(default_factory=list)
    """What was looked at."""
    findings: list[Finding] = field(default_factory=list)
    """What was found, the worst first."""

    def add(
        self, severity: Severity, where: Path | str, what: str, advice: str
    ) -> None:
        """Add a finding.

        Args:
            severity: of the finding.
            where: file, folder or part of the installation.
            what: is wrong with it.
            advice: what helps.
        """
        self.findings.append(
            Finding(severity=severity, where=str(where), what=what, advice=advice)
        )
        self.findings.sort(key=lambda found: SEVERITIES.index(found.severity))

    @property
    def num_errors(self) -> int:
        """Number of findings that are errors."""
        return self._count("error")

    def _count(self, severity: Severity) -> int:
        return sum(finding.severity == severity for finding in self.findings)

    def summary(self) -> str:
        """Return text for people."""
        lines = [f"checked  {line}" for line in self.checked]
        for finding in self.findings:
            lines.append(f"{finding.severity:8s} {finding.where}: {finding.what}")
            lines.append(f"         -> {finding.advice}")
        totals = []
        for severity in ("error", "warning"):
            count = self._count(severity)
            if count:
                totals.append(f"{count} {severity}{'s' if count > 1 else ''}")
        lines.append(", ".join(totals) or "no problems found")
        return "\n".join(lines)

    def to_json(self) -> str:
        """Return the same for programs."""
        content = {
            "num_errors": self.num_errors,
            "num_warnings": self._count("warning"),
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "checked": self.checked,
        }
        return json.dumps(content, indent=2, ensure_ascii=False)


@checks_arguments
def diagnose(
    path: PathLike | None = None, *, weights_path: PathLike | None = None
) -> Diagnosis:
    """Examine the installation and, if a path is given, an output folder, a database or a model.

    OptionError when something that is given is not there.
    """
    path = None if path is None else as_path(path, "path")
    weights_path = as_path_or_none(weights_path, "weights_path")
    if path is not None and not path.exists():
        wanted = "give an output folder, a COLMAP database or the folder of a model"
        raise OptionError("no such file or folder", where=path, advice=wanted)
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError("no such folder", where=Option("weights", weights_path))
    diagnosis = Diagnosis()
    if path is not None and path.is_dir():
        _examine_folder(diagnosis, path)
    elif path is not None:
        examine_database(diagnosis, path)
    _examine_installation(diagnosis, weights_path)
    return diagnosis


def _examine_installation(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    versions = [f"{name} {number}" for name, number in installed_versions().items()]
    diagnosis.checked.append(f"installation: {', '.join(versions)}")
    try:
        from colmap_affrect.features.networks import resolve_device
    except (ImportError, OSError) as error:
        advice = "install them again; recipes with RootSIFT work without"
        diagnosis.add(
            "error",
            "installation",
            f"torch or kornia cannot be loaded ({error})",
            advice,
        )
        return
    diagnosis.checked.append(f"networks: run on {resolve_device('auto')}")
    _examine_weights(diagnosis, weights_path)


def _examine_weights(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    found = {}
    for key in WEIGHT_FILES:
        path = find(key, weights_path)
        if path:
            found[key] = path
    files = ", ".join(sorted(map(str, found.values())))
    diagnosis.checked.append(f"weights: {files or 'none found'}")
    for key, path in found.items():
        if is_published(key, path) is False:
            what = f"not the published file of {key}"
            diagnosis.add(
                "warning", path, what, f"unless it is your own, {remedy(path)}"
            )


def examine_database(diagnosis: Diagnosis, path: Path, advice: str = "") -> bool:
    """Examine a COLMAP database.

    Args:
        diagnosis: gets what is found.
        path: the database, which is only read.
        advice: what to do about problems, where it is not what ``CHECKS`` says.

    Returns:
        Whether the database is usable.
    """
    try:
        version = refuse_newer(path)
        newest = newest_schema_version()
        tables, problems = check_database(path)
    except NoDatabaseError as error:
        _add_error(diagnosis, path, error, advice or "give a database")
        return False
    except AffrectError as error:
        recover = "'sqlite3 FILE .recover' may save a part of a damaged database"
        _add_error(
            diagnosis, path, error, advice or with_flags(error.advice) or recover
        )
        return False
    quoted = shlex.quote(str(path))
    if version < newest:
        older = (
            f"has the tables of an older COLMAP (schema {version}, now {newest}); COLMAP 4 and "
            "pycolmap change them as soon as they open it, and an older COLMAP cannot read it "
            "any more"
        )
        copy = f"cp {quoted} {shlex.quote(str(path.with_suffix('.old.db')))}"
        diagnosis.add("note", path, older, f"keep a copy: {copy}")
    diagnosis.checked.append(f"{path}: {tables.summary()}")
    for kind in sorted(problems, key=list(CHECKS).index):
        what = CHECKS[kind]["what"]
        usual = CHECKS[kind]["advice"]
        items = f" ({len(problems[kind])}): {such_as(problems[kind], MAX_ITEMS_SHOWN)}"
        severity: Severity = "warning" if kind in HARMLESS else "error"
        diagnosis.add(
            severity, path, f"{what}{items}", advice or usual.format(path=quoted)
        )
    return True


def _examine_folder(diagnosis: Diagnosis, path: Path) -> None:
    """Examine an output folder, unless somebody is working in it."""
    workspace = Workspace(path)
    if path.suffix == ".affrect" and not workspace.database.exists():
        workspace = Workspace(path, path.with_suffix(".db"))
    if not workspace.config.exists() and not workspace.database.exists():
        if has_model(model_folder(path)):
            _examine_model(diagnosis, path)
            return
        what = "neither an output folder of colmap-affrect nor one with a database.db or a model"
        advice = "give the --output-path of a run, a COLMAP database or the folder of a model"
        diagnosis.add("error", path, what, advice)
        return
    if not workspace.config.exists():
        what = "is no output folder of colmap-affrect (it has no config.toml)"
        advice = "use another --output-path for colmap-affrect"
        diagnosis.add("note", path, f"{what}; only its database is checked", advice)
        examine_database(diagnosis, workspace.database)
        return
    with ExitStack() as stack:
        try:
            stack.enter_context(workspace.locked())
        except (WorkspaceError, OptionError) as error:
            in_use = isinstance(error.__cause__, TimeoutError)
            advice = with_flags(error.advice)
            severity: Severity = "warning"
            if in_use:
                advice = "run doctor again when it is done"
            elif isinstance(error, OptionError):
                severity = "error"  # no command works in it
            diagnosis.add(severity, path, _fault_of(error, path), advice or WRITABLE)
            if in_use:
                return
        _OutputFolder(diagnosis, workspace).examine()


def _examine_model(diagnosis: Diagnosis, path: Path) -> None:
    """Examine a COLMAP model of any program."""
    try:
        model = read_given_model(path)
    except AffrectError as error:
        advice = with_flags(error.advice) or "make the model again"
        _add_error(diagnosis, path, error, advice)
        return
    registered = model.num_reg_images()
    points = model.num_points3D()
    diagnosis.checked.append(
        f"{path}: a model of {registered} images and {points} points"
    )


@dataclass(frozen=True)
class _OutputFolder:
    """An output folder whose files are examined."""

    diagnosis: Diagnosis
    workspace: Workspace

    def read(
        self, path: Path, reader: Callable[[], Read], advice: str = ""
    ) -> Read | None:
        """Read a file; what is wrong with it is a finding, and None is returned.

        Args:
            path: the file.
            reader: reads it.
            advice: what helps; by default what the error says.
        """
        try:
            return reader()
        except AffrectError as error:
            quoted = shlex.quote(str(self.workspace.path))
            restore = f"restore it, or use another --output-path than {quoted}"
            helps = advice or with_flags(error.advice) or restore
            _add_error(self.diagnosis, path, error, helps)
            return None

    def examine(self) -> None:
        """Read every file, that of one stage after the other."""
        workspace = self.workspace
        context = Context(workspace)
        done = (
            self.read(workspace.config, lambda: _stages(self.diagnosis, context)) or []
        )
        self.read(workspace.cameras, lambda: read_camera_records(workspace.cameras))
        if done:
            self._examine_stores(context)
        self._require_files(context, done)
        if not workspace.database.exists():
            return
        advice = ""
        if done and not workspace.users_database:
            advice = f"remove it and {SAME_RUN}: it is made anew"
        is_usable = examine_database(self.diagnosis, workspace.database, advice)
        if is_usable and "extract" in done:
            self._examine_counts(context)
        if is_usable and "map" in done:
            self._examine_models()

    def _require_files(self, context: Context, done: Collection[str]) -> None:
        """Find what is missing of the files that stages which are done have left."""
        if "extract" in done:
            self._require(self.workspace.features)
            if "match" in done:
                self._require(self.workspace.matches)
            self._examine_pairs(context, are_listed="match" in done)
        if not {"copy", "verify"}.isdisjoint(done):  # else the next stage makes it
            self._require(self.workspace.database)

    def _examine_counts(self, context: Context) -> None:
        """Find images of which the database has more features than their file, as of another run.

        Fewer are no fault: what is lacking is written by the next command.
        """
        counts = dict[str, int]()
        with suppress(AffrectError):  # which has been found before
            counts = context.features.num_keypoints()
        with open_read_only(self.workspace.database) as connection:
            tables = read_tables(connection)
        others = list[str]()
        for image_id, name in tables.names.items():
            num_known, _ = tables.keypoints.get(image_id, (0, 0))
            if num_known > counts.get(name, num_known):
                others.append(name)
        if others:
            what = f"has fewer features than database.db of {such_as(sorted(others))}"
            advice = "run the same 'extract' with --overwrite (run.log has the command)"
            self.diagnosis.add("error", self.workspace.features, what, advice)

    def _require(self, path: Path) -> None:
        """Find a file that is missing."""
        if not path.exists():
            self.diagnosis.add(
                "error", path, "is missing", f"{SAME_RUN} to make it anew"
            )

    def _examine_stores(self, context: Context) -> None:
        """Read all features and matches."""
        for store in (context.features, context.matches, context.guided):
            self.read(store.path, store.check_all)
            self.diagnosis.checked.append(f"{store.path}: all values")

    def _examine_pairs(self, context: Context, *, are_listed: bool) -> None:
        """Read the names of the images, and the list of their pairs."""
        names = self.read(self.workspace.path, lambda: list(context.inputs.names()))
        if names and are_listed:
            path = self.workspace.pairs
            quoted = shlex.quote(str(self.workspace.path))
            again = f"run 'colmap-affrect pairs --output-path {quoted} --overwrite'"
            self.read(path, lambda: read_pairs(path, names), again)

    def _examine_models(self) -> None:
        """Say what models there are, and whether some are gone."""
        workspace = self.workspace
        counts = list[str]()
        for folder in model_folders(workspace.sparse):
            summary = self.read(folder, partial(read_summary, folder))
            if summary:
                counts.append(str(len(summary.registered_names)))
        if workspace.lacks_models() and workspace.mapping_record:
            advice = f"{SAME_RUN}: maps again"
            self.diagnosis.add("error", workspace.sparse, "models are gone", advice)
        listed = ", ".join(counts) or "no"
        self.diagnosis.checked.append(f"{workspace.sparse}: models of {listed} images")


def _stages(diagnosis: Diagnosis, context: Context) -> list[str]:
    """Return the stages that have begun, after all options on record have been read."""
    workspace = context.workspace
    done = context.workspace.started_stages
    if "extract" in done:
        _ = context.inputs, context.extraction
    _ = context.pairing, context.matching, context.verification, context.escalation
    _ = context.guiding, context.mapping
    stages = f"{', '.join(done) or 'none'}; recipe {workspace.recipe()}"
    diagnosis.checked.append(f"{workspace.path}: stages on record: {stages}")
    return done


def _add_error(
    diagnosis: Diagnosis, path: Path, error: AffrectError, advice: str
) -> None:
    """Add what a reader says of a file as a finding."""
    diagnosis.add("error", path, _fault_of(error, path), advice)


def _fault_of(error: AffrectError, path: Path) -> str:
    """Return what an error says is wrong, and with which part of what is examined."""
    what = with_flags(error.what)
    where = error.where
    if not where or where == path:
        return what
    if isinstance(where, Path) and where.is_relative_to(path):
        where = where.relative_to(path)
    return f"{with_flags(where)}: {what}"
