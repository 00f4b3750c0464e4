"""Command line: parse, call one library function, print its result."""

import argparse
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import NoReturn, TextIO

from colmap_affrect import __version__
from colmap_affrect.cli.parser import build_parser
from colmap_affrect.errors import (
    INTERRUPTED,
    MEMORY_HINT,
    AffrectError,
    OptionError,
    lacks_memory,
    one_line,
    say,
)
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.report import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, EXIT_USAGE
from colmap_affrect.project.workspace import Workspace

logger = logging.getLogger("colmap_affrect")

REPEAT_S = 0.01  # after which a Ctrl-C is repeated


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    try:
        options = build_parser().parse_args(arguments)
        if not hasattr(options, "verbose"):  # a command that only prints
            return options.function(options) or EXIT_OK
        with _no_empty_folder(options.output_path), _logging(options):
            return options.function(options) or EXIT_OK
    except OptionError as error:
        return _fail(str(error), EXIT_USAGE)
    except AffrectError as error:
        return _fail(str(error))
    except BrokenPipeError:  # who reads what is printed has seen enough, as head has
        return EXIT_OK
    except OSError as error:
        return _fail(
            f"{error.filename or 'input/output'}: {error.strerror or error}; when that is mended, "
            "run the same command again: what was done before is kept"
        )
    except Exception as error:
        if not lacks_memory(error):
            raise
        return _fail(f"{MEMORY_HINT}: what was done before is kept")
    except KeyboardInterrupt:
        say(INTERRUPTED)
        return EXIT_INTERRUPTED


def main_of_process() -> NoReturn:
    """Run the command line as what this process is for, and end the process.

    Python takes a moment to end; a Ctrl-C within it is too late to change anything.
    """
    sys.unraisablehook = _interrupt_again
    try:
        code: int | str | None = main()
    except SystemExit as end:  # argparse: help, or wrong usage
        code = end.code
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    try:
        if sys.stdout:  # it may have been closed
            sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if code == EXIT_INTERRUPTED:  # threads may be in the middle of something long
        sys.stderr.flush()
        os._exit(EXIT_INTERRUPTED)
    sys.exit(code)


def _interrupt_again(passed_over: "sys.UnraisableHookArgs") -> None:
    """Repeat a Ctrl-C that came where Python cannot raise it, as while objects are deleted.

    Else its traceback would be printed, and the command would go on to its end.
    """
    if passed_over.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(passed_over)
        return
    threading.Timer(REPEAT_S, signal.raise_signal, [signal.SIGINT]).start()


def _fail(message: str, code: int = EXIT_FAILED) -> int:
    """Print one line; odd characters, out of files perhaps, must not reach the terminal."""
    say(f"error: {one_line(message)}")
    return code


@contextmanager
def _no_empty_folder(path: Path | None) -> Iterator[None]:
    """Remove a new output folder when the command fails before it has more than its log."""
    is_new = path is not None and not path.exists()
    try:
        yield
    except AffrectError:
        if path and is_new and {file.name for file in path.glob("*")} <= {".lock", "run.log"}:
            remove_own([path])
        raise


@contextmanager
def _logging(options: argparse.Namespace) -> Iterator[None]:
    """Log to the terminal and, if there is an output folder, to ``run.log``.

    COLMAP and image decoders write to file descriptor 2: it leads to the log while the
    command runs, and Python's ``sys.stderr`` to the terminal.
    """
    log_path = Path(os.devnull)
    if options.output_path:
        workspace = Workspace(options.output_path)
        photographs = getattr(options, "image_path", None) or getattr(options, "dataset_path", None)
        workspace.require_own(photographs)
        log_path = workspace.log
    log_path.parent.mkdir(parents=True, exist_ok=True)
    python_stderr, terminal_fd = sys.stderr, os.dup(2)
    terminal = os.fdopen(terminal_fd, "w", buffering=1, encoding="utf-8", errors="replace")
    log = _Log(log_path.open("a", encoding="utf-8", errors="backslashreplace"))
    with terminal, closing(log):
        shown = logging.StreamHandler(terminal)
        level = logging.DEBUG if options.verbose else logging.WARNING
        shown.setLevel(logging.ERROR if options.quiet else level)
        shown.setFormatter(_OneLine("%(levelname)s: %(message)s"))
        log.setFormatter(_OneLine("%(asctime)s %(levelname)s %(message)s"))
        logger.addHandler(shown)
        logger.addHandler(log)
        logger.setLevel(logging.DEBUG)
        logger.info("colmap-affrect %s: %s", __version__, " ".join(sys.argv[1:]))
        os.dup2(log.stream.fileno(), 2)
        sys.stderr = terminal
        try:
            yield
        except Exception:
            logger.log(logging.DEBUG, "failed", exc_info=True)
            raise
        finally:
            sys.stderr = python_stderr
            os.dup2(terminal.fileno(), 2)
            logger.removeHandler(shown)
            logger.removeHandler(log)


class _OneLine(logging.Formatter):
    """Shows a message in one line, whatever names are in it; a traceback keeps its lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return one_line(super().formatMessage(record))


class _Log(logging.StreamHandler[TextIO]):
    """Writes to ``run.log``; where the disk has no room for that the command goes on without."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass

    def close(self) -> None:
        super().close()
        with suppress(OSError):
            self.stream.close()
