"""The command line as a process, and what it does at Ctrl-C and SIGTERM.

On Linux the command runs in a child process. The parent passes Ctrl-C and SIGTERM on. It kills the
child at once while that still loads packages, which would answer a signal with errors of their own,
or lose it; later where the child does not end within four seconds, as in native code that never
returns. When native code has crashed it says so in one line. While the child loads packages, which
lets no thread of its own speak, it says that it is at work. Nothing heavy is imported here.
"""

import atexit
import gc
import os
import select
import signal
import sys
import threading
import time
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
    with_flags,
)
from colmap_affrect.parallel.freed_memory import keep_freed_memory
from colmap_affrect.parallel.subprocesses import end_with

# That a command has to end after Ctrl-C or SIGTERM, before it is killed; resource
PATIENCE_S = 4.0
# Until something says that packages are loaded, and between two such lines: with the start of
# Python less than 5; display
QUIET_S = 3.0
TICK_S = 0.5  # between two looks at the clock; display
LOADING = "loading: at work for {seconds:.0f} s"
LOADED = "loading: done in {seconds:.0f} s"
WITHOUT_MEMORY = " (perhaps for want of memory)"
KEPT = (
    "run.log may say why, and what was done before is kept: run the same command again, or "
    "'colmap-affrect doctor'"
)
SIGNALS = {signal.SIGINT, signal.SIGTERM}
BEGUN = b"b"
ENDED = b"e"
"""What the worker tells: all is loaded and the command works; Python, not native code, ends it."""


def run_command() -> NoReturn:
    """Run the command line in a process of its own, where the system can do that, and end."""
    began_s = time.monotonic()
    _open_standard_streams()
    # Results would be lost with a mask that takes rights from the owner.
    os.umask(os.umask(0) & 0o077)
    if sys.platform != "linux":
        # Elsewhere libraries of the system do not survive a fork.
        _work(began_s)
    parent = os.getpid()
    # Else nobody could wait for the worker.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    messages = _Messages()
    try:
        worker = os.fork()
    except OSError:  # too many processes
        _work(began_s)
    if not worker:
        end_with(parent)
        _work_and_tell(began_s, messages)
    _speak_meanwhile(began_s, messages.wait)
    sys.exit(_wait_for(worker, messages))


def _wait_for(worker: int, messages: "_Messages") -> int:
    """Pass signals on to a worker until it has ended, and return the exit code of the command."""
    signals: list[int] = []

    def stop(number: int, _: object) -> None:
        if BEGUN not in messages.read():
            _kill(worker, signal.SIGKILL)
        elif signals:
            _kill(worker, signal.SIGINT)
        else:
            signal.setitimer(signal.ITIMER_REAL, PATIENCE_S)
            _kill(worker, signal.SIGTERM)
        signals.append(number)

    signal.signal(signal.SIGALRM, lambda *_: _kill(worker, signal.SIGKILL))
    _handle(stop)
    _, status = os.waitpid(worker, 0)
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    code = os.waitstatus_to_exitcode(status)
    has_failed = code > 0 and code != EXIT_INTERRUPTED
    if has_failed and not signals and ENDED not in messages.read():
        say(
            f"error: native code ended the command with exit code {code}{WITHOUT_MEMORY}; {KEPT}"
        )
    return _exit_code(code, signals)


class _Messages:
    """What the worker tells its parent, a byte each."""

    def __init__(self) -> None:
        self._out, self._in = os.pipe()
        os.set_blocking(self._out, False)
        self._received = b""

    def write(self, message: bytes) -> None:
        os.write(self._in, message)

    def read(self) -> bytes:
        """Return all that has been told until now."""
        with suppress(BlockingIOError):  # nothing new
            self._received += os.read(self._out, 2)
        return self._received

    def wait(self, timeout_s: float) -> bool:
        """Wait until anything has been told, and return whether it has; nothing is read."""
        if self._received:
            return True
        return bool(select.select([self._out], [], [], timeout_s)[0])


def _speak_meanwhile(began_s: float, wait: Callable[[float], bool]) -> None:
    """Say in the background that packages are loaded, once that takes long.

    Args:
        began_s: when the process began, of the monotonic clock.
        wait: waits for some seconds, and returns whether they are loaded.
    """
    if _is_quiet():
        return

    def speak() -> None:
        if hasattr(signal, "pthread_sigmask"):  # signals are for the main thread
            signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        wanted_s = QUIET_S
        while not wait(TICK_S):
            passed_s = time.monotonic() - began_s
            if passed_s >= wanted_s:
                say(LOADING.format(seconds=passed_s))
                wanted_s = passed_s + QUIET_S

    threading.Thread(target=speak, daemon=True).start()


