"""Progress of long stages, a tqdm bar, plain lines or silence, and how long a whole run takes."""

import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Self, TextIO

from tqdm import tqdm

from colmap_affrect.errors import shown

Advance = Callable[[int], None]  # report that so many more units are done
NUM_PLAIN_LINES = 10

COSTS = {"extract": 1.0, "match": 0.25, "match by network": 0.7, "verify": 0.15, "map": 0.7}
"""What one unit of a stage takes in the time that one image takes in ``extract``, for stages that
have not begun: measured on runs of 8 to 1000 photographs, good for a factor of 2."""
MAP_COST_PER_IMAGE = 0.015  # that each image adds to the cost of mapping one: adjustments grow
MIN_DONE, MIN_ELAPSED_S = 5, 3.0
"""Less of a stage says too little of the rest: the first unit waits for what has to be loaded."""


@dataclass
class _Stage:
    cost: float
    ahead: int
    done: int = 0
    elapsed_s: float = 0.0

    @property
    def is_measured(self) -> bool:
        return self.done >= MIN_DONE and self.elapsed_s >= MIN_ELAPSED_S


class Forecast:
    """Adds up what is left of a row of stages.

    A stage that has begun takes as long per unit as until now; one that has not is guessed from
    those that have.
    """

    def __init__(
        self,
        num_images: int,
        num_pairs: int,
        *,
        by_network: bool = False,
        may_escalate: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take what is ahead, if all images are new.

        ``by_network``: a network matches; ``may_escalate``: pairs may be matched again with more
        warps, how many nobody knows before.
        """
        match_cost = COSTS["match by network" if by_network else "match"]
        self._stages = {
            "extract": _Stage(COSTS["extract"], num_images),
            "match": _Stage(match_cost, num_pairs),
            "verify": _Stage(COSTS["verify"], num_pairs),
            "map": _Stage(COSTS["map"] + MAP_COST_PER_IMAGE * num_images, num_images),
        }
        self._may_escalate, self._clock = may_escalate, clock
        self._current, self._start_s = "", 0.0

    def begin(self, name: str, total: int) -> None:
        """A stage begins with so many units."""
        known = self._stages.get(name, _Stage(0.0, 0))
        if name == "match":
            self._stages["verify"].ahead = total
        self._stages[name] = _Stage(known.cost, total)
        self._may_escalate &= name not in ("cameras", "guide", "map")
        self._current, self._start_s = name, self._clock()

    def advance(self, count: int) -> str:
        """So many units of the stage that began last are done; return :meth:`text`."""
        stage = self._stages[self._current]
        stage.done += count
        stage.ahead = max(stage.ahead - count, 0)
        stage.elapsed_s = self._clock() - self._start_s
        return self.text()

    def end(self) -> None:
        """The stage that began last is over, whatever it has done."""
        self._stages[self._current].ahead = 0

    def left_s(self) -> float | None:
        """Return the seconds that are left, None while too little is measured."""
        measured = [stage for stage in self._stages.values() if stage.is_measured and stage.cost]
        if not measured:
            return None
        total_cost = sum(stage.done * stage.cost for stage in measured)
        image_s = sum(stage.elapsed_s for stage in measured) / total_cost
        return sum(
            stage.ahead
            * (stage.elapsed_s / stage.done if stage.is_measured else stage.cost * image_s)
            for stage in self._stages.values()
        )

    def text(self) -> str:
        """Return the same for people; empty while too little is measured, and in the last minute.

        And from mapping on, which is the last stage and may begin anew.
        """
        minutes = (self.left_s() or 0.0) / 60
        if minutes < 1 or not self._stages["map"].ahead or self._current == "map":
            return ""
        about = f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
        but = " without further warps" if self._may_escalate else ""
        return f"whole run: about {about} left{but}"


class Progress:
    """Where progress goes; the library is silent unless it is given one of these."""

    def __init__(
        self, stream: TextIO | None = None, num_plain_lines: int = NUM_PLAIN_LINES
    ) -> None:
        """Write to a stream, at most so many lines a stage without a terminal; None is silence."""
        self._stream, self._num_plain_lines = stream, num_plain_lines
        self._forecast: Forecast | None = None
        self._title = ""

    @property
    def file_number(self) -> int:
        """Descriptor of the stream for another process, that of nothing where there is none."""
        try:
            return self._stream.fileno() if self._stream else subprocess.DEVNULL
        except OSError:  # only in this process
            return subprocess.DEVNULL

    def titled(self, title: str) -> Self:
        """Return the same whose names of stages begin with a title."""
        new = copy(self)
        new._title += title
        return new

    def with_forecast(self, forecast: Forecast) -> Self:
        """Return the same that also says how long all stages take."""
        new = copy(self)
        new._forecast = forecast
        return new

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show one stage of ``total`` units for as long as the context lasts."""
        forecast = self._forecast
        if forecast:
            forecast.begin(name, total)
        with self._display(self._title + name, total, unit) as show_more:
            yield lambda count: show_more(count, forecast.advance(count) if forecast else "")
        if forecast:
            forecast.end()

    @contextmanager
    def _display(self, name: str, total: int, unit: str) -> Iterator[Callable[[int, str], None]]:
        """Yield what shows how many more units are done, beside a text on the whole run."""
        if self._stream is None or total == 0:
            yield lambda *_: None
        elif self._stream.isatty():
            with tqdm(total=total, desc=name, unit=unit, file=self._stream) as bar:
                yield lambda count, left: _update(bar, count, left)
        else:
            lines = _PlainLines(self._stream, name, total, unit, self._num_plain_lines)
            yield lines.advance
            if not lines.printed:
                lines.print("")


SILENT = Progress()


def show(text: object, *, file: TextIO | None = None, end: str = "\n") -> None:
    """Print what people or programs read; see :mod:`colmap_affrect.errors`."""
    print(shown(str(text)), file=file, end=end)


def _update(bar: "tqdm[None]", count: int, left: str) -> None:
    bar.set_postfix_str(left, refresh=False)
    bar.update(count)


@dataclass
class _PlainLines:
    """A few lines, evenly over the whole stage."""

    stream: TextIO
    name: str
    total: int
    unit: str
    num_lines: int
    done: int = 0
    printed: int = 0

    def advance(self, count: int, left: str) -> None:
        self.done += count
        part = self.done * self.num_lines // self.total
        if part > self.printed:
            self.printed = part
            self.print(left)

    def print(self, left: str) -> None:
        line = f"{self.name}: {self.done}/{self.total} {self.unit}"
        show(f"{line}, {left}" if left else line, file=self.stream)


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
