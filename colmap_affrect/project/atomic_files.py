"""Files that change as a whole or not at all, also when the program is killed or the disk full.

Text files are replaced. HDF5 files are too large for that: their changes are first written into a
second file beside them, the *journal* (``features.h5.journal``). Once it is complete, its changes
count. They are then put in place, and the journal is removed. A program that is killed meanwhile
leaves the journal, and the next one that opens the file puts its changes in place.
"""

import errno
import hashlib
import io
import logging
import os
import secrets
import shutil
import signal
import struct
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from colmap_affrect.errors import WorkspaceError
from colmap_affrect.project.regular_files import open_regular, read_regular

logger = logging.getLogger(__name__)

PAGE_BYTES = 4096  # format
TEMPORARY_PREFIX = ".affrect-"  # of folders for what is not complete yet
# Of files that are being written; a killed program leaves them
NEW_SUFFIX = ".affrect-new"
JOURNAL_MARK = b"AFFRECT2"
JOURNAL_HEADER = struct.Struct("<8sQQ")
"""Mark, number of old bytes that stay unless a page changes them, and size of the file; numbered
pages follow, and a SHA-256."""
SHA256_BYTES = 32  # format


def replace_text(path: Path, text: str | Iterable[str]) -> None:
    """Write a text file, whose lines need not fit into memory, as :func:`replace_bytes`."""
    lines = [text] if isinstance(text, str) else text
    replace_bytes(path, (line.encode() for line in lines))