def _end_speaking(began_s: float) -> float:
    """Say that packages are loaded, where that has taken long: the command speaks after seconds.

    Args:
        began_s: when the process began, of the monotonic clock.

    Returns:
        For how many seconds nothing was said.
    """
    passed_s = time.monotonic() - began_s
    if passed_s < QUIET_S:
        return passed_s
    if not _is_quiet():
        say(LOADED.format(seconds=passed_s))
    return 0.0


def _is_quiet() -> bool:
    """Return whether the command is to say nothing but its result."""
    return not {"-q", "--quiet"}.isdisjoint(sys.argv)


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


def _work_and_tell(began_s: float, messages: _Messages) -> NoReturn:
    """Run the command line, and tell when it ends, as native code that ends it does not.

    Args:
        began_s: when the process began, of the monotonic clock.
        messages: to the parent.
    """
    try:
        _work(began_s, lambda: messages.write(BEGUN))
    except SystemExit as end:
        if isinstance(end.code, int):
            messages.write(ENDED)
            _end_at_once(end.code)
        raise
    finally:
        messages.write(ENDED)


def _end_at_once(code: int) -> NoReturn:
    """End without taking apart what is loaded: with torch that is most of a second of silence."""
    with suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            if stream:
                stream.flush()
    atexit._run_exitfuncs()
    os._exit(code)


def _leave(*_: object) -> NoReturn:
    """End at once: what was done before is kept, as after a kill."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    say(INTERRUPTED)
    os._exit(EXIT_INTERRUPTED)


class _Interrupts:
    """Raises the first signal as an exception; another Ctrl-C ends the process."""

    def __init__(self) -> None:
        self.signals: list[int] = []

    def raise_first(self, number: int, _: object) -> None:
        """Handle a signal.

        Args:
            number: of the signal.
            _: the frame that it interrupted.

        Raises:
            KeyboardInterrupt: it is the first one.
        """
        if number == signal.SIGTERM and self.signals:
            return  # of the first process, for a Ctrl-C that came here, too
        if self.signals:
            _leave()
        self.signals.append(number)
        raise KeyboardInterrupt


def _work(began_s: float, tell_begin: Callable[[], None] | None = None) -> NoReturn:
    """Run the command in this process.

    The first Ctrl-C or SIGTERM is raised as an exception, so that the command can tidy up; another
    Ctrl-C ends it at once. Both are put off while packages are loaded, where a parent is told when
    that has come to an end; else they end the process at once.

    Args:
        began_s: when the process began, of the monotonic clock.
        tell_begin: tells a parent that all is loaded; None where there is no parent.
    """
    keep_freed_memory()
    interrupts = _Interrupts()
    is_loaded = threading.Event()
    code: int | str | None

    def begin() -> float:
        # What has been loaded stays: nothing of it is to be looked for garbage.
        gc.freeze()
        gc.enable()
        is_loaded.set()
        if tell_begin:
            tell_begin()
        waited_s = _end_speaking(began_s)
        _handle(interrupts.raise_first)
        return waited_s

    for stream in (sys.stdout, sys.stderr):
        escape_what_lacks(stream)
    try:
        if not tell_begin:
            _handle(_leave)
            _speak_meanwhile(began_s, is_loaded.wait)
        gc.disable()  # while packages are loaded, which is a tenth faster so
        from colmap_affrect.cli import main

        code = main(begin=begin)
    except SystemExit as end:  # argparse has shown help
        code = end.code
    except (KeyboardInterrupt, Exception) as error:
        # Libraries turn a KeyboardInterrupt in their callbacks into errors of their own.
        if interrupts.signals or isinstance(error, KeyboardInterrupt):
            _leave()  # at once: threads may be in the middle of something long
        elif lacks_memory(error):  # already for loading what is needed
            say(f"error: {with_flags(MEMORY_HINT)}")
            code = 1
        else:
            raise
    _end(code)


def _end(code: int | str | None) -> NoReturn:
    """End this process, and do not mind that nobody reads what is printed any more."""
    for number in SIGNALS:  # too late to change anything
        signal.signal(number, signal.SIG_IGN)
    try:
        if sys.stdout:  # it may have been closed
            sys.stdout.flush()
    except OSError as error:
        # Python flushes it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not code and not isinstance(error, BrokenPipeError):
            say(f"error: what the command prints cannot be written ({error.strerror})")
            code = 1
    sys.exit(code)
