"""The output folder: its files, its lock, and the record of the options that made them."""

import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from filelock import FileLock, Timeout

from colmap_affrect import __version__
from colmap_affrect.errors import (
    ConflictError,
    Option,
    OptionError,
    Words,
    WorkspaceError,
)
from colmap_affrect.project import outputs
from colmap_affrect.project.atomic_files import NEW_SUFFIX, replace_text
from colmap_affrect.project.feature_summary import summary_path
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.record import (
    MADE_FROM,
    MAPPED,
    OF_DATABASE,
    PLANNED,
    STAGES,
    WEIGHTS,
    MappingRecord,
    ModelInputs,
    first_difference,
    read_record,
    record_text,
    rewind_record,
)

logger = logging.getLogger(__name__)

FILES_OF_MODEL = {
    "cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin", "summary.json",
}  # fmt: skip
FILES_BESIDE_MODELS = {"thrown_away.json"}
LOCK_WAIT_S = 1.0  # for one that a killed process still has while it ends; resource
OWN_STEMS = {  # how names of files and folders begin that are written here
    "cameras", "config", "database", "features", "guided", "mapped", "matches", "methods",
    "pairs", "report", "run", "shared", "sparse",
}  # fmt: skip
OWN_FILES = {  # which are never folders
    outputs.LOCK, "cameras.json", "config.toml", "database.db", "database.db.seal",
    "features.h5", "features.json", "guided.h5", "mapped.db", "matches.h5", "pairs.txt",
    "report.html", "report.json", "run.log",
}  # fmt: skip
OWN_FOLDERS = {"sparse", "sparse.best", "sparse.learned", "sparse.snapshots"}


