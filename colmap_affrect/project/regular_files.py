"""Files of others are opened here: regular ones only.

A named pipe would let a reader wait for ever, a device may never end, and a link may lead to either
of them. So what is no regular file is refused before it is opened.
"""

import errno
import hashlib
import io
import os
import stat
from pathlib import Path

KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe, which can be read only once",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}
"""What else may have the name of a file, by its type."""
CHUNK_BYTES = 1 << 20  # of a file that are in memory while it is digested; resource
MAX_TEXT_BYTES = 1 << 30  # of lists, tables and options; damage
# Neither flag is on all systems
NEVER_WAITS = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


class NotAFileError(OSError):
    """Something that is no regular file has the name of one."""

    def __init__(self, path: Path, mode: int) -> None:
        """Take the path, and the type of what is there, as :func:`os.stat` tells it."""
        kind = KINDS.get(stat.S_IFMT(mode), "something else")
        super().__init__(0, f"is not a file, but {kind}", os.fspath(path))

    def __str__(self) -> str:
        return str(self.strerror)


def require_regular(path: Path) -> None:
    """Refuse what is there and no regular file, for libraries that open files by their names.

    What is not there at all is left to them. Raises NotAFileError.
    """
    try:
        mode = path.stat().st_mode
    except OSError:
        return
    if not stat.S_ISREG(mode):
        raise NotAFileError(path, mode)


def open_regular(path: Path) -> io.BufferedReader:
    """Open a regular file for reading, and nothing else; OSError, which may be NotAFileError."""
    require_regular(path)  # to open a device may already change something
    number = os.open(path, os.O_RDONLY | NEVER_WAITS)
    file: io.BufferedReader = io.BufferedReader(io.FileIO(number))
    mode = os.fstat(number).st_mode
    if not stat.S_ISREG(mode):  # somebody has just put it there
        file.close()
        raise NotAFileError(path, mode)
    return file


def first_bytes(path: Path, most: int) -> bytes:
    """Return the beginning of a regular file; OSError, which may be NotAFileError."""
    with open_regular(path) as file:
        return file.read(most)


def read_regular(path: Path) -> bytes:
    """Return what a regular file holds; OSError, which may be NotAFileError.

    No more is read than its size says: some files of the system never end.
    """
    with open_regular(path) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def sha256_of_regular(path: Path) -> str:
    """Return the SHA-256 of what a regular file holds, in hexadecimal digits, as read there."""
    digest = hashlib.sha256()
    with open_regular(path) as file:
        num_left = os.fstat(file.fileno()).st_size
        chunk = file.read(min(num_left, CHUNK_BYTES))
        while chunk:
            digest.update(chunk)
            num_left -= len(chunk)
            chunk = file.read(min(num_left, CHUNK_BYTES))
    return digest.hexdigest()


def read_regular_text(path: Path, encoding: str = "utf-8") -> str:
    """Return the text of a regular file, with line ends as Python has them; see its bytes.

    One that is longer than any list or table is refused; OSError.
    """
    if path.stat().st_size > MAX_TEXT_BYTES:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), os.fspath(path))
    return read_regular(path).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
