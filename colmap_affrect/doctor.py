"""What is wrong with an output folder, a COLMAP database or the installation, and what helps.

Nothing is changed: databases are looked at in a copy. No run can begin in a folder meanwhile.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.colmap.checks import (
    CHECKS,
    SEVERITIES,
    Kind,
    Problem,
    Severity,
    Tables,
    check_database,
    check_image_files,
    is_unsafe,
)
from colmap_affrect.colmap.copies import copy_database, newest_schema_version, schema_version
from colmap_affrect.colmap.database import geometry_digest
from colmap_affrect.colmap.model_files import registered_names
from colmap_affrect.errors import AffrectError, DatabaseError, ImageError, WorkspaceError
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.features.weights import describe_weights
from colmap_affrect.imaging import read_gray
from colmap_affrect.matching.pairs import read_pairs
from colmap_affrect.pipeline import installed_versions
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.stages import (
    INPUTS,
    feature_store,
    match_store,
    recorded_images,
)
from colmap_affrect.store import pair_key
from colmap_affrect.workspace import STAGES, Workspace

MAX_ITEMS_SHOWN = 5

DAMAGED_HDF5 = (OSError, RuntimeError, KeyError, ValueError, TypeError)
"""What h5py raises on damaged files that it could open."""

DAMAGED_RECORD = (KeyError, TypeError, ValueError, AttributeError)
"""What reading a record of options of another shape than ours raises."""

LEFTOVERS = ("*.new", "*.partial")

USUAL_WEIGHTS = ("affnet", "orinet", "hardnet")
"""What learned features need by default."""


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        severity: ``error`` (a program will fail, or results are wrong), ``warning`` (something
            is missing from the results), or ``note`` (worth knowing).
        where: file, folder or part of the installation.
        what: what is wrong there.
        advice: what to do about it.
    """

    severity: Severity
    where: str
    what: str
    advice: str


@dataclass(frozen=True)
class Diagnosis:
    """The result of an examination: what was found, worst first, and what was looked at."""

    findings: tuple[Finding, ...]
    checked: tuple[str, ...]

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
        counts = [
            f"{count} {severity}{'s' * (count > 1)}"
            for severity in SEVERITIES[:2]
            if (count := self._count(severity))
        ]
        return "\n".join([*lines, ", ".join(counts) or "no problems found"])

    def to_json(self) -> str:
        """Return the same for programs."""
        content = {
            "num_errors": self.num_errors,
            "num_warnings": self._count("warning"),
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "checked": list(self.checked),
        }
        return json.dumps(content, indent=2, ensure_ascii=False)


def diagnose(
    path: Path | None = None,
    *,
    image_path: Path | None = None,
    weights_path: Path | None = None,
    progress: Progress = SILENT,
) -> Diagnosis:
    """Examine the installation and, if a path is given, an output folder or a COLMAP database.

    Args:
        path: output folder of colmap-affrect, or any COLMAP database.
        image_path: folder of the photographs, whose sizes are compared with the cameras.
        weights_path: folder in which weights of networks are looked for first.
        progress: where the reading of photographs is shown.

    Returns:
        The findings; also for files that are damaged or something else.
    """
    examination = _Examination(progress)
    if image_path is not None and not image_path.is_dir():
        examination.error(image_path, "no such folder", "give the folder of the photographs")
        image_path = None
    if path is not None and path.is_dir():
        examination.folder(path, image_path)
    elif path is not None:
        examination.database(path, image_path)
    examination.installation(weights_path)
    return examination.diagnosis()


EXTRACT_AGAIN = "run the same 'extract' or 'run' with --overwrite (run.log has the command)"
MATCH_AGAIN = "run 'colmap-affrect match --output-path {folder} --overwrite', verify and map"
VERIFY_AGAIN = "run 'colmap-affrect verify --output-path {folder} --overwrite' and map"

