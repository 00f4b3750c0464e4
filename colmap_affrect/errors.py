"""What is said to people: errors of one line, what, where and what to do; names out of files."""

import codecs
import errno
import io
import logging
import os
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO, TypeAlias

DAMAGE = (
    OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, MemoryError,
    OverflowError, EOFError,
)  # fmt: skip
"""What h5py, pycolmap and readers of JSON and TOML raise where a file is damaged, or not ours."""
OUTSIDE = {
    errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ESTALE, errno.ENOTCONN,
    errno.ETIMEDOUT,
}  # fmt: skip
"""Numbers of errors of the system that say nothing of what is in a file."""
# What is logged is shown by the command line, or as the program says that uses the package.
logging.getLogger("colmap_affrect").addHandler(logging.NullHandler())

MAX_REASON = 200  # characters of what a reader says; display
# Of a line that is shown, which may name anything that is in a file; display
MAX_LINE = 2000
NO_MEMORY = (
    "insufficient memory", "out of memory", "can't allocate memory", "cannot allocate memory",
    "bad_alloc", "can't start new thread", "failed to allocate", "unable to allocate",
    "failed to map segment", "cannot map zero-fill pages",
)  # fmt: skip


def lacks_memory(error: BaseException) -> bool:
    """Return whether Python, numpy, OpenCV, torch or COLMAP has found no memory.

    Of some only the sentence says so: they raise RuntimeError, and no number comes with it.
    """
    text = str(error).lower()
    if isinstance(error, MemoryError) or any(words in text for words in NO_MEMORY):
        return True
    cause = error.__cause__  # pycolmap tells of a module that could not be loaded
    return cause is not None and lacks_memory(cause)


ARGUMENTS = {
    "camera-mask-path": "masks.camera_path", "camera-mode": "cameras.mode",
    "camera-params": "cameras.params", "cameras-path": "cameras.cameras_path",
    "device": "resources.device", "distance": "distances", "film-width-mm": "cameras.film_width_mm",
    "focal-length-px": "cameras.focal_length_px", "focal-mm": "cameras.focal_mm",
    "format": "formats", "gps": "gps_database", "ignore-exif": "cameras.ignore_exif",
    "leave-out": "by_hand.left_out", "mapper": "mapping", "mapper-options": "mapper_options",
    "mask-path": "masks.path", "max-distance-m": "pairs.max_distance_m", "max-time": "max_minutes",
    "num-neighbors": "pairs.num_neighbors", "pairs": "pairs.methods", "points": "points_path",
    "positions": "positions_path", "principal-point": "cameras.principal_point",
    "reject-pair": "by_hand.rejected", "scheduler": "executor",
    "tie-points": "by_hand.tie_points_path", "weights": "resources.weights_path",
}  # fmt: skip
"""What functions call the flags whose argument has another name; a dot leads to a field."""


@dataclass(frozen=True)
class Option:
    """An option of commands, and perhaps the value that it was given.

    The command line calls it a flag, and functions an argument: where an error is shown decides.
    """

    flag: str
    """Its name without the dashes."""
    value: object = None

    @property
    def argument(self) -> str:
        """What functions call it."""
        return ARGUMENTS.get(self.flag, self.flag.replace("-", "_"))


Words: TypeAlias = "str | Path | Option | Row | BaseException | tuple[Words, ...]"
"""What is said: a text, or its parts in a row, with options that have a name for each who reads."""


@dataclass(frozen=True)
class Row:
    """A row of a table that the user gives, or another part of a file."""

    file: Words
    """What the file is called; empty where the part says it all."""
    part: str
    """Such as ``line 3``."""

    @property
    def words(self) -> Words:
        """What it is called."""
        return (self.file, ", ", self.part) if self.file else self.part


def with_flags(words: Words) -> str:
    """Return what is said to who gives commands.

    >>> with_flags(("use another ", Option("output-path")))
    'use another --output-path'
    """
    return _in_words(words, lambda option: f"--{option.flag}")


def with_arguments(words: Words) -> str:
    """Return what is said to who calls functions.

    >>> with_arguments((Option("mask-path", "masks"), ": no such folder"))
    'masks.path masks: no such folder'
    """
    return _in_words(words, lambda option: option.argument)


