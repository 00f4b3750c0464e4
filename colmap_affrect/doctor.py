"""What is wrong with an output folder, a COLMAP database, a model or the installation.

Nothing is changed: databases are examined in a copy. No run can begin in a folder meanwhile.
Files are read as runs read them, and what their readers say is what is found.
"""

import dataclasses
import json
import shlex
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.checks import CHECKS, WARNED, check_database
from colmap_affrect.colmap.database_copy import newest_schema_version, refuse_newer
from colmap_affrect.colmap.model_files import has_model, model_folder, read_given_model
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, WorkspaceError, such_as
from colmap_affrect.features.weights import WEIGHT_FILES, find, is_published, remedy
from colmap_affrect.mappers.mapping import model_folders, read_summary
from colmap_affrect.options import Summarized, documented
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.paths import PathLike, as_path, as_path_or_none
from colmap_affrect.project.report import ModelSummary, installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context

Read = TypeVar("Read")
Severity = Literal["error", "warning", "note"]
"""A program fails, or results are wrong; something is missing from results; worth knowing."""
SEVERITIES: tuple[Severity, ...] = get_args(Severity)
MAX_ITEMS_SHOWN = 5
HARMLESS = WARNED | {"camera-panorama"}  # problems of databases that may be of use to COLMAP
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

    def add(self, severity: Severity, where: Path | str, what: str, advice: str) -> None:
        """Add what is wrong with a file, folder or part of the installation, and what helps."""
        self.findings.append(Finding(severity, str(where), what, advice))
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
        counts = {severity: self._count(severity) for severity in SEVERITIES[:2]}
        found = [f"{count} {name}{'s' * (count > 1)}" for name, count in counts.items() if count]
        return "\n".join([*lines, ", ".join(found) or "no problems found"])

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
def diagnose(path: PathLike | None = None, *, weights_path: PathLike | None = None) -> Diagnosis:
    """Examine the installation and, if a path is given, an output folder, a database or a model.

    OptionError when something that is given is not there.
    """
    path = None if path is None else as_path(path, "path")
    weights_path = as_path_or_none(weights_path, "weights_path")
    if path is not None and not path.exists():
        wanted = "give an output folder, a COLMAP database or the folder of a model"
        raise OptionError(f"{path}: no such file or folder; {wanted}")
    if weights_path is not None and not weights_path.is_dir():
        raise OptionError(f"--weights {weights_path}: no such folder")
    diagnosis = Diagnosis()
    if path is not None:
        (_examine_folder if path.is_dir() else examine_database)(diagnosis, path)
    _examine_installation(diagnosis, weights_path)
    return diagnosis


def _examine_installation(diagnosis: Diagnosis, weights_path: Path | None) -> None:
    versions = ", ".join(f"{name} {number}" for name, number in installed_versions().items())
    diagnosis.checked.append(f"installation: {versions}")
    try:
        from colmap_affrect.features.networks import resolve_device
    except (ImportError, OSError) as error:
        advice = "install them again; recipes with RootSIFT work without"
        diagnosis.add(
            "error", "installation", f"torch or kornia cannot be loaded ({error})", advice
        )
        return
    diagnosis.checked.append(f"networks: run on {resolve_device('auto')}")
    found = {key: path for key in WEIGHT_FILES if (path := find(key, weights_path))}
    files = ", ".join(sorted(map(str, found.values())))
    diagnosis.checked.append(f"weights: {files or 'none found'}")
    for key, path in found.items():
        if is_published(key, path) is False:
            what = f"not the published file of {key}"
            advice = remedy(path)
            diagnosis.add("warning", path, what, f"unless it is your own, {advice}")


