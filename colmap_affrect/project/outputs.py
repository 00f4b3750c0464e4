"""The one door for what is written outside of a work folder: exports, copies, pictures.

What is made stands in a hidden folder beside its place until all of it is whole, and gets its name
then. So there is never half of it under a name of the user's, also when the program is killed.
"""

import hashlib
import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import mkdtemp

from filelock import FileLock, Timeout

from colmap_affrect.errors import OptionError, WorkspaceError
from colmap_affrect.project.atomic_files import (
    TEMPORARY_PREFIX,
    cannot_write,
    require_space,
    uninterrupted,
)
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.regular_files import (
    NotAFileError,
    open_regular,
    require_regular,
)

RESULTS = "results"  # folder of these in such a folder, whose names are the user's
LOCK = ".lock"  # in such a folder, and in a work folder, while somebody works there
# Files of ours begin so
MARKS = {
    "config.toml": b"format_version",
    "run.log": b"colmap-affrect",
}
LONGEST_NAME = 255  # bytes that file systems take; format
# There has to be room for the longer names of what is beside it meanwhile; format
MAX_NAME_BYTES = LONGEST_NAME - 35
# A disk with less room may have cut off what was written last; resource
SPARE_BYTES = 1 << 16
BYTES_OF_MARK = 200  # at the beginning of these files, which say whose they are; format
OF_SYSTEMS = {"Thumbs.db", "desktop.ini", "lost+found"}  # in folders that look empty


def is_output_folder(path: Path) -> bool:
    """Return whether this program has written its record or its log into a folder."""
    for name, mark in MARKS.items():
        with suppress(OSError), open_regular(path / name) as file:
            if mark in file.read(BYTES_OF_MARK):
                return True
    return False


def leads_outside(name: str) -> bool:
    r"""Return whether a file of this name, taken from a model or a database, may leave its folder.

    >>> [leads_outside(name) for name in ("a/b.jpg", "/a.jpg", "a/../../b.jpg", "C:a", "..\\b")]
    [False, True, True, True, True]
    """
    path = PurePosixPath(name.replace("\\", "/"))
    return path.is_absolute() or ".." in path.parts or bool(PureWindowsPath(name).drive)


def refuse_link(path: Path) -> None:
    """Refuse to write where a symbolic link stands: it would be followed; OptionError."""
    if path.is_symlink():
        raise OptionError(
            "is a symbolic link, and nothing is written where it leads",
            where=path,
            advice="remove it, or give another name or folder",
        )


def refuse_photographs(target: Path, names: Collection[str]) -> None:
    """Refuse to write among photographs of these names: results would be taken for some.

    Work folders of ours are allowed: the search for photographs skips them. Raises OptionError.
    """
    inner = [name for name in names if not leads_outside(name)]
    parent = resolved(target.parent)
    for folder in (parent, *parent.parents):
        if not inner or is_output_folder(folder):
            return
        with suppress(OSError):  # a name that is too long, for one
            if all((folder / name).is_file() for name in inner):
                raise OptionError(
                    f"lies in the folder of the photographs, {folder}",
                    where=target,
                    advice="give another name or folder",
                )


def refuse_what_waits(path: Path) -> None:
    """Refuse a pipe, a socket or a device where a file of ours should be; OptionError."""
    try:
        if not path.is_dir():
            require_regular(path)
    except NotAFileError as error:
        raise OptionError(
            error, where=path, advice="remove it, or give another folder"
        ) from error


def refuse_other_kind(
    path: Path, files: Collection[str], folders: Collection[str]
) -> None:
    """Refuse a folder in the place of a file of ours, and the other way round.

    Args:
        path: what is there.
        files: names that only files have.
        folders: names that only folders have.

    Raises:
        OptionError: it is of the other kind.
    """
    advice = "move it elsewhere, and run the same command again"
    if path.name in files and path.is_dir():
        raise OptionError(
            "is a folder, in the place of a file", where=path, advice=advice
        )
    if path.name in folders and path.is_file():
        raise OptionError(
            "is a file, in the place of a folder", where=path, advice=advice
        )


def refuse_taken_places(
    *targets: Path, names: Collection[str] = (), replaces: bool = False
) -> None:
    """Refuse places of results that are taken, or among photographs.

    Args:
        targets: files or folders to be made.
        names: of photographs, in whose folder no results may be.
        replaces: whether files that are there give way.

    Raises:
        OptionError: a target is there already, is a symbolic link, or lies among photographs.
    """
    for target in targets:
        refuse_link(target)
        _refuse_models_of_a_run(target)
        refuse_photographs(target, names)
    if not replaces:
        _refuse_existing(targets)


