"""Progress of long stages: a tqdm bar on a terminal, plain lines elsewhere, or silence."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Self, TextIO

from tqdm import tqdm

from colmap_affrect.forecast import Forecast
from colmap_affrect.shown import shown

Advance = Callable[[int], None]  # report that so many more units are done
NUM_PLAIN_LINES = 10


class Progress:
    """Where progress goes; the library is silent unless it is given one of these."""

    def __init__(
        self, stream: TextIO | None = None, num_plain_lines: int = NUM_PLAIN_LINES
    ) -> None:
        """Write to a stream, at most so many lines a stage without a terminal; None is silence."""
        self._stream, self._num_plain_lines = stream, num_plain_lines
        self._forecast: Forecast | None = None

    def with_forecast(self, forecast: Forecast) -> Self:
        """Return the same that also says how long all stages take, there and in the log."""
        new = copy(self)
        new._forecast = forecast
        return new

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show one stage of ``total`` units for as long as the context lasts."""
        forecast = self._forecast
        if forecast:
            forecast.begin(name, total)
        left = forecast.advance if forecast else _not_known
        if self._stream is None or total == 0:
            yield lambda _: None
        elif self._stream.isatty():
            with tqdm(total=total, desc=name, unit=unit, file=self._stream) as bar:
                yield lambda count: _update(bar, count, left(count))
        else:
            lines = _PlainLines(self._stream, name, total, unit, self._num_plain_lines, left)
            yield lines.advance
            lines.finish()
        if forecast:
            forecast.end()


SILENT = Progress()


def show(text: object, *, file: TextIO | None = None, end: str = "\n") -> None:
    """Print what people or programs read; see :mod:`colmap_affrect.shown`."""
    print(shown(str(text)), file=file, end=end)


def _not_known(count: int) -> str:
    del count
    return ""


def _update(bar: "tqdm[None]", count: int, left: str) -> None:
    bar.set_postfix_str(left, refresh=False)
    bar.update(count)


@dataclass
class _PlainLines:
    """A few lines, evenly over the whole stage; ``left`` says how long the rest takes."""

    stream: TextIO
    name: str
    total: int
    unit: str
    num_lines: int
    left: Callable[[int], str]
    done: int = 0
    printed: int = 0

    def advance(self, count: int) -> None:
        self.done += count
        left = self.left(count)
        part = self.done * self.num_lines // self.total
        if part > self.printed:
            self.printed = part
            self._print(left)

    def finish(self) -> None:
        """Say how far it came if nothing was said before."""
        if not self.printed:
            self._print("")

    def _print(self, left: str) -> None:
        line = f"{self.name}: {self.done}/{self.total} {self.unit}"
        show(f"{line}, {left}" if left else line, file=self.stream)