@dataclass(frozen=True)
class Logged:
    """What is logged: to programs it names arguments, and the command line has it name flags."""

    words: Words

    def __str__(self) -> str:
        return with_arguments(self.words)


def _in_words(words: Words, name_of: Callable[[Option], str]) -> str:
    if isinstance(words, tuple):
        return "".join(_in_words(part, name_of) for part in words)
    if isinstance(words, AffrectError | Row):
        return _in_words(words.words, name_of)
    if not isinstance(words, Option):
        return str(words)
    name = name_of(words)
    return name if words.value is None else f"{name} {words.value}"


class AffrectError(Exception):
    """Base of all errors that a user can act on.

    As a text it is one line, which names arguments of functions. The command line names flags.
    """

    exit_code = 1

    def __init__(self, what: Words, *, where: Words = "", advice: Words = "") -> None:
        """Take the parts of the line.

        Args:
            what: is wrong.
            where: the file, folder, option or photograph in question; empty if there is none.
            advice: what to do; empty where that is plain.
        """
        super().__init__(what)
        self.what = what
        self.where = where
        self.advice = advice

    @property
    def words(self) -> Words:
        """The whole line."""
        where: Words = (self.where, ": ") if self.where else ""
        advice: Words = ("; ", self.advice) if self.advice else ""
        return (where, self.what, advice)

    def __str__(self) -> str:
        return with_arguments(self.words)


class OptionError(AffrectError, ValueError):
    """The command cannot be carried out as it is given, and nothing is computed.

    An option is unknown, out of range, contradicts another one, or names what is not there or does
    not hold what it should: a folder, a list or a table.
    """

    exit_code = 2


class NoModelError(AffrectError):
    """There is no model, or none that can be trusted."""

    exit_code = 3


class ImageError(AffrectError):
    """An image cannot be read or used."""


class StoreError(AffrectError):
    """A file of features or matches is foreign, incomplete, or of another format version."""


class ConflictError(StoreError, OptionError):
    """Results are there that the command would replace, or that it cannot go on from."""


class DatabaseError(AffrectError):
    """A COLMAP database cannot be used as asked."""


class WorkspaceError(AffrectError):
    """The output folder cannot be used: not writable, or in use by another run."""


class DepthError(AffrectError):
    """The depth map of a photograph is missing or cannot be used."""


class PartError(AffrectError):
    """A part of another package fails, or returns what it must not."""

    def __init__(self, what: Words) -> None:
        super().__init__(what, advice="use another one, or tell its authors")


@contextmanager
def damage(
    path: Path, mend: Words, error_class: type[AffrectError] = StoreError
) -> Iterator[None]:
    """Say of a file that cannot be read in one line that it is damaged, and what mends it.

    Args:
        path: of the file that the block reads.
        mend: what to do.
        error_class: that is raised.

    Raises:
        AffrectError: of this class, where the block raises what readers of damaged files raise.
    """
    try:
        yield
    except AffrectError:
        raise
    except DAMAGE as error:
        if lacks_memory(error):
            raise
        if isinstance(error, OSError) and error.errno in OUTSIDE:
            why = os.strerror(error.errno)  # h5py says more, and in other words
            raise error_class(
                f"cannot be read ({why})",
                where=path,
                advice="mend that, and run the same command again",
            ) from error
        fault = f"damaged ({reason(error)})"
        raise error_class(fault, where=path, advice=mend) from error


def reason(error: BaseException) -> str:
    """Return why something cannot be read, in one short line: pydantic takes several."""
    first = getattr(error, "errors", None)
    text = first()[0]["msg"] if callable(first) else str(error)
    return one_line(" ".join(text.split()))[:MAX_REASON] or type(error).__name__


def how_to_make_again(stage: str, folder: Path) -> Words:
    """Say how what a stage has left in an output folder is made again."""
    if stage == "extract":
        return (
            "run the same 'extract' or 'run' with ",
            Option("overwrite"),
            " (run.log has the command)",
        )
    again = f"run 'colmap-affrect {stage} --output-path {shlex.quote(str(folder))} --overwrite'"
    return again if stage == "map" else f"{again}, then the same 'run' again"


