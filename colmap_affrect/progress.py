"""Progress of long stages: a tqdm bar on a terminal, plain lines elsewhere, or silence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from tqdm import tqdm

Advance = Callable[[int], None]
"""Report that so many more units are done."""

NUM_PLAIN_LINES = 10


class Progress:
    """Where progress goes; the library is silent unless it is given one of these."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Write to ``stream``; None means silence."""
        self._stream = stream

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show one stage of ``total`` units for as long as the context lasts."""
        if self._stream is None or total == 0:
            yield _ignore
        elif self._stream.isatty():
            with tqdm(total=total, desc=name, unit=unit, file=self._stream) as bar:
                yield lambda count: _update(bar, count)
        else:
            yield _PlainLines(self._stream, name, total, unit)


SILENT = Progress()


def _update(bar: tqdm[None], count: int) -> None:
    bar.update(count)


def _ignore(count: int) -> None:
    pass


class _PlainLines:
    """At most ``NUM_PLAIN_LINES`` lines over the whole stage."""

    def __init__(self, stream: TextIO, name: str, total: int, unit: str) -> None:
        self._stream, self._name, self._total, self._unit = stream, name, total, unit
        self._done = self._printed = 0

    def __call__(self, count: int) -> None:
        self._done += count
        tenth = self._done * NUM_PLAIN_LINES // self._total
        if tenth > self._printed:
            self._printed = tenth
            print(f"{self._name}: {self._done}/{self._total} {self._unit}", file=self._stream)
