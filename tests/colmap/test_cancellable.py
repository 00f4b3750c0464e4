"""Long calls of pycolmap: memory before them, interrupts meanwhile."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest

from colmap_affrect.colmap import cancellable, pycolmap
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


def test_interrupt_just_after_a_call_has_begun_waits_for_the_call(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tokens = []

    def call(token: pycolmap.CancellationToken) -> None:
        while not token.is_cancelled:
            time.sleep(0.01)
        tokens.append(token)

    class InterruptedWhenBegun(threading.Thread):
        def start(self) -> None:
            super().start()
            raise KeyboardInterrupt

    monkeypatch.setattr(cancellable.threading, "Thread", InterruptedWhenBegun)
    with pytest.raises(KeyboardInterrupt):
        run_cancellable(call)
    assert len(tokens) == 1


def test_call_that_goes_on_after_an_interrupt_says_nothing_until_it_ends(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cancellable, "LEAVE_AFTER_S", 0.01)
    may_end = threading.Event()
    ended = threading.Event()

    def call(_: pycolmap.CancellationToken) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        may_end.wait()
        pycolmap.logging.info("of the call that was left")
        ended.set()

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    level = pycolmap.logging.minloglevel
    try:
        with pytest.raises(KeyboardInterrupt):
            run_cancellable(call)
        may_end.set()
        assert ended.wait(10)
        assert "was left" not in capfd.readouterr().err
        for _ in range(1000):
            if pycolmap.logging.minloglevel == level:
                break
            time.sleep(0.01)
        assert pycolmap.logging.minloglevel == level
        pycolmap.logging.info("of another call")
        assert "of another call" in capfd.readouterr().err
    finally:
        signal.signal(signal.SIGINT, handler)
        pycolmap.logging.minloglevel = level