# Everything that is shown goes through here: names come out of files, and may be made to mislead.

MAX_NAMES = 3  # examples in a line; display
EXIT_INTERRUPTED = 130  # as shells have it: 128 and the number of SIGINT; format
INTERRUPTED = "interrupted; run the same command again to go on"


def shown(text: str) -> str:
    r"""Write characters that do not print, or turn text round, as JSON does; lines stay lines.

    Control and format characters of a terminal are among them, and what is no Unicode.

    >>> shown("a\x1b[31m\u202eb\nc")
    'a\\u001b[31m\\u202eb\nc'
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else _escaped(c) for c in text)


def _escaped(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2))


MEMORY_ADVICE: Words = (
    "close other programs or raise the limit (ulimit -v), give smaller photographs, ",
    Option("set", "max_image_size_px=1600"),
    ", or ",
    Option("device", "cpu"),
    " where that of a GPU is full",
)
MEMORY_HINT: Words = ("not enough memory; ", MEMORY_ADVICE)


def not_utf_8(where: Words) -> OptionError:
    """Return the error of a text in another encoding, as editors and shells write some."""
    return OptionError("is no text in UTF-8", where=where, advice="save it as UTF-8")


def one_line(text: str) -> str:
    """Return the same in one line, line ends as JSON has them."""
    return shown(text).replace("\n", _escaped("\n"))


def clipped(text: str, most: int = MAX_LINE) -> str:
    """Return a text, of one that is too long its beginning and its end.

    >>> clipped("abcdefghijklmnopqrstuvwxyz", 12)
    'abcd ... xyz'
    """
    if len(text) <= most:
        return text
    mark = " ... "
    end = (most - len(mark)) // 2
    return text[: most - len(mark) - end] + mark + text[len(text) - end :]


def escape_what_lacks(stream: TextIO | None) -> None:
    r"""Have a stream write characters that its encoding lacks as JSON does, and go on.

    >>> import io
    >>> stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    >>> escape_what_lacks(stream)
    >>> stream.write("\u010d\U0001f600") and (stream.flush(), stream.buffer.getvalue())[1]
    b'\\u010d\\ud83d\\ude00'
    """
    if isinstance(stream, io.TextIOWrapper):  # neither closed nor another program's
        stream.reconfigure(errors=ESCAPED)


def _escape_lacking(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_escaped(character) for character in lacking), error.end


ESCAPED = "colmap_affrect.escaped"  # how streams write what their encoding lacks
codecs.register_error(ESCAPED, _escape_lacking)


class _Heedless(io.FileIO):
    """A file for lines that nobody has to read: what it cannot take is left out."""

    def write(self, data: bytes | memoryview) -> int:  # type: ignore[override]
        """Write, as :class:`io.FileIO`; a full disk, a closed pipe or a limit is no error."""
        count: int | None = None
        with suppress(OSError):
            count = super().write(data)
        return memoryview(data).nbytes if count is None else count


def heedless_stream(descriptor: int, encoding: str, *, closes: bool) -> TextIO:
    """Return a stream for what is shown meanwhile: no work ends because that cannot be written.

    Args:
        descriptor: of an open file.
        encoding: of what is written; see :func:`escape_what_lacks`.
        closes: whether the file is closed with the stream.
    """
    raw: io.FileIO = _Heedless(descriptor, "w", closefd=closes)
    file = io.BufferedWriter(raw)
    return io.TextIOWrapper(file, encoding, ESCAPED, line_buffering=True)


def say(line: str) -> None:
    """Print a line on stderr, which nobody may read any more."""
    # RuntimeError is of a handler that a signal calls meanwhile.
    with suppress(OSError, RuntimeError):
        if sys.stderr:  # it may have been closed
            sys.stderr.write(f"{line}\n")
            sys.stderr.flush()


def such_as(names: Iterable[str], most: int = MAX_NAMES) -> str:
    """Return the first few names, and how many there are more."""
    listed = list(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + more
