"""The command line as a process: ``python -m colmap_affrect``, or ``colmap-affrect``.

On Linux the command runs in a child process. The parent kills it where it does not end within four
seconds of Ctrl-C or SIGTERM, as in native code that never returns, and says in one line when native
code has crashed. Nothing heavy is imported here: Ctrl-C is handled while the rest is loaded.
"""

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import NoReturn

from colmap_affrect.errors import (
    EXIT_INTERRUPTED,
    INTERRUPTED,
    MEMORY_HINT,
    escape_what_lacks,
    heedless_stream,
    lacks_memory,
    say,
)
from colmap_affrect.parallel.subprocesses import end_with

PATIENCE_S = 4.0  # that a command has to end after Ctrl-C or SIGTERM, before it is killed
WITHOUT_MEMORY = " (perhaps for want of memory)"
KEPT = (
    "run.log may say why, and what was done before is kept: run the same command again, or "
    "'colmap-affrect doctor'"
)
SIGNALS = {signal.SIGINT, signal.SIGTERM}


def main() -> NoReturn:
    """Run the command line in a process of its own, where the system can do that, and end."""
    _open_standard_streams()
    os.umask(os.umask(0) & 0o077)  # of one that takes rights from the owner, results are lost
    if sys.platform != "linux":  # elsewhere libraries of the system do not survive a fork
        _work()
    signals: list[int] = []

    def stop(number: int, _: object) -> None:
        if not signals:
            signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
        signals.append(number)
        _kill(worker, signal.SIGTERM)

    parent = os.getpid()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # else nobody could wait for the worker
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    heard, told = os.pipe()  # by which the worker says that Python has ended it
    os.set_blocking(heard, False)
    try:
        worker = os.fork()
    except OSError:  # too many processes
        _work()
    if not worker:
        end_with(parent)
        _work_and_tell(told)
    os.close(told)
    signal.signal(signal.SIGALRM, lambda *_: _kill(worker, signal.SIGKILL))
    _handle(stop)
    _, status = os.waitpid(worker, 0)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    code = os.waitstatus_to_exitcode(status)
    if code > 0 and code != EXIT_INTERRUPTED and not signals and not _has_told(heard):
        say(f"error: native code ended the command with exit code {code}{WITHOUT_MEMORY}; {KEPT}")
    sys.exit(_exit_code(code, signals))


def _has_told(heard: int) -> bool:
    try:
        return bool(os.read(heard, 1))
    except BlockingIOError:  # others have the pipe, too, and nobody has written
        return False


def _open_standard_streams() -> None:
    """Give the process those of the first three files that it was started without.

    Else the next files that are opened, results perhaps, would be taken for them.
    """
    for number, flags in enumerate((os.O_RDONLY, os.O_WRONLY, os.O_WRONLY)):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, flags)  # the lowest number that is free: this one
    if sys.stderr:  # it may have been closed
        sys.stderr = heedless_stream(2, sys.stderr.encoding, closes=False)


def _handle(handler: Callable[[int, object], None]) -> None:
    """Call a function for Ctrl-C and SIGTERM, where they are not ignored as in the background."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def _kill(worker: int, number: int) -> None:
    with suppress(ProcessLookupError):  # it has just ended
        os.kill(worker, number)


def _exit_code(code: int, signals: list[int]) -> int:
    """Return the exit code of the command, and say why it ended where it could not do that."""
    if code >= 0:
        return 128 + signals[0] if signals and code else code
    if signals:
        say(INTERRUPTED)
        return 128 + signals[0]
    cause = WITHOUT_MEMORY if code == -signal.SIGKILL else ""
    say(f"error: ended by {signal.Signals(-code).name}{cause}; {KEPT}")
    return 1


def _work_and_tell(told: int) -> NoReturn:
    """Run the command line, and write a byte in the end; native code that ends it writes none."""
    try:
        _work()
    finally:
        os.write(told, b".")


def _work() -> NoReturn:
    """Run the command in this process, which Ctrl-C and SIGTERM interrupt."""
    signals: list[int] = []
    code: int | str | None

    def interrupt(number: int, _: object) -> None:
        if number == signal.SIGTERM and signals:
            return  # of the first process, for a Ctrl-C that came here, too
        signals.append(number)
        raise KeyboardInterrupt

    for stream in (sys.stdout, sys.stderr):
        escape_what_lacks(stream)
    try:
        _handle(interrupt)
        from colmap_affrect.cli import main

        code = main()
    except SystemExit as end:  # argparse has shown help
        code = end.code
    except (KeyboardInterrupt, Exception) as error:
        # Libraries turn a KeyboardInterrupt in their callbacks into errors of their own.
        if signals or isinstance(error, KeyboardInterrupt):
            say(INTERRUPTED)
            code = EXIT_INTERRUPTED
        elif lacks_memory(error):  # already for loading what is needed
            say(f"error: {MEMORY_HINT}")
            code = 1
        else:
            raise
    if code == EXIT_INTERRUPTED:  # threads may be in the middle of something long
        os._exit(code)
    _end(code)


def _end(code: int | str | None) -> NoReturn:
    """End this process, and do not mind that nobody reads what is printed any more."""
    for number in SIGNALS:  # too late to change anything
        signal.signal(number, signal.SIG_IGN)
    try:
        if sys.stdout:  # it may have been closed
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes it again
        if not code and not isinstance(error, BrokenPipeError):
            say(f"error: what the command prints cannot be written ({error.strerror})")
            code = 1
    sys.exit(code)


if __name__ == "__main__":
    main()
