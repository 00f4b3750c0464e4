"""Run pycolmap's long calls so that Ctrl-C stops them cleanly and freed memory is theirs."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from colmap_affrect.colmap import pycolmap
from colmap_affrect.parallel.executor import return_freed_memory

Result = TypeVar("Result")
POLL_S = 0.2  # resource: how long it takes at most to notice
# That a call has to end after it was cancelled; some never look; resource
LEAVE_AFTER_S = 3.0


def run_cancellable(
    call: Callable[[pycolmap.CancellationToken], Result],
    token: pycolmap.CancellationToken | None = None,
) -> Result:
    """Run ``call`` with a token in a thread; on Ctrl-C cancel it, and leave it if it goes on."""
    return_freed_memory()
    known = token or pycolmap.CancellationToken()
    outcome: Future[Result] = Future()
    # Not Thread.join: interrupted in Python 3.11, it takes the running thread for ended, and
    # the interpreter then ends under pycolmap's feet (bpo-45274).
    ended = threading.Event()

    def work() -> None:
        try:
            outcome.set_result(call(known))
        except BaseException as error:  # noqa: BLE001  (raised again by the waiting thread)
            outcome.set_exception(error)
        finally:
            ended.set()

    threading.Thread(target=work, daemon=True).start()
    try:
        while not ended.wait(POLL_S):
            pass
    except KeyboardInterrupt:
        known.cancel()
        ended.wait(LEAVE_AFTER_S)
        raise
    return outcome.result()