@contextmanager
def new_results(
    *targets: Path, names: Collection[str] = (), replaces: bool = False
) -> Iterator[list[Path]]:
    """Yield paths for files or folders to be made, which get their names when all are whole.

    Missing folders above are made. When the block fails or is interrupted nothing of it stays.
    With ``replaces`` files that are there give way; else nothing is overwritten. Raises
    OptionError, before anything is made, where a target is there already, is a symbolic link, or
    lies among photographs of these ``names``, WorkspaceError when something cannot be written.
    """
    refuse_taken_places(*targets, names=names, replaces=replaces)
    with ExitStack() as stack:
        folders = dict[Path, Path]()
        for target in targets:
            if target.parent not in folders:
                folder = stack.enter_context(temporary_folder(target.parent))
                folders[target.parent] = _new_results_folder(folder)
        made = [folders[target.parent] / target.name for target in targets]
        yield made
        for target in targets:  # native writers say nothing of a full disk
            require_space(
                folders[target.parent].with_name("rest"),
                num_bytes=SPARE_BYTES,
                named=target,
            )
        with uninterrupted():
            if not replaces:  # somebody may have made one meanwhile
                _refuse_existing(targets)
            for path, target in zip(made, targets, strict=True):
                _move(path, target)


def _new_results_folder(parent: Path) -> Path:
    """Make the folder of the results; what is beside it may have any name."""
    folder = parent / RESULTS
    try:
        folder.mkdir()
    except OSError as error:
        raise cannot_write(parent, error) from error
    return folder


def _move(path: Path, target: Path) -> None:
    try:
        path.replace(target)
    except OSError as error:
        raise cannot_write(target, error) from error


def _refuse_models_of_a_run(target: Path) -> None:
    for folder in target.parents:
        if folder.name == "sparse" and is_output_folder(folder.parent):
            raise OptionError(
                "lies beside the models of a run, which mapping removes",
                where=target,
                advice="give another name or folder",
            )


def _refuse_existing(targets: Iterable[Path]) -> None:
    for target in targets:
        if os.path.lexists(target):
            raise OptionError(
                "exists, and is left as it is",
                where=target,
                advice="give another name or folder",
            )


@contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a new folder in a folder, in which those that killed processes left are removed."""
    missing = [path for path in (parent, *parent.parents) if not path.exists()]
    with ExitStack() as stack:
        stack.push(lambda failure, *_: _remove_empty(missing if failure else ()))
        folder = _new_folder(parent, stack)
        while not folder.is_dir():  # a process that tidies up was faster than the lock
            folder = _new_folder(parent, stack)
        for left in parent.glob(f"{TEMPORARY_PREFIX}*"):
            if left != folder and (left / LOCK).is_file() and not left.is_symlink():
                with suppress(Timeout, OSError), FileLock(left / LOCK, timeout=0):
                    shutil.rmtree(left)  # its process has ended
        yield folder


def _new_folder(parent: Path, stack: ExitStack) -> Path:
    """Make a folder that is locked, and removed in the end."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        folder = Path(mkdtemp(prefix=TEMPORARY_PREFIX, dir=parent))
    except OSError as error:
        raise cannot_write(parent, error) from error
    stack.callback(shutil.rmtree, folder, ignore_errors=True)
    with suppress(OSError):  # of file systems without locks leftovers are not tidied up
        stack.enter_context(FileLock(folder / LOCK))
    return folder


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that were made for results that failed, the inner ones first."""
    with suppress(OSError):  # something else is there
        for folder in folders:
            folder.rmdir()


def database_files(path: Path) -> list[Path]:
    """Return a database of SQLite and the files that it may have beside it."""
    suffixes = ("", "-wal", "-shm", "-journal")
    return [path.with_name(path.name + suffix) for suffix in suffixes]


def remove_own(paths: Iterable[Path]) -> None:
    """Remove what is ours in a work folder; of a link itself, not what it leads to.

    Raises WorkspaceError, which names it, where the system does not permit that.
    """
    for path in paths:
        try:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        except OSError as error:  # of a file in it the name alone
            why = error.strerror or error
            raise WorkspaceError(
                f"cannot be removed ({why})",
                where=path,
                advice="permit that, and run the same command again",
            ) from error


def fitting_name(stem: str, suffix: str, most: int = MAX_NAME_BYTES) -> str:
    """Return the name of a file; where file systems take none so long, its beginning and a digest.

    Args:
        stem: of the name.
        suffix: of the name, with its point.
        most: bytes that the name may have.

    Returns:
        A name of at most as many bytes.

    >>> fitting_name("a", ".png"), len(fitting_name("b" * 300, ".png"))
    ('a.png', 220)
    """
    name = f"{stem}{suffix}"
    encoded = os.fsencode(name)
    if len(encoded) <= most:
        return name
    end = f"-{hashlib.sha256(encoded).hexdigest()[:8]}{suffix}"
    start = os.fsencode(stem)[: most - len(os.fsencode(end))]
    return f"{start.decode('utf-8', 'ignore')}{end}"