class Workspace:
    """Paths below an output folder, and the record of the stages that were run there.

    A stage that is run again with the same options goes on where it stopped; with other options it
    refuses, and ``overwrite`` removes its results and those of the stages after it. A stage that
    has not begun takes the options on record unless it is given others.

    A folder begins with ``extract``, or with ``copy`` of another program's database to be mapped.
    """

    def __init__(self, path: Path, users_database: Path | None = None) -> None:
        """Name the folder, and a database of the user in the place of one there; never removed."""
        self.path = path
        self.users_database = users_database
        self.database = users_database or path / "database.db"
        self.mapped_database = path / "mapped.db"  # a copy with what is done by hand
        # A digest of what the last command left in the database (see colmap_affrect.mend)
        self.seal = path / "database.db.seal"
        self.features = path / "features.h5"  # by image
        self.features_summary = summary_path(self.features)  # of it, for idle runs
        self.matches = path / "matches.h5"  # raw ones by pair
        self.guided = path / "guided.h5"  # what guided matching found, by pair
        self.pairs = path / "pairs.txt"  # those to match
        self.sparse = path / "sparse"  # folder of the COLMAP models 0, 1, ...
        # From which an interrupted mapping goes on
        self.snapshots = path / "sparse.snapshots"
        self.best = path / "sparse.best"  # the best models so far, with their matches
        self.learned = path / "sparse.learned"  # models of learned matches alone
        self.config = path / "config.toml"  # the options on record
        self.log = path / "run.log"  # of all runs
        self.report = path / "report.json"  # of the last run
        self.page = path / "report.html"  # of the last run
        # What is known of the database's cameras, and from where
        self.cameras = path / "cameras.json"
        # Whether another program has changed the database, and it is to be mapped so
        self.is_changed = False
        self._record: dict[str, Any] | None = None

    @classmethod
    def beside(cls, database_path: Path) -> Self:
        """Return the workspace of a user's database: ``x.affrect`` beside ``x.db``."""
        if database_path.is_dir():  # '.' and '/' have no names
            raise OptionError(
                "is a folder", where=database_path, advice="give the path of a database"
            )
        return cls(database_path.with_suffix(".affrect"), database_path)

    def branch(self, path: Path) -> "Workspace":
        """Make another folder with the same features, pairs, raw matches and records of cameras.

        Files are shared where the file system can do that.
        """
        path.mkdir(parents=True, exist_ok=True)
        for source in (self.features, self.pairs, self.matches, self.cameras):
            try:
                os.link(source, path / source.name)
            except OSError:
                if source.exists():
                    shutil.copy(source, path / source.name)
        made = Workspace(path)
        made._write_record(rewind_record(self.record(), "verify"))
        return made

    def refuse_run(self) -> None:
        """Refuse the folder of a run for results of another kind; OptionError."""
        if self.config.exists():
            raise OptionError(
                "has the results of a run, some of which would be replaced",
                where=self.path,
                advice=("use another ", Option("output-path")),
            )

    def require_own(self, photographs: Path | None = None) -> None:
        """Refuse a folder that is not empty and not ours, and links that would be followed.

        That of the photographs is refused, too; one inside it is allowed. Raises OptionError.
        """
        if photographs and resolved(self.path) == resolved(photographs):
            raise OptionError(
                "is the folder of the photographs",
                where=self.path,
                advice=("give another one as ", Option("output-path")),
            )
        if os.path.lexists(self.path) and not self.path.is_dir():
            raise OptionError(
                "is not a folder",
                where=self.path,
                advice=("give a new or an empty one as ", Option("output-path")),
            )
        with suppress(OSError):  # not there, or refused when it is to be used
            self._refuse_links_and_pipes()
            names = [
                path.name for path in self.path.iterdir() if not _may_be_ours(path)
            ]
            if names and not outputs.is_output_folder(self.path):
                raise OptionError(
                    f"is not empty ({min(names)}) and was not made by colmap-affrect",
                    where=self.path,
                    advice=("give a new or an empty folder as ", Option("output-path")),
                )

    def _refuse_links_and_pipes(self) -> None:
        """Refuse what has the name of a file of ours, and leads elsewhere or cannot be read.

        A folder in the place of a file would be removed with all that is in it.
        """
        for path in self.path.iterdir():
            stem = path.name.partition(".")[0]
            if stem in OWN_STEMS or path.name == outputs.LOCK:
                outputs.refuse_link(path)
                outputs.refuse_what_waits(path)
            outputs.refuse_other_kind(path, OWN_FILES, OWN_FOLDERS)

    def page_file(self, number: int) -> Path:
        """Return the path of a file that the page reads when it is asked for what is in it."""
        return self.path / f"report.pairs-{number}.js"

    def page_files(self) -> list[Path]:
        """Return the files beside the page that are there."""
        found = []
        for path in sorted(self.path.glob("report.pairs-[0-9]*.js")):
            if path.is_file() and not path.is_symlink():
                found.append(path)
        return found

    def remove_page(self) -> None:
        """Remove the page and the files beside it."""
        outputs.remove_own([self.page, *self.page_files()])

    def begin(self) -> None:
        """Make the folder, unless it is there, and say in its log whose it is."""
        self.require_own()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if not outputs.is_output_folder(self.path):
                with self.log.open("a", encoding="utf-8") as log:
                    log.write(f"colmap-affrect {__version__}: output folder\n")
        except OSError as error:
            raise self._unusable(error) from error

    def _unusable(self, error: OSError) -> WorkspaceError:
        return WorkspaceError(
            f"cannot be used as output folder ({error.strerror or error})",
            where=self.path,
        )

    @contextmanager
    def locked(self) -> Iterator[Self]:
        """Make the folder and keep other runs out; the record is read anew.

        Raises OptionError for a folder of somebody else, WorkspaceError when it cannot be used.
        """
        self.begin()
        try:
            lock = FileLock(self.path / outputs.LOCK).acquire(timeout=LOCK_WAIT_S)
        except Timeout as error:
            raise WorkspaceError(
                "another colmap-affrect is working in this folder",
                where=self.path,
                advice=("wait for it or use another ", Option("output-path")),
            ) from error
        except OSError as error:
            raise self._unusable(error) from error
        self._record = None
        with lock:
            yield self

    @contextmanager
    def locked_if_possible(self) -> Iterator[None]:
        """Keep other runs out of a folder that is only read; on a read-only disk there are none."""
        with ExitStack() as stack:
            try:
                stack.enter_context(self.locked())
            except WorkspaceError as error:
                if isinstance(error.__cause__, Timeout):
                    raise
            yield

    def is_in_use(self) -> bool:
        """Return whether another process works in the folder just now."""
        lock = self.path / outputs.LOCK
        if not lock.is_file():
            return False
        try:
            with FileLock(lock).acquire(timeout=0):
                return False
        except Timeout:
            return True
        except OSError:  # of a disk that is read-only: nobody works there
            return False

    def record(self) -> Mapping[str, Any]:
        """Return the record, see :func:`~colmap_affrect.project.record.read_record`."""
        if self._record is None:
            self._record = read_record(self.config)
        return self._record

    def _write_record(self, record: Mapping[str, Any]) -> None:
        replace_text(self.config, record_text(record))
        self._record = None

    @property
    def started_stages(self) -> list[str]:
        """The stages that have been run, in their order."""
        return [stage for stage in STAGES if stage in self.record()]

    @property
    def is_foreign(self) -> bool:
        """Whether the database is a copy of another program's, or was changed by one."""
        return self.is_changed or "copy" in self.started_stages

    def recipe(self) -> str:
        """Return the name of the recipe that the features were made with."""
        return str(self.record().get("recipe", ""))

    def options_on_record(self, stage: str) -> dict[str, Any] | None:
        """Return the options on record for a stage, begun or not; None if there are none."""
        record = self.record()
        options = record.get(stage, record.get(PLANNED, {}).get(stage))
        if options is None:
            return None
        return {key: value for key, value in options.items() if key != WEIGHTS}

    def require(self, stage: str) -> dict[str, Any]:
        """Return the recorded options of an earlier stage; OptionError when it was not run."""
        if stage not in self.started_stages:
            first: Words = (
                f"run 'colmap-affrect {stage}' with this ",
                Option("output-path"),
                " first",
            )
            if self.users_database:
                first = "call extract_features first, or move this folder along with its database"
            raise OptionError(
                f"the {stage} stage has not been run there",
                where=self.path,
                advice=first,
            )
        return dict(self.record()[stage])

    def photographs(self) -> Path | None:
        """Return the folder of the photographs on record, None where none is known."""
        with suppress(WorkspaceError):
            record = self.record()
            options = {**record.get("copy", {}), **record.get("extract", {})}
            path = options.get("image_path")
            return Path(path) if path else None
        return None

    def input_digest(self, what: str) -> str:
        """Return the digest of what something was made from, empty if not known."""
        return str(self.record().get(MADE_FROM, {}).get(what, ""))

    def record_input_digests(self, **digests: str) -> None:
        """Put on record what things are made from now."""
        record = self.record()
        known = {**record.get(MADE_FROM, {}), **digests}
        if any(self.input_digest(what) != digest for what, digest in digests.items()):
            self._write_record({**record, MADE_FROM: known})

    @property
    def mapping_record(self) -> MappingRecord | None:
        """What is on record of the models that are there; None where they are to be made anew."""
        values = self.record().get(MAPPED)
        return MappingRecord(**values) if values else None

    def model_inputs(self) -> ModelInputs | None:
        """Return what these models were made from, as far as it is known."""
        return self.mapping_record.inputs if self.mapping_record else None

    def record_mapping(self, inputs: ModelInputs | None) -> None:
        """Put on record what the models that are there were made from, and how many they are.

        Args:
            inputs: None where they are to be made anew.
        """
        values = {**inputs._asdict(), "number": self.num_models()} if inputs else None
        if values != self.record().get(MAPPED):
            self._write_record({**self.record(), MAPPED: values})

    def num_models(self) -> int:
        """Return how many models there are, 0, 1, ..."""
        with suppress(OSError):
            return sum(path.name.isdecimal() for path in self.sparse.iterdir())
        return 0

    def lacks_models(self) -> bool:
        """Return whether models that were made are gone, removed by somebody or half removed."""
        number = self.mapping_record.number if self.mapping_record else 0
        return not self.sparse.exists() or self.num_models() < number

    def record_options(
        self,
        stage: str,
        options: Mapping[str, Any],
        *,
        plan: Mapping[str, Mapping[str, Any]] | None = None,
        recipe: str = "",
        overwrite: bool = False,
    ) -> None:
        """Put the options of a stage on record before it begins.

        Args:
            stage: that begins.
            options: its options, nested mappings of plain values.
            plan: options of later stages; those of stages that have begun stay as they are.
            recipe: its name, for the record only.
            overwrite: first discard the results of this stage and the later ones; with the first
                stage their options are forgotten, too.

        Raises:
            ConflictError: other options made the results that are there.
        """
        self._refuse_foreign_results(stage)
        outputs.remove_own(self.path.glob(f"*{NEW_SUFFIX}"))  # of a run that was killed
        record = self.record()
        if overwrite:
            record = self._record_without_results(stage)
        if stage in record:
            why = first_difference(
                record[stage], now=options, free=OF_DATABASE.get(stage, ())
            )
            if why:
                raise ConflictError(
                    f"the {stage} stage was run there with {why}",
                    where=self.path,
                    advice=self._remedy,
                )
        changed = {
            **record,
            stage: dict(options),
            "recipe": recipe or record.get("recipe", ""),
        }
        planned = {**changed.pop(PLANNED, {}), **(plan or {})}
        for name, values in planned.items():
            if name not in changed:
                changed.setdefault(PLANNED, {})[name] = dict(values)
        self._write_record(changed)

    def _record_without_results(self, stage: str) -> Mapping[str, Any]:
        """Remove the results of a stage and of those after it, and return the record without."""
        self.refuse_foreign_models()
        outputs.remove_own(self._results(stage))
        record = rewind_record(self.record(), stage)
        has_stages = not record.keys().isdisjoint(STAGES)
        return record if has_stages else {}

    def rewind(self, why: str = "what it was made from has changed") -> None:
        """Remove the database and what was made from it, for inputs that have changed.

        The options of these stages stay on record, and models until others take their place.
        Raises ConflictError for a database of the user.
        """
        if self.users_database:
            raise ConflictError(why, where=self.users_database, advice=self._remedy)
        self.record_mapping(None)
        results = self._results("verify")
        results.remove(self.sparse)
        outputs.remove_own(results)
        self._write_record(rewind_record(self.record(), "verify"))

    @property
    def _remedy(self) -> Words:
        if self.users_database:
            return (
                "use a new database (from_database= takes over its images and cameras)"
            )
        return (
            "use ",
            Option("overwrite"),
            " to redo it and the stages after it, or another ",
            Option("output-path"),
        )

    def _refuse_foreign_results(self, stage: str) -> None:
        first = {"copy": "extract", "extract": "copy"}.get(stage)
        if first in self.started_stages:
            raise ConflictError(
                f"the {first} stage was run there, which {stage} cannot go on from",
                where=self.path,
                advice=("use another ", Option("output-path")),
            )
        if self.started_stages:
            return
        for path in self._results("extract"):
            if path.exists() and path != self.users_database:
                raise ConflictError(
                    "exists and was not made here, and is left as it is",
                    where=path,
                    advice=("use another ", Option("output-path")),
                )

    def refuse_foreign_models(self) -> None:
        """Refuse to remove models beside which others have put something; ConflictError."""
        foreign = list[Path]()
        for path in self.sparse.glob("*"):
            is_model = path.is_dir() and path.name.isdecimal()
            for file in path.iterdir() if is_model else [path]:
                own_names = FILES_OF_MODEL if is_model else FILES_BESIDE_MODELS
                is_own = file.name in own_names
                if not is_own and not file.name.startswith("."):
                    foreign.append(file)
        if foreign:
            raise ConflictError(
                "was not made by this run and would be removed with its models",
                where=foreign[0],
                advice="move it elsewhere, and run the same command again",
            )

    def _results(self, stage: str) -> list[Path]:
        """Return what a stage and those after it make."""
        made = {
            "map": [
                self.sparse,
                self.snapshots,
                self.best,
                self.learned,
                self.report,
                self.page,
                *self.page_files(),
                self.mapped_database,
            ],
            "guide": [self.guided],
            "verify": [self.cameras, self.seal, *outputs.database_files(self.database)],
            "match": [self.matches],
            "pairs": [self.pairs],
            "extract": [self.features, self.features_summary],
        }
        later = STAGES[STAGES.index(stage) :]
        return [path for name, paths in made.items() if name in later for path in paths]


def _may_be_ours(path: Path) -> bool:
    """Return whether a file may be in an empty folder, or that of a run that was killed early."""
    if path.name == "run.log":
        return not path.stat().st_size
    return (
        path.name in outputs.OF_SYSTEMS
        or path.name.startswith(".")
        or path.suffix == NEW_SUFFIX
    )