OWN_ADVICE: dict[Kind, str] = {
    "no-images": EXTRACT_AGAIN,
    "no-camera": EXTRACT_AGAIN,
    "no-frame": EXTRACT_AGAIN,
    "keypoint-columns": EXTRACT_AGAIN,
    "keypoint-data": EXTRACT_AGAIN,
    "keypoints-not-finite": EXTRACT_AGAIN,
    "keypoints-outside": EXTRACT_AGAIN,
    "descriptor-count": EXTRACT_AGAIN,
    "descriptor-types": EXTRACT_AGAIN,
    "no-matches": "run 'colmap-affrect match --output-path {folder}'",
    "match-data": MATCH_AGAIN,
    "match-range": MATCH_AGAIN,
    "self-pair": MATCH_AGAIN,
    "unknown-pair": MATCH_AGAIN,
    "no-geometry": "run 'colmap-affrect verify --output-path {folder}' and map",
    "undefined-geometry": VERIFY_AGAIN,
}
"""What to do instead where the database is in a folder of ours."""


class _Examination:
    """Collects findings."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.findings: list[Finding] = []
        self.checked: list[str] = []

    def diagnosis(self) -> Diagnosis:
        """Return what was found, the worst first."""
        ordered = sorted(self.findings, key=lambda finding: SEVERITIES.index(finding.severity))
        return Diagnosis(tuple(ordered), tuple(self.checked))

    def error(self, where: Path | str, what: str, advice: str) -> None:
        self.findings.append(Finding("error", str(where), what, advice))

    def warning(self, where: Path | str, what: str, advice: str) -> None:
        self.findings.append(Finding("warning", str(where), what, advice))

    def note(self, where: Path | str, what: str, advice: str) -> None:
        self.findings.append(Finding("note", str(where), what, advice))

    def installation(self, weights_path: Path | None) -> None:
        """Examine versions, import order, device, weights and the COLMAP program."""
        where = "installation"
        versions = ", ".join(f"{name} {number}" for name, number in installed_versions().items())
        self.checked.append(f"installation: {versions}")
        loaded = list(sys.modules)
        if loaded.index("pycolmap") < loaded.index("colmap_affrect"):
            self.warning(
                where,
                "pycolmap was imported before colmap_affrect; if nothing has used zlib before, "
                "Python's zlib (PNG files, compressed arrays) ends the process",
                "import colmap_affrect first",
            )
        if weights_path is not None and not weights_path.is_dir():
            self.error(f"--weights {weights_path}", "not a folder", "give the folder of weights")
        try:
            self._networks(weights_path)
        except (ImportError, OSError) as error:
            self.error(
                where,
                f"torch or kornia cannot be loaded ({error})",
                "install them again; recipes with RootSIFT work without",
            )
        if shutil.which("colmap") is None:
            self.note(
                where,
                "the program colmap is not on PATH",
                "it is needed to look at models ('colmap gui') and for its own commands only",
            )

    def _networks(self, weights_path: Path | None) -> None:
        from colmap_affrect.features.networks import resolve_device

        device = resolve_device("auto")
        self.checked.append(f"networks: run on {device}")
        if device.type == "cpu":
            self.note(
                "networks",
                "torch sees no GPU that it can use",
                "nothing to do for RootSIFT; learned features and depth networks take longer",
            )
        rows = describe_weights(weights_path)
        found = ", ".join(str(row.path) for row in rows if row.path)
        self.checked.append(f"weights: {found or 'none found'}")
        for row in rows:
            if row.verified is False:
                self.warning(
                    str(row.path),
                    "not the published file",
                    "remove it and run 'colmap-affrect weights fetch', unless it is your own",
                )
        missing = [row.file_name for row in rows if row.key in USUAL_WEIGHTS and not row.path]
        if missing:
            self.note(
                "weights",
                f"not found: {', '.join(missing)}",
                "run 'colmap-affrect weights fetch' before using learned features without network",
            )

    def database(self, path: Path, image_path: Path | None) -> None:
        """Examine a COLMAP database."""
        with self.opened_copy(path) as copy:
            if copy is not None:
                self.database_copy(copy, path, image_path)

    @contextmanager
    def opened_copy(self, path: Path) -> Iterator[Path | None]:
        """Yield a copy of a database with the current schema, None where there can be none."""
        with tempfile.TemporaryDirectory() as temporary:
            copy = Path(temporary) / "database.db"
            try:
                version, newest = schema_version(path), newest_schema_version()
                copy_database(path, copy)
            except DatabaseError as error:
                self.error(
                    path,
                    _without(path, error).replace(str(copy), "a temporary file"),
                    "give a COLMAP database or an output folder of colmap-affrect; of a damaged "
                    "database, 'sqlite3 FILE .recover' may save a part",
                )
                yield None
                return
            if version < newest:
                self.note(
                    path,
                    f"was made by an older COLMAP (schema {version}, now {newest}), and is changed "
                    "to the new schema as soon as COLMAP or pycolmap opens it",
                    f"keep a copy: cp {_quoted(path)} {_quoted(path.with_suffix('.old.db'))}",
                )
            yield copy

    def database_copy(
        self, copy: Path, path: Path, image_path: Path | None, folder: Path | None = None
    ) -> Tables | None:
        """Examine a copy of a database; ``folder`` is the output folder that it belongs to."""
        try:
            tables, problems = check_database(copy)
        except DatabaseError as error:
            self.error(
                path,
                _without(copy, error),
                "'sqlite3 FILE .recover' may save a part of it; else make it anew",
            )
            return None
        self.checked.append(f"{path}: {tables.summary()}")
        if image_path is not None:
            sizes = self._file_sizes(image_path, list(tables.names.values()))
            problems += check_image_files(tables, image_path, sizes)
            self.checked.append(f"{image_path}: sizes of {len(sizes)} photographs")
        for problem in problems:
            self._database_problem(problem, path, folder)
        return tables

    def _database_problem(self, problem: Problem, path: Path, folder: Path | None) -> None:
        severity, what, advice = CHECKS[problem.kind]
        if folder is not None:
            advice = OWN_ADVICE.get(problem.kind, advice)
        advice = advice.format(path=_quoted(path), folder=_quoted(folder or path.parent))
        self.findings.append(Finding(severity, str(path), _listed(what, problem.items), advice))

    def _file_sizes(
        self, image_path: Path, names: Sequence[str]
    ) -> dict[str, tuple[int, int] | None]:
        """Read photographs for their (width, height), None for those that cannot be read."""

        def size_of(name: str) -> tuple[int, int] | None:
            try:
                height, width = read_gray(image_path / name).shape
            except ImageError:
                return None
            return width, height

        there = [n for n in names if not is_unsafe(n) and (image_path / n).is_file()]
        sizes = {}
        with self.progress.stage("read", len(there), "images") as advance:
            found = map_ordered(size_of, there, available_cores())
            for name, size in zip(there, found, strict=True):
                sizes[name] = size
                advance(1)
        return sizes

    def folder(self, path: Path, image_path: Path | None) -> None:
        """Examine an output folder."""
        workspace = Workspace(path)
        if path.suffix == ".affrect" and not workspace.database.exists():
            workspace = Workspace(path, path.with_suffix(".db"))
        if not workspace.config.exists():
            if workspace.database.exists():
                self.note(
                    path,
                    "is no output folder of colmap-affrect (it has no config.toml); only its "
                    "database is checked",
                    "use another --output-path for colmap-affrect",
                )
                self.database(workspace.database, image_path)
            else:
                self.error(
                    path,
                    "neither an output folder of colmap-affrect nor one with a database.db",
                    "give the --output-path of a run, or a COLMAP database",
                )
            return
        with ExitStack() as stack:
            try:
                stack.enter_context(workspace.locked())
            except WorkspaceError as error:
                in_use = isinstance(error.__cause__, TimeoutError)
                again = "run doctor again when it is done"
                advice = again if in_use else "make it writable before running anything in it"
                self.warning(path, _without(path, error), advice)
                if in_use:
                    return
            _FolderExamination(self, workspace).examine(image_path)


class _FolderExamination:
    """Examines an output folder that nobody else is working in."""

    def __init__(self, found: _Examination, workspace: Workspace) -> None:
        self.found = found
        self.workspace = workspace
        self.quoted = _quoted(workspace.path)

    def examine(self, image_path: Path | None) -> None:
        """Add what is found in the folder."""
        self._leftovers()
        done = self._stages()
        database = self.workspace.database
        if "extract" not in done:
            if database.exists():
                self.found.database(database, image_path)
            return
        folder = None if self.workspace.users_database else self.workspace.path
        features = self._features()
        images = self._photographs(features)
        if not database.exists():
            self.found.error(database, "is missing", f"{self._again('extract')} to make it anew")
            return
        with self.found.opened_copy(database) as copy:
            if copy is None:
                return
            tables = self.found.database_copy(copy, database, image_path, folder)
            if tables is None:
                return
            if features is not None:
                self._compare_keypoints(features, tables)
                if "match" in done:
                    self._matches(tables, sorted(images.union(features)))
            if "map" in done:
                self._models(geometry_digest(copy))

    def _again(self, stage: str) -> str:
        if stage == "extract":
            return "run the same 'extract' or 'run' again (run.log has the command)"
        return f"run 'colmap-affrect {stage} --output-path {self.quoted}'"

    def _leftovers(self) -> None:
        left = sorted(p for pattern in LEFTOVERS for p in self.workspace.path.glob(pattern))
        for path in left:
            self.found.note(
                path, "left behind by a run that was killed", f"remove it: rm -r {_quoted(path)}"
            )

    def _stages(self) -> list[str]:
        """Return the stages on record, none if the record cannot be used."""
        workspace = self.workspace
        try:
            record = workspace.recorded()
            done = [stage for stage in STAGES if stage in record]
            wanted = list(STAGES)
            if "extract" in done and not workspace.extraction_options().escalation:
                wanted.remove("escalate")
            if "match" in done:
                workspace.matching_options()
            if "verify" in done:
                workspace.verification_options()
            if "extract" in done:
                for key in ("image_path", "image_list_path", "from_database"):
                    Path(record["extract"][key])
        except (AffrectError, OSError, *DAMAGED_RECORD) as error:
            self.found.error(
                workspace.config,
                f"cannot be used ({_without(workspace.config, error)})",
                f"restore it, or use another --output-path than {self.quoted}",
            )
            return []
        self.found.checked.append(
            f"{workspace.path}: stages on record: {', '.join(done) or 'none'}; recipe "
            f"{record.get('recipe', '')}"
        )
        following = [stage for stage in wanted if stage not in done]
        if following and not workspace.users_database:
            self.found.note(
                workspace.path,
                f"not run yet: {', '.join(following)}",
                f"{self._again(following[0])}, or the same 'run' again",
            )
        return done

    def _features(self) -> dict[str, int] | None:
        """Return the number of features by image name, None if the file cannot be used."""
        path = self.workspace.features
        if not path.exists():
            self.found.error(path, "is missing", self._again("extract"))
            return None
        store = feature_store(self.workspace)
        try:
            counts = store.num_keypoints()
        except (AffrectError, *DAMAGED_HDF5) as error:
            self._unusable(path, error, EXTRACT_AGAIN)
            return None
        self.found.checked.append(f"{path}: features of {len(counts)} images")
        return counts

    def _unusable(self, path: Path, error: Exception, advice: str) -> None:
        self.found.error(path, f"cannot be used ({_without(path, error)})", advice)

    def _photographs(self, features: Mapping[str, int] | None) -> set[str]:
        """Return the names of the photographs that the record is of."""
        try:
            names = set(recorded_images(self.workspace))
        except AffrectError as error:
            self.found.warning(
                self.workspace.path,
                f"its photographs are not there ({error})",
                "put them back before running another stage",
            )
            return set()
        if features is None:
            return names
        new, gone = sorted(names - features.keys()), sorted(features.keys() - names)
        where = str(self.workspace.recorded()["extract"]["image_path"])
        if new:
            self.found.warning(
                where,
                _listed("images without features: added later, half done, or not readable", new),
                self._again("extract"),
            )
        if gone:
            self.found.warning(
                where,
                _listed("images with features that are gone or not listed any more", gone),
                "put them back, or use another --output-path for the smaller set",
            )
        return names

    def _compare_keypoints(self, features: Mapping[str, int], tables: Tables) -> None:
        """Compare the feature file with the database."""
        database = self.workspace.database
        counts = tables.num_keypoints()
        missing = [name for name in features if name not in counts]
        if missing:
            self.found.warning(
                database,
                _listed("images whose features are not in the database", missing),
                self._again("extract"),
            )
        # Escalation adds features behind those that were there.
        store = feature_store(self.workspace)
        other = [name for name in features if name in counts and counts[name] != features[name]]
        behind = [name for name in other if counts[name] in store.level_ends(name)]
        differ = sorted(set(other) - set(behind))
        if behind:
            self.found.warning(
                database,
                _listed("images with features of escalation that the database lacks", behind),
                self._again("escalate"),
            )
        if differ:
            items = [f"{name} has {counts[name]} of {features[name]}" for name in differ]
            self.found.error(
                database,
                _listed("images with other keypoints than in features.h5", items),
                EXTRACT_AGAIN,
            )

    def _matches(self, tables: Tables, names: Sequence[str]) -> None:
        path = self.workspace.matches
        try:
            pairs = read_pairs(self.workspace.pairs, names) if len(names) > 1 else []
        except AffrectError as error:
            self._unusable(self.workspace.pairs, error, f"{self._again('pairs')} --overwrite")
            return
        try:
            store = match_store(self.workspace)
            complete = store.complete(pair_key(*pair) for pair in pairs)
        except (AffrectError, *DAMAGED_HDF5) as error:
            self._unusable(path, error, MATCH_AGAIN.format(folder=self.quoted))
            return
        self.found.checked.append(f"{path}: matches of {len(complete)} pairs of {len(pairs)}")
        matched = [pair for pair in pairs if pair_key(*pair) in complete]
        missing = [" - ".join(pair) for pair in pairs if pair_key(*pair) not in complete]
        if missing:
            self.found.warning(
                path, _listed("listed pairs that are not matched", missing), self._again("match")
            )
        known, written = set(tables.names.values()), tables.matched_pairs()
        lost = [
            " - ".join(pair) for pair in matched if known.issuperset(pair) and pair not in written
        ]
        if lost:
            self.found.warning(
                self.workspace.database,
                _listed("pairs whose matches are not in the database", lost),
                self._again("match"),
            )

    def _models(self, inputs: str) -> None:
        sparse, again = self.workspace.sparse, self._again("map")
        try:
            made_from = (sparse / INPUTS).read_text()
        except (OSError, UnicodeDecodeError):
            self.found.warning(sparse, "mapping did not finish", again)
            return
        if made_from != inputs:
            self.found.warning(
                sparse, "the models were made before pairs were verified anew", again
            )
        folders = [path for path in sparse.iterdir() if path.name.isdigit()]
        sizes = []
        for folder in sorted(folders, key=lambda path: int(path.name)):
            try:
                sizes.append(len(registered_names(folder)))
            except AffrectError as error:
                self.found.error(folder, _without(folder, error), f"{again} --overwrite")
        self.found.checked.append(
            f"{sparse}: models of {', '.join(map(str, sizes)) or 'no'} images"
        )
        if not folders:
            self.found.warning(
                sparse, "mapping found no model", "see 'unregistered' in report.json for reasons"
            )


def _listed(what: str, items: Sequence[str]) -> str:
    """Return what is wrong, with how many and the first of them."""
    if not items:
        return what
    more = len(items) - MAX_ITEMS_SHOWN
    shown = ", ".join(items[:MAX_ITEMS_SHOWN]) + (f" and {more} more" * (more > 0))
    return f"{what} ({len(items)}): {shown}"


def _without(path: Path, error: Exception) -> str:
    """Return the message of an error without the path that it begins with."""
    if isinstance(error, KeyError):
        return f"it lacks {error}"
    return str(error).removeprefix(f"{path}: ").removeprefix(f"{path}/") or type(error).__name__


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
