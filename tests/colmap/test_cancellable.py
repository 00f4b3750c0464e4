"""Long calls of pycolmap: memory before them, interrupts meanwhile."""

from __future__ import annotations

import os
import platform
import signal
import time
from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cancellable import run_cancellable


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only GNU's C library keeps so much")
def test_freed_memory_is_given_back_before_pycolmap_is_called() -> None:
    def resident_bytes(token: object = None) -> int:
        del token
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGESIZE")

    blocks = [b"x" * size for size in range(2000, 12_000)]
    taken = resident_bytes()
    del blocks[:-1]  # the last one keeps those before it from being given back at once
    blocks.append(b"x" * 2000)
    assert taken - run_cancellable(resident_bytes) > 0.8 * 10_000 * 7_000


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
