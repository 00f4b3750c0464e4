"""Progress of long stages: a tqdm bar on a terminal, plain lines elsewhere, or silence."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from tqdm import tqdm

from colmap_affrect.shown import shown

Advance = Callable[[int], None]
"""Report that so many more units are done."""

NUM_PLAIN_LINES = 10


class Progress:
    """Where progress goes; the library is silent unless it is given one of these."""

    def __init__(
        self, stream: TextIO | None = None, num_plain_lines: int = NUM_PLAIN_LINES
    ) -> None:
        """Write to ``stream``; None means silence.

        Args:
            stream: where bars or lines go.
            num_plain_lines: at most so many lines for a stage where there is no terminal.
        """
        self._stream, self._num_plain_lines = stream, num_plain_lines

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show one stage of ``total`` units for as long as the context lasts."""
        if self._stream is None or total == 0:
            yield _ignore
        elif self._stream.isatty():
            with tqdm(total=total, desc=name, unit=unit, file=self._stream) as bar:
                yield lambda count: _update(bar, count)
        else:
            lines = _PlainLines(self._stream, name, total, unit, self._num_plain_lines)
            yield lines
            lines.finish()


SILENT = Progress()


def show(text: object, *, file: TextIO | None = None, end: str = "\n") -> None:
    """Print what people or programs read; see :mod:`colmap_affrect.shown`."""
    print(shown(str(text)), file=file, end=end)


def _update(bar: tqdm[None], count: int) -> None:
    bar.update(count)


def _ignore(count: int) -> None:
    pass


class _PlainLines:
    """A few lines, evenly over the whole stage."""

    def __init__(self, stream: TextIO, name: str, total: int, unit: str, num_lines: int) -> None:
        self._stream, self._name, self._total, self._unit = stream, name, total, unit
        self._num_lines = num_lines
        self._done = self._printed = 0

    def __call__(self, count: int) -> None:
        self._done += count
        part = self._done * self._num_lines // self._total
        if part > self._printed:
            self._printed = part
            self._print()

    def finish(self) -> None:
        """Say how far it came if nothing was said before."""
        if not self._printed:
            self._print()

    def _print(self) -> None:
        show(f"{self._name}: {self._done}/{self._total} {self._unit}", file=self._stream)