def examine_database(diagnosis: Diagnosis, path: Path, advice: str = "") -> bool:
    """Examine a COLMAP database; return whether it is usable.

    ``advice`` is what to do about problems, where it is not what ``CHECKS`` says.
    """
    try:
        version = refuse_newer(path)
        newest = newest_schema_version()
        tables, problems = check_database(path)
    except DatabaseError as error:
        recover = "'sqlite3 FILE .recover' may save a part of a damaged database"
        diagnosis.add("error", path, _without_path(path, error), advice or recover)
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
        diagnosis.add(severity, path, f"{what}{items}", advice or usual.format(path=quoted))
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
            writable = "make it writable before running anything in it"
            advice = "run doctor again when it is done" if in_use else writable
            diagnosis.add("warning", path, _without_path(path, error), advice)
            if in_use:
                return
        _examine_files(diagnosis, workspace)


def _examine_model(diagnosis: Diagnosis, path: Path) -> None:
    """Examine a COLMAP model of any program."""
    try:
        model = read_given_model(path)
    except AffrectError as error:
        what, _, advice = _without_path(path, error).partition("; ")
        diagnosis.add("error", path, what, advice or "make the model again")
        return
    registered = model.num_reg_images()
    points = model.num_points3D()
    diagnosis.checked.append(f"{path}: a model of {registered} images and {points} points")


def _examine_files(diagnosis: Diagnosis, workspace: Workspace) -> None:
    """Read every file of an output folder, that of one stage after the other."""
    context = Context(workspace)
    quoted = shlex.quote(str(workspace.path))

    def read(path: Path, reader: Callable[..., Read], *given: Any, advice: str = "") -> Read | None:
        try:
            return reader(*given)
        except AffrectError as error:
            what, _, usual = _without_path(path, error).partition("; ")
            restore = f"restore it, or use another --output-path than {quoted}"
            diagnosis.add("error", path, what, advice or usual or restore)
            return None

    def is_there(path: Path) -> bool:
        if not path.exists():
            diagnosis.add("error", path, "is missing", f"{SAME_RUN} to make it anew")
        return path.exists()

    done = read(workspace.config, _stages, diagnosis, context) or []
    read(workspace.cameras, read_camera_records, workspace.cameras)
    for store in (context.features, context.matches, context.guided) if done else ():
        read(store.path, store.check_all)
        diagnosis.checked.append(f"{store.path}: all values")
    if "extract" in done:
        is_there(workspace.features)
        names = read(workspace.path, lambda: list(context.inputs.names()))
        if names and "match" in done:
            again = f"run 'colmap-affrect pairs --output-path {quoted} --overwrite'"
            read(workspace.pairs, read_pairs, workspace.pairs, names, advice=again)
    if not (is_there(workspace.database) if done else workspace.database.exists()):
        return
    remake = f"remove it and {SAME_RUN}: it is made anew"
    advice = remake if done and not workspace.users_database else ""
    if examine_database(diagnosis, workspace.database, advice) and "map" in done:
        found = [read(folder, read_summary, folder) for folder in model_folders(workspace.sparse)]
        _examine_models(diagnosis, workspace, [model for model in found if model])


def _examine_models(
    diagnosis: Diagnosis, workspace: Workspace, models: Sequence[ModelSummary]
) -> None:
    """Say what models there are, and whether some are gone."""
    if workspace.lacks_models() and workspace.mapped:
        diagnosis.add("error", workspace.sparse, "models are gone", f"{SAME_RUN}: maps again")
    listed = ", ".join(str(len(model.registered_names)) for model in models) or "no"
    diagnosis.checked.append(f"{workspace.sparse}: models of {listed} images")


def _stages(diagnosis: Diagnosis, context: Context) -> list[str]:
    """Return the stages that have begun, after all options on record have been read."""
    workspace = context.workspace
    done = context.workspace.begun
    if "extract" in done:
        _ = context.inputs, context.extraction
    _ = context.pairing, context.matching, context.verification, context.escalation
    _ = context.guiding, context.mapping
    stages = f"{', '.join(done) or 'none'}; recipe {workspace.recipe()}"
    diagnosis.checked.append(f"{workspace.path}: stages on record: {stages}")
    return done


def _without_path(path: Path, error: Exception) -> str:
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}/") or type(error).__name__
