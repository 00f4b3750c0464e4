"""Examines output folders and COLMAP databases, which are only read."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, TypeVar

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.checks import CHECKS, check_database, check_image_files
from colmap_affrect.colmap.database import geometry_digest
from colmap_affrect.colmap.database_copy import copy_as_it_is, newest_schema_version, refuse_newer
from colmap_affrect.colmap.model_files import SUMMARY, registered_names
from colmap_affrect.doctor.findings import (
    MATCH_AGAIN,
    OWN_ADVICE,
    PAIRS_AGAIN,
    SAME_RUN,
    Findings,
    without_path,
)
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, WorkspaceError
from colmap_affrect.images.reading import readable_size
from colmap_affrect.mappers.summaries import (
    model_folders,
    read_summary,
)
from colmap_affrect.pairs.base import PairList
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import Progress
from colmap_affrect.project.atomic_files import NEW_SUFFIX
from colmap_affrect.project.contents import file_sha256
from colmap_affrect.project.outputs import leads_outside
from colmap_affrect.project.record import COPY_STAGES, STAGES
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import changed_images, contents_of
from colmap_affrect.stages.inputs import Inputs
from colmap_affrect.stages.mend import edits_of
from colmap_affrect.stages.pairs import without_deleted

Read = TypeVar("Read")

LEFTOVERS = ("*.new", "*.partial", f"*{NEW_SUFFIX}")


def examine_database(
    findings: Findings,
    path: Path,
    image_path: Path | None,
    own_advice: Mapping[str, str] = MappingProxyType({}),
) -> bool:
    """Examine a COLMAP database, and the sizes of its photographs if their folder is given.

    ``own_advice`` says what to do about a problem by its kind, where it is not what ``TEXTS`` says.
    Returns whether the database can be used.
    """
    try:
        version, newest = refuse_newer(path), newest_schema_version()
    except DatabaseError as error:
        findings.add("no-database", path, error=without_path(path, error))
        return False
    if version < newest:
        kept = path.with_suffix(".old.db")
        findings.add("old-schema", path, version=version, newest=newest, path=path, copy=kept)
    try:
        tables, problems = check_database(path)
    except DatabaseError as error:
        findings.add("database-damaged", path, error=without_path(path, error))
        return False
    findings.checked.append(f"{path}: {tables.summary()}")
    if image_path is not None:
        sizes = _file_sizes(image_path, tables.names.values(), findings.progress)
        problems |= check_image_files(tables, image_path, sizes)
        findings.checked.append(f"{image_path}: sizes of {len(sizes)} photographs")
    for kind in sorted(problems, key=list(CHECKS).index):
        advice = own_advice.get(kind, "")
        findings.add(kind, path, problems[kind], advice=advice, path=path, folder=path.parent)
    return True


def _file_sizes(
    image_path: Path, names: Iterable[str], progress: Progress
) -> dict[str, tuple[int, int] | None]:
    """Read photographs for their (width, height), None for those that cannot be read."""
    present = [n for n in names if not leads_outside(n) and (image_path / n).is_file()]
    sizes = {}
    with progress.stage("read", len(present), "images") as advance:
        paths = (image_path / name for name in present)
        found = map_ordered(readable_size, paths, available_cores())
        for name, size in zip(present, found, strict=True):
            sizes[name] = size
            advance(1)
    return sizes


def examine_folder(findings: Findings, path: Path, image_path: Path | None) -> None:
    """Examine an output folder, unless somebody is working in it."""
    workspace = Workspace(path)
    if path.suffix == ".affrect" and not workspace.database.exists():
        workspace = Workspace(path, path.with_suffix(".db"))
    if not workspace.config.exists():
        if not workspace.database.exists():
            findings.add("no-folder", path)
            return
        findings.add("foreign-folder", path)
        examine_database(findings, workspace.database, image_path)
        return
    with ExitStack() as stack:
        try:
            stack.enter_context(workspace.locked())
        except (WorkspaceError, OptionError) as error:
            in_use = isinstance(error.__cause__, TimeoutError)
            kind = "in-use" if in_use else "read-only"
            findings.add(kind, path, error=without_path(path, error))
            if in_use:
                return
        _FolderExamination(findings, workspace).examine(image_path)


class _FolderExamination:
    """Examines an output folder that nobody else is working in."""

    def __init__(self, found: Findings, workspace: Workspace) -> None:
        self.found, self.workspace = found, workspace

    def examine(self, image_path: Path | None) -> None:
        for path in sorted(p for kind in LEFTOVERS for p in self.workspace.path.glob(kind)):
            self._add("leftover", path, path=path)
        done = self._stages()
        database = self.workspace.database
        if not done:
            if database.exists():
                examine_database(self.found, database, image_path)
            return
        self._records()
        features = self._features() if "extract" in done else None
        images = self._photographs(features) if "extract" in done else set()
        inputs = self._models() if "map" in done else ""
        if not database.exists():
            self._add("missing", database)
            return
        own_advice = {} if self.workspace.users_database else OWN_ADVICE
        edits = None if self.workspace.users_database else edits_of(database)
        if not examine_database(self.found, database, image_path, own_advice):
            return
        if edits and str(edits):
            self._add("database-changed", database, edits=edits)
        elif features is not None and "match" in done:
            self._matches(sorted(images.union(features)))
        if inputs:
            with TemporaryDirectory() as folder:  # COLMAP would change the original
                copy_as_it_is(database, copy := Path(folder) / database.name)
                if not inputs.startswith(geometry_digest(copy)):
                    self._add("map-stale", self.workspace.sparse)

    def _add(self, kind: str, where: Path, **values: Any) -> None:
        self.found.add(kind, where, folder=self.workspace.path, **values)

    def _read(self, path: Path, read: Callable[[], Read], advice: str = "") -> Read | None:
        """Read a file as runs do; None, and what the reader says, if that cannot be done."""
        try:
            return read()
        except AffrectError as error:
            what, _, usual = without_path(path, error).partition("; ")
            usual = usual.replace("{", "{{").replace("}", "}}")  # of a path
            self._add("damaged", path, error=what, advice=advice or usual)
            return None

    def _add_items(self, kind: str, where: Path | str, items: Sequence[str]) -> None:
        if items:
            self.found.add(kind, where, items, folder=self.workspace.path)

    def _record(self) -> Mapping[str, Any]:
        """Return the record, with options that later stages would take."""
        context, record = Context(self.workspace), self.workspace.recorded()
        if "extract" in self.workspace.begun:
            _ = context.inputs, context.extraction
        _ = context.pairing, context.matching, context.verification, context.escalation
        _ = context.guiding, context.mapping
        return record

    def _stages(self) -> list[str]:
        """Return the stages on record, none if the record cannot be used."""
        workspace = self.workspace
        record = self._read(workspace.config, self._record)
        if record is None:
            return []
        done = [stage for stage in STAGES if stage in record.get("begun", [])]
        wanted = list(COPY_STAGES if "copy" in done else STAGES[1:])
        wanted = [stage for stage in wanted if stage != "guide"]  # map does that when needed
        if "extract" in done and not Context(workspace).extraction.escalation:
            wanted.remove("escalate")
        self.found.checked.append(
            f"{workspace.path}: stages on record: {', '.join(done) or 'none'}; recipe "
            f"{record.get('recipe', '')}"
        )
        following = [stage for stage in wanted if stage not in done]
        if following and not workspace.users_database:
            command = f"run 'colmap-affrect {following[0]} --output-path {{folder}}'"
            again = SAME_RUN if following[0] == "extract" else command
            advice = f"{again}, or the same 'run' again"
            self._add("stages-missing", workspace.path, advice=advice, stages=", ".join(following))
        return done

    def _features(self) -> dict[str, int] | None:
        """Return the number of features by image name, None if the file cannot be used."""
        path, store = self.workspace.features, Context(self.workspace).features
        if not path.exists():
            self._add("missing", path)
            return None
        counts = self._read(path, store.num_keypoints)
        if counts is None or self._read(path, store.check_all) is None:
            return None
        self.found.checked.append(f"{path}: features of {len(counts)} images")
        return counts

    def _photographs(self, features: Mapping[str, int] | None) -> set[str]:
        """Return the names of the photographs that were recorded, if they can be found."""
        try:
            inputs = Context(self.workspace).inputs
            names = set(inputs.names())
        except AffrectError as error:
            self._add("photographs-gone", self.workspace.path, error=error)
            return set()
        if features is not None:
            where = inputs.image_path
            self._add_items("photographs-changed", where, self._changed(inputs, names))
            self._add_items("no-features", where, sorted(names - features.keys()))
            self._add_items("only-features", where, sorted(features.keys() - names))
        return names

    def _changed(self, inputs: Inputs, names: Collection[str]) -> list[str]:
        """Return the photographs that are not any more what their features are from."""
        context = Context(self.workspace)
        known = context.features.contents()
        both = known.keys() & names
        return changed_images(known, contents_of(inputs, both, context.extraction, known))

    def _matches(self, names: Sequence[str]) -> None:
        path, listed = self.workspace.matches, self.workspace.pairs
        store = Context(self.workspace).matches
        pairs = self._read(
            listed, lambda: read_pairs(listed, names) if len(names) > 1 else PairList.of(()),
            PAIRS_AGAIN,
        )  # fmt: skip
        if pairs is None:
            return
        pairs = without_deleted(self.workspace, pairs)
        is_there = self._read(path, lambda: store.has(pairs), MATCH_AGAIN)
        if is_there is None or self._read(path, store.check_all, MATCH_AGAIN) is None:
            return
        if store.finished_list() not in (None, "", file_sha256(listed)):
            self._add("pairs-changed", listed)
        self.found.checked.append(f"{path}: matches of {is_there.sum()} pairs of {len(pairs)}")
        missing = [
            " - ".join(p) for p, is_matched in zip(pairs, is_there, strict=True) if not is_matched
        ]
        self._add_items("pairs-not-matched", path, missing)

    def _records(self) -> None:
        """Read what is beside features, matches and models."""
        cameras, guided = self.workspace.cameras, Context(self.workspace).guided
        self._read(cameras, lambda: read_camera_records(cameras))
        self._read(guided.path, guided.check_all)

    def _models(self) -> str | None:
        """Return the digests of what the models were made from, if that can be read."""
        sparse = self.workspace.sparse
        inputs = self._read(sparse, self.workspace.models_made_from)
        if inputs == "":
            self._add("map-unfinished", sparse)
        folders = model_folders(sparse)
        sizes = [self._read(folder, partial(self._size, folder)) for folder in folders]
        listed = ", ".join(str(size) for size in sizes if size) or "no"
        self.found.checked.append(f"{sparse}: models of {listed} images")
        if sparse.exists() and not folders:
            self._add("no-model", sparse)
        return inputs

    def _size(self, folder: Path) -> int:
        """Return how many images a model has; StoreError if it is damaged."""
        if not read_summary(folder):
            self._add("summary-damaged", folder / SUMMARY)
        return len(registered_names(folder))
