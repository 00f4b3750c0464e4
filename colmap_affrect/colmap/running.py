"""Run pycolmap's long calls so that Ctrl-C stops them cleanly."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from colmap_affrect.colmap import pycolmap

Result = TypeVar("Result")

POLL_S = 0.2


def run_cancellable(
    call: Callable[[pycolmap.CancellationToken], Result], tick: Callable[[], None] | None = None
) -> Result:
    """Run ``call`` in a thread; on Ctrl-C cancel it, wait until it has ended, and re-raise.

    Args:
        call: takes the token that pycolmap's call must be given.
        tick: called several times a second while waiting.
    """
    token = pycolmap.CancellationToken()
    outcome: list[Result] = []
    failure: list[BaseException] = []

    def work() -> None:
        try:
            outcome.append(call(token))
        except BaseException as error:  # noqa: BLE001  (raised again by the waiting thread)
            failure.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        while thread.is_alive():
            thread.join(POLL_S)
            if tick:
                tick()
    except KeyboardInterrupt:
        token.cancel()
        thread.join()
        raise
    if failure:
        raise failure[0]
    return outcome[0]
