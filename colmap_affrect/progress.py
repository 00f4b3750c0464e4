"""Progress of long stages: a tqdm bar on a terminal, plain lines elsewhere, or silence."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from typing import Self, TextIO

from tqdm import tqdm

from colmap_affrect.forecast import Forecast
from colmap_affrect.shown import shown

logger = logging.getLogger(__name__)

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
        told = _Told(self._forecast, name, total)
        if self._stream is None or total == 0:
            yield _ignore
        elif self._stream.isatty():
            with tqdm(total=total, desc=name, unit=unit, file=self._stream) as bar:
                yield lambda count: _update(bar, count, told)
        else:
            lines = _PlainLines(self._stream, name, total, unit, self._num_plain_lines, told)
            yield lines
            lines.finish()
        told.end()


SILENT = Progress()


def show(text: object, *, file: TextIO | None = None, end: str = "\n") -> None:
    """Print what people or programs read; see :mod:`colmap_affrect.shown`."""
    print(shown(str(text)), file=file, end=end)


class _Told:
    """Tells a forecast, if there is one, of a stage, and logs what it says first."""

    def __init__(self, forecast: Forecast | None, name: str, total: int) -> None:
        self._forecast = forecast
        self._was_logged = False
        if forecast:
            forecast.begin(name, total)

    def advance(self, count: int) -> str:
        """Return what the forecast says now."""
        if not self._forecast:
            return ""
        self._forecast.advance(count)
        text = self._forecast.text()
        if text and not self._was_logged:
            self._was_logged = True
            logger.info("%s", text)
        return text

    def end(self) -> None:
        if self._forecast:
            self._forecast.end()


def _update(bar: "tqdm[None]", count: int, told: _Told) -> None:
    bar.set_postfix_str(told.advance(count), refresh=False)
    bar.update(count)


def _ignore(count: int) -> None:
    pass


class _PlainLines:
    """A few lines, evenly over the whole stage."""

    def __init__(
        self, stream: TextIO, name: str, total: int, unit: str, num_lines: int, told: _Told
    ) -> None:
        self._stream, self._name, self._total, self._unit = stream, name, total, unit
        self._num_lines, self._told = num_lines, told
        self._done = self._printed = 0
        self._forecast = ""

    def __call__(self, count: int) -> None:
        self._done += count
        self._forecast = self._told.advance(count)
        part = self._done * self._num_lines // self._total
        if part > self._printed:
            self._printed = part
            self._print()

    def finish(self) -> None:
        """Say how far it came if nothing was said before."""
        if not self._printed:
            self._print()

    def _print(self) -> None:
        line = f"{self._name}: {self._done}/{self._total} {self._unit}"
        show(", ".join(filter(None, [line, self._forecast])), file=self._stream)
