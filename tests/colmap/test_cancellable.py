"""Long calls of pycolmap: memory before them, interrupts meanwhile."""

from __future__ import annotations

import os
import signal
import time

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_cancellable


def test_interrupt_of_a_pycolmap_call_is_raised_after_the_call_has_ended() -> None:
    ended = []

    def call(token: pycolmap.CancellationToken) -> None:
        time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        ended.append(token)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_cancellable(call)
    finally:
        signal.signal(signal.SIGINT, handler)
    # Else the interpreter would end while pycolmap's thread needs it, and the process abort.
    assert len(ended) == 1
