"""Seconds by step, wherever steps are timed."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Adds up the seconds of named steps; while one runs inside another, only the inner counts."""

    def __init__(self, *steps: str) -> None:
        # by step; those named beforehand come first and may stay 0
        self.seconds: dict[str, float] = dict.fromkeys(steps, 0.0)
        self._within = 0.0

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a block, also if it fails."""
        start, before, self._within = time.perf_counter(), self._within, 0.0
        try:
            yield
        finally:
            whole = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + whole - self._within
            self._within = before + whole
