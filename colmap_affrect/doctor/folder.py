"""Examines an output folder."""

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from colmap_affrect.colmap.database import geometry_digest
from colmap_affrect.colmap.model_files import registered_names
from colmap_affrect.colmap.tables import Tables
from colmap_affrect.doctor.database import examine_database, examined_copy
from colmap_affrect.doctor.findings import OWN_ADVICE, SAME_RUN, Findings, without_path
from colmap_affrect.errors import AffrectError, WorkspaceError
from colmap_affrect.pairs.base import PairList
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.project.atomic_files import NEW_SUFFIX
from colmap_affrect.project.contents import Contents
from colmap_affrect.project.workspace import COPY_STAGES, INPUTS, STAGES, Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import Inputs, recorded_extraction
from colmap_affrect.stages.match import recorded_matching
from colmap_affrect.stages.mend import edits_of
from colmap_affrect.stages.pairs import without_deleted
from colmap_affrect.stages.verify import recorded_verification

DAMAGED_HDF5 = (OSError, RuntimeError, KeyError, ValueError, TypeError)
"""What h5py raises on damaged files that it could open."""

DAMAGED_RECORD = (KeyError, TypeError, ValueError, AttributeError)
"""What reading a record of options of another shape than ours raises."""

LEFTOVERS = ("*.new", "*.partial", f"*{NEW_SUFFIX}")


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
        except WorkspaceError as error:
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
        if "extract" not in done:
            if database.exists():
                examine_database(self.found, database, image_path)
            return
        features = self._features()
        images = self._photographs(features)
        if not database.exists():
            self._add("database-missing", database)
            return
        own_advice = {} if self.workspace.users_database else OWN_ADVICE
        edits = None if self.workspace.users_database else edits_of(database)
        with examined_copy(self.found, database, image_path, own_advice) as examined:
            if examined is None:
                return
            copy, tables = examined
            if edits and str(edits):
                self._add("database-changed", database, edits=edits)
            elif features is not None:
                self._compare_keypoints(features, tables)
                if "match" in done:
                    self._matches(tables, sorted(images.union(features)))
            if "map" in done:
                self._models(geometry_digest(copy))

    def _add(self, kind: str, where: Path, **values: Any) -> None:
        self.found.add(kind, where, folder=self.workspace.path, **values)

    def _add_unusable(self, kind: str, where: Path, error: Exception) -> None:
        self._add(kind, where, error=without_path(where, error))

    def _add_items(self, kind: str, where: Path | str, items: Sequence[str]) -> None:
        if items:
            self.found.add(kind, where, items, folder=self.workspace.path)

    def _stages(self) -> list[str]:
        """Return the stages on record, none if the record cannot be used."""
        workspace = self.workspace
        try:
            record = workspace.recorded()
            done = [stage for stage in STAGES if stage in record.get("begun", [])]
            wanted = list(COPY_STAGES if "copy" in done else STAGES[1:])
            wanted = [stage for stage in wanted if stage != "guide"]  # map does that when needed
            if "extract" in done:
                Inputs.recorded(workspace)
                if not recorded_extraction(workspace).escalation:
                    wanted.remove("escalate")
            recorded_matching(workspace)
            recorded_verification(workspace)
        except (AffrectError, OSError, *DAMAGED_RECORD) as error:
            self._add_unusable("record-unusable", workspace.config, error)
            return []
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
        path = self.workspace.features
        if not path.exists():
            self._add("features-missing", path)
            return None
        try:
            counts = Context(self.workspace).features.num_keypoints()
        except (AffrectError, *DAMAGED_HDF5) as error:
            self._add_unusable("features-unusable", path, error)
            return None
        self.found.checked.append(f"{path}: features of {len(counts)} images")
        return counts

    def _photographs(self, features: Mapping[str, int] | None) -> set[str]:
        """Return the names of the photographs that were recorded, if they can be found."""
        try:
            inputs = Inputs.recorded(self.workspace)
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
        options, contents = recorded_extraction(self.workspace), Contents(self.workspace.contents)
        return [
            name
            for name, known in Context(self.workspace).features.contents().items()
            if known and name in names and known != contents.digest(inputs.files(name, options))
        ]

    def _compare_keypoints(self, features: Mapping[str, int], tables: Tables) -> None:
        counts, store = tables.num_keypoints(), Context(self.workspace).features
        missing, behind, differ = [], [], []
        for name, count in features.items():
            if name not in counts:
                missing.append(name)
            elif counts[name] != count:
                # Escalation adds features behind the existing ones.
                if counts[name] in store.level_ends(name):
                    behind.append(name)
                else:
                    differ.append(f"{name} has {counts[name]} of {count}")
        database = self.workspace.database
        self._add_items("features-not-in-database", database, missing)
        self._add_items("levels-not-in-database", database, behind)
        self._add_items("other-keypoints", database, differ)

    def _matches(self, tables: Tables, names: Sequence[str]) -> None:
        path = self.workspace.matches
        try:
            pairs = read_pairs(self.workspace.pairs, names) if len(names) > 1 else PairList.of(())
        except AffrectError as error:
            self._add_unusable("pairs-unusable", self.workspace.pairs, error)
            return
        try:
            pairs = without_deleted(self.workspace, pairs)
            is_there = Context(self.workspace).matches.has(pairs)
        except (AffrectError, *DAMAGED_HDF5) as error:
            self._add_unusable("matches-unusable", path, error)
            return
        self.found.checked.append(f"{path}: matches of {is_there.sum()} pairs of {len(pairs)}")
        known, written = set(tables.names.values()), tables.matched_pairs()
        missing, lost = [], []
        for pair, is_matched in zip(pairs, is_there, strict=True):
            if not is_matched:
                missing.append(" - ".join(pair))
            elif known.issuperset(pair) and pair not in written:
                lost.append(" - ".join(pair))
        self._add_items("pairs-not-matched", path, missing)
        self._add_items("matches-not-in-database", self.workspace.database, lost)

    def _models(self, inputs: str) -> None:
        sparse = self.workspace.sparse
        try:
            made_from = (sparse / INPUTS).read_text()
        except (OSError, UnicodeDecodeError):
            self._add("map-unfinished", sparse)
            return
        if made_from.partition(" ")[0] != inputs:
            self._add("map-stale", sparse)
        folders = [path for path in sparse.iterdir() if path.name.isdigit()]
        sizes = []
        for folder in sorted(folders, key=lambda path: int(path.name)):
            try:
                sizes.append(len(registered_names(folder)))
            except AffrectError as error:
                self._add_unusable("model-damaged", folder, error)
        listed = ", ".join(map(str, sizes)) or "no"
        self.found.checked.append(f"{sparse}: models of {listed} images")
        if not folders:
            self._add("no-model", sparse)
