"""Command line: parse, call one library function, print its result."""

import argparse
import errno
import logging
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stderr, suppress
from pathlib import Path
from typing import TextIO

from colmap_affrect import __version__, errors
from colmap_affrect.cli.parser import build_parser
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.workspace import Workspace

logger = logging.getLogger("colmap_affrect")
SPEAK_THEMSELVES = ("compare", "serve")
"""Commands that other processes speak for, or that wait for a person."""


def main(
    arguments: Sequence[str] | None = None, *, begin: Callable[[], float] = lambda: 0.0
) -> int:
    """Run the command line and return the exit code.

    ``begin`` is called when everything is loaded, before the command begins to work, and returns
    for how many seconds nothing was said. Ctrl-C goes on to the caller, as KeyboardInterrupt.
    """
    try:
        return _run(sys.argv[1:] if arguments is None else arguments, begin)
    except errors.AffrectError as error:
        return _fail(errors.with_flags(error.words), error.exit_code)
    except BrokenPipeError:  # who reads what is printed has seen enough, as head has
        return 0
    except OSError as error:
        return _fail(_problem(error))
    except Exception as error:
        if not errors.lacks_memory(error):
            raise
        hint = errors.with_flags(errors.MEMORY_HINT)
        return _fail(f"{hint}: what was done before is kept")


def _run(given: Sequence[str], begin: Callable[[], float]) -> int:
    """Parse the arguments and run their command."""
    options = build_parser().parse_args(given or ["--help"])
    options.words = (
        "colmap-affrect",
        *(word for word in given if word != "--overwrite"),
    )
    with _logging(options):
        options.progress = SILENT if options.quiet else Progress(sys.stderr)
        from colmap_affrect.cli import commands  # not for --help; takes seconds

        command = getattr(commands, options.command.replace("-", "_"), commands.stage)
        waited_s = begin()
        if options.command in SPEAK_THEMSELVES:
            return command(options) or 0
        with options.progress.never_silent(options.command, waited_s=waited_s):
            return command(options) or 0


def _problem(error: OSError) -> str:
    """Say in one line what the system has refused."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT) and error.filename:
        return errors.with_flags(cannot_write(Path(error.filename), error).words)
    return (
        f"{error.filename or _place()}: {error.strerror or error}; when that is mended, "
        "run the same command again: what was done before is kept"
    )


def _place() -> str:
    """Name what an error of the system without a name is about."""
    try:
        Path.cwd()
    except OSError:
        return "the folder in which the command was started"
    return "input/output"


def _fail(message: str, code: int = 1) -> int:
    """Print one line; odd characters, out of files perhaps, must not reach the terminal."""
    errors.say(f"error: {errors.clipped(errors.one_line(message))}")
    return code


@contextmanager
def _logging(options: argparse.Namespace) -> Iterator[None]:
    """Log to the terminal and, if there is an output folder, to ``run.log``.

    COLMAP and image decoders write to file descriptor 2: it leads to the log while the
    command runs, and Python's ``sys.stderr`` to the terminal. A new output folder goes when the
    command fails before it has more than its log.
    """
    log_path = Path(os.devnull)
    new_folder = None
    if options.output_path:
        workspace = Workspace(options.output_path)
        if not workspace.path.exists():
            new_folder = workspace.path
        workspace.require_own(options.image_path or options.dataset_path)
        log_path = workspace.log
    log_path.parent.mkdir(parents=True, exist_ok=True)
    terminal = _terminal()
    log = _Log(log_path.open("a", encoding="utf-8", errors="backslashreplace"))
    with terminal, closing(log), redirect_stderr(terminal):
        shown = logging.StreamHandler(terminal)
        shown.setLevel(_shown_level(options))
        shown.setFormatter(_OneLine("%(levelname)s: %(message)s"))
        log.setFormatter(_OneLine("%(asctime)s %(levelname)s %(message)s"))
        logger.addHandler(shown)
        logger.addHandler(log)
        logger.setLevel(logging.DEBUG)
        logger.info("colmap-affrect %s: %s", __version__, " ".join(sys.argv[1:]))
        os.dup2(log.stream.fileno(), 2)
        try:
            yield
        except Exception as error:
            logger.log(logging.DEBUG, "failed", exc_info=True)
            if new_folder and isinstance(error, errors.AffrectError):
                _remove_unless_used(new_folder)
            raise
        finally:
            os.dup2(terminal.fileno(), 2)
            logger.removeHandler(shown)
            logger.removeHandler(log)


def _terminal() -> TextIO:
    """Return a stream to where file descriptor 2 leads now."""
    try:
        shown_on = os.dup(2)
    except OSError:  # it is closed, and whoever closed it wants to see nothing
        shown_on = os.open(os.devnull, os.O_WRONLY)
    encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
    return errors.heedless_stream(shown_on, encoding, closes=True)


def _shown_level(options: argparse.Namespace) -> int:
    """Return from which level on messages are shown."""
    if options.quiet:
        return logging.ERROR
    return logging.DEBUG if options.verbose else logging.WARNING


def _remove_unless_used(folder: Path) -> None:
    """Remove an output folder that holds nothing but its log."""
    names = {file.name for file in folder.glob("*")}
    if names <= {".lock", "run.log"}:
        remove_own([folder])


class _OneLine(logging.Formatter):
    """Shows a message in one line, whatever names are in it; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return errors.clipped(errors.one_line(super().formatMessage(record)))


class _Log(logging.StreamHandler[TextIO]):
    """Writes to ``run.log``; where the disk has no room for that the command goes on without."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass

    def close(self) -> None:
        super().close()
        with suppress(OSError):
            self.stream.close()