def replace_bytes(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write or replace a file; WorkspaceError when that fails, and an old one stays as it is."""
    try:
        _replace(path, [content] if isinstance(content, bytes) else content)
    except UnicodeEncodeError as error:
        name = error.object[max(0, error.start - 40) : error.end + 40]
        raise WorkspaceError(
            f"cannot hold {name!r}, which is not UTF-8",
            where=path,
            advice="rename that file or folder",
        ) from error
    except OSError as error:
        raise cannot_write(path, error) from error


def _replace(path: Path, chunks: Iterable[bytes]) -> None:
    """Write a file under another name and give it its own; on the disk in this order."""
    with _new_beside(path) as (file, new):
        for chunk in chunks:
            file.write(chunk)
        _sync(file)
        file.close()
        new.replace(path)
    _sync_folder(path.parent)


@contextmanager
def _new_beside(path: Path) -> Iterator[tuple[BinaryIO, Path]]:
    """Make a file that is there for nobody else, and follows no link; removed in the end."""
    new = path.with_name(f"{path.name}.{secrets.token_hex(4)}{NEW_SUFFIX}")
    try:
        with new.open("xb") as file:
            yield file, new
    finally:
        with suppress(OSError):
            new.unlink(missing_ok=True)


def _sync(file: BinaryIO) -> None:
    """Wait until what was written is on the disk."""
    file.flush()
    os.fsync(file.fileno())


def _sync_folder(path: Path) -> None:
    """Wait until new names in a folder are on the disk, where the system can do that."""
    with suppress(OSError):
        number = os.open(path, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def require_space(path: Path, num_bytes: int, named: Path | None = None) -> None:
    """Make sure that there is room for a file beside ``path``.

    This is for files that are written by libraries which do not survive a full disk.

    Args:
        path: beside which the file will be.
        num_bytes: that it will have.
        named: file that an error names, for which the room is needed; None: ``path``.

    Raises:
        WorkspaceError: there is no room.
    """
    try:
        if shutil.disk_usage(path.parent).free < num_bytes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        # A quota may not allow it. Not all systems have the function.
        with _new_beside(path) as (file, _), suppress(AttributeError):
            os.posix_fallocate(file.fileno(), 0, num_bytes)
    except OSError as error:
        raise cannot_write(named or path, error) from error


def cannot_write(path: Path, error: Exception) -> WorkspaceError:
    """Return the error that says which file could not be written and what to do."""
    final = _final(path)
    may_be_gone = isinstance(error, FileNotFoundError) or not isinstance(error, OSError)
    if may_be_gone and not os.path.exists(final.parent):  # noqa: PTH110 - never fails
        return WorkspaceError(
            "cannot be written, its folder is gone",
            where=final,
            advice="run the same command again",
        )
    reason = getattr(error, "strerror", None) or error
    return WorkspaceError(
        f"cannot be written ({reason})",
        where=final,
        advice="free space on the disk, or permit writing, and run the same command "
        "again: what was done before is kept",
    )


def _final(path: Path) -> Path:
    """Return the name that a file in a folder for what is not complete yet will have."""
    kept = list[str]()
    parts = iter(path.parts)
    for part in parts:
        if part.startswith(TEMPORARY_PREFIX):
            next(parts, None)  # the folder of results in it
        else:
            kept.append(part)
    return Path(*kept)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Postpone Ctrl-C and SIGTERM until the block has ended.

    A ``KeyboardInterrupt`` inside a callback of a C library would leave it in disorder.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    postponed: list[int] = []

    def postpone(number: int, _: object) -> None:
        postponed.append(number)

    handler_of_interrupt = signal.signal(signal.SIGINT, postpone)
    handler_of_end = signal.signal(signal.SIGTERM, postpone)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler_of_interrupt or signal.SIG_DFL)
        signal.signal(signal.SIGTERM, handler_of_end or signal.SIG_DFL)
        for number in dict.fromkeys(postponed):
            signal.raise_signal(number)


class FileTransaction(io.RawIOBase):
    """A binary file for h5py, whose changes stay in memory until :meth:`commit` makes them all.

    One that is not there is made by the first commit. Changed pages go into a journal beside the
    file, see :mod:`colmap_affrect.project.atomic_files`.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        apply_journal(path)
        self._path = path
        self._stored = open_regular(path) if path.exists() else io.BytesIO()
        self._size = self._stored.seek(0, os.SEEK_END)
        self._kept_size = self._size  # bytes of the stored file that still count
        self._position = 0
        self._pages: dict[int, bytearray] = {}

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move to another position, as :class:`io.RawIOBase`.

        Args:
            offset: bytes from where ``whence`` says.
            whence: ``os.SEEK_SET``, ``os.SEEK_CUR`` or ``os.SEEK_END``.

        Returns:
            The new position, bytes from the beginning.
        """
        starts = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self._size}
        self._position = starts[whence] + offset
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        """Read, as :class:`io.RawIOBase`; bytes that were never written are 0."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._position))
        view[:count] = bytes(count)
        self._read_stored(self._position, view[:count])
        for number, within, there in self._spans(count):
            if number in self._pages:
                view[there] = self._pages[number][within]
        self._position += count
        return count

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        """Write, as :class:`io.RawIOBase`, into memory."""
        view = memoryview(data).cast("B")
        for number, within, there in self._spans(len(view)):
            if number not in self._pages:
                self._pages[number] = bytearray(PAGE_BYTES)
                self._read_stored(number * PAGE_BYTES, memoryview(self._pages[number]))
            self._pages[number][within] = view[there]
        self._position += len(view)
        if len(view):  # writing nothing behind the end does not move the end
            self._size = max(self._size, self._position)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        """Change the size, as :class:`io.RawIOBase`."""
        self._size = self._position if size is None else size
        self._kept_size = min(self._kept_size, self._size)
        for number in list(self._pages):
            if number * PAGE_BYTES >= self._size:
                del self._pages[number]
        last, num_left = divmod(self._size, PAGE_BYTES)
        if last in self._pages:
            self._pages[last][num_left:] = bytes(PAGE_BYTES - num_left)
        return self._size

    def close(self) -> None:
        """Forget what was not committed."""
        self._stored.close()
        super().close()

    def commit(self) -> None:
        """Make all changes; OSError when they cannot be written: what is in the journal counts."""
        content = JOURNAL_HEADER.pack(JOURNAL_MARK, self._kept_size, self._size)
        content += b"".join(
            struct.pack("<Q", number) + page
            for number, page in sorted(self._pages.items())
        )
        _replace(journal_of(self._path), [content, hashlib.sha256(content).digest()])
        apply_journal(self._path)

    def _read_stored(self, position: int, view: memoryview) -> None:
        if position < self._kept_size:
            self._stored.seek(position)
            self._stored.readinto(view[: self._kept_size - position])

    def _spans(self, count: int) -> Iterator[tuple[int, slice, slice]]:
        """Split what follows the position: number of a page, part of it, part of the whole."""
        done = 0
        while done < count:
            number, start = divmod(self._position + done, PAGE_BYTES)
            length = min(PAGE_BYTES - start, count - done)
            yield number, slice(start, start + length), slice(done, done + length)
            done += length


def journal_of(path: Path) -> Path:
    """Return the file that holds the changes of a file that are not in place yet."""
    return path.with_name(path.name + ".journal")


def apply_journal(path: Path) -> None:
    """Put the changes of an interrupted :meth:`FileTransaction.commit` in place, if any.

    A journal that is not complete, or of a file that is gone, does not count: it is removed.
    """
    journal = journal_of(path)
    if not journal.exists():
        return
    whole = read_regular(journal)
    content = whole[:-SHA256_BYTES]
    is_complete = hashlib.sha256(content).digest() == whole[-SHA256_BYTES:]
    if is_complete and content.startswith(JOURNAL_MARK) and _belongs_to(path, content):
        _apply_changes(path, content)
    else:
        logger.warning("%s: does not count; the changes in it are left out", journal)
    journal.unlink()


def _belongs_to(path: Path, content: bytes) -> bool:
    """Tell whether a file has the bytes that a journal leaves as they are."""
    _, kept_size, _ = JOURNAL_HEADER.unpack_from(content)
    size = path.stat().st_size if path.exists() else 0
    return bool(kept_size <= size)


def _apply_changes(path: Path, content: bytes) -> None:
    """Write the pages of a journal into its file, which is made if it is missing."""
    _, kept_size, size = JOURNAL_HEADER.unpack_from(content)
    path.touch()
    with path.open("r+b") as file:
        file.truncate(kept_size)
        for start in range(JOURNAL_HEADER.size, len(content), 8 + PAGE_BYTES):
            (number,) = struct.unpack_from("<Q", content, start)
            file.seek(number * PAGE_BYTES)
            file.write(content[start + 8 : start + 8 + PAGE_BYTES])
        file.truncate(size)
        _sync(file)
