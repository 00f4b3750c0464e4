"""Run pycolmap's long calls so that Ctrl-C stops them cleanly and freed memory is theirs."""

import threading
from collections.abc import Callable
from typing import TypeVar

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError
from colmap_affrect.parallel.executor import begin_in_thread
from colmap_affrect.parallel.freed_memory import return_freed_memory

Result = TypeVar("Result")
POLL_S = 0.2  # resource: how long it takes at most to notice
# That a call has to end after it was cancelled; some never look; resource
LEAVE_AFTER_S = 3.0
# COLMAP's mappers open a database by its path and do not wait for one another: of two threads
# that map the same at once, one would fail.
ONE_MAPPING = threading.Lock()


def run_cancellable(
    call: Callable[[pycolmap.CancellationToken], Result],
    token: pycolmap.CancellationToken | None = None,
) -> Result:
    """Run ``call`` with a token in a thread; on Ctrl-C cancel it, and leave it if it goes on."""
    return_freed_memory()
    known = token or pycolmap.CancellationToken()
    # Not Thread.join: interrupted in Python 3.11, it takes the running thread for ended, and
    # the interpreter then ends under pycolmap's feet (bpo-45274).
    begun = threading.Event()
    ended = threading.Event()

    def work() -> Result:
        begun.set()
        try:
            return call(known)
        finally:
            ended.set()

    try:
        # In here, as Ctrl-C may come when it has just begun.
        outcome = begin_in_thread(work)
        while not ended.wait(POLL_S):
            pass
    except KeyboardInterrupt:
        known.cancel()
        if begun.is_set() and not ended.wait(LEAVE_AFTER_S):
            _silence_until(ended)
        raise
    return outcome.result()


def _silence_until(ended: threading.Event) -> None:
    """Keep COLMAP's lines from following the last one of a command that left it behind."""
    level = pycolmap.logging.minloglevel
    if level == pycolmap.logging.FATAL.value:  # for another call that was left
        return
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value

    def restore() -> None:
        ended.wait()
        if pycolmap.logging.minloglevel == pycolmap.logging.FATAL.value:
            pycolmap.logging.minloglevel = level

    threading.Thread(target=restore, daemon=True).start()


def run_mapping(
    call: Callable[[pycolmap.CancellationToken], Result],
    token: pycolmap.CancellationToken | None,
    what: str,
) -> Result:
    """Run one of COLMAP's mappers, and end as mappers do that are stopped or fail.

    Args:
        call: of pycolmap; a call that cannot be stopped may leave the token unused.
        token: of the task.
        what: is mapped by, for the message: ``incremental mapper``.

    Returns:
        What the call returns.

    Raises:
        AffrectError: COLMAP ends with an error.
        KeyboardInterrupt: the token was cancelled, before or meanwhile.
    """
    _raise_if_cancelled(token)
    try:
        found = run_cancellable(call, token)
    except InterruptedError as error:
        raise KeyboardInterrupt from error
    except AffrectError:
        raise
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise AffrectError(f"COLMAP's {what} failed: {reason}") from error
    _raise_if_cancelled(token)
    return found


def _raise_if_cancelled(token: pycolmap.CancellationToken | None) -> None:
    if token and token.is_cancelled:
        raise KeyboardInterrupt
