"""Progress of long stages: a tqdm bar, lines or silence; and when the first model will be there."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from tqdm import tqdm

from colmap_affrect.errors import OptionError, shown

Advance = Callable[[int], None]  # report that so many more units are done
NUM_PLAIN_LINES = 10  # display
COSTS = {"extract": 1.0, "match": 0.2, "verify": 0.08, "map": 0.7}
"""Of an image or a pair in a stage, in the time of an image in ``extract``: measured on runs
of 8 to 1000 photographs, good for a factor of 2."""
# Of a stage: before, it has loaded files and networks, and says too little; display
MIN_ELAPSED_S = 3.0


class Forecast:
    """What is left of a row of stages: the one that runs is measured, others guessed from it."""

    def __init__(
        self,
        num_images: int,
        num_pairs: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Take what is ahead if all images are new."""
        units = {"extract": num_images, "match": num_pairs, "verify": num_pairs}
        units["map"] = (
            num_images + num_images**2 // 50
        )  # adjustments grow with the model
        self._costs = {
            name: COSTS[name] * count for name, count in units.items()
        }  # ahead
        self._cost = self._start_s = 0.0  # of the stage that runs
        self._clock = clock

    def begin(self, name: str, total: int) -> None:
        """A stage begins with so many units."""
        is_known = self._costs.pop(name, None) is not None
        self._cost = is_known * COSTS.get(name, 0.0) * total
        self._start_s = self._clock()

    def text(self, frac: float) -> str:
        """Say how long the first model takes, when a fraction of the stage is done.

        Empty while too little is measured, in the last minute, and from mapping on.
        """
        elapsed_s = self._clock() - self._start_s
        if not (frac and self._cost and self._costs) or elapsed_s < MIN_ELAPSED_S:
            return ""
        left = (1 - frac) + sum(
            self._costs.values()
        ) / self._cost  # in units of this stage
        minutes = elapsed_s / frac * left / 60
        if minutes < 1:
            return ""
        about = f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"
        return f"first model in about {about}"


@dataclass(eq=False)
class Progress:
    """Where progress goes, and how it is shown: a bar on a terminal or in a notebook, else lines.

    Attributes:
        stream: where it is written to, as ``sys.stderr``; None is silence.
        num_plain_lines: most lines of a stage, where the stream takes no bars.
        title: with which the names of stages begin.
        forecast: says how long all stages take.
    """

    stream: TextIO | None = None
    num_plain_lines: int = NUM_PLAIN_LINES
    title: str = ""
    forecast: Forecast | None = None

    @classmethod
    def given(cls, progress: "GivenProgress") -> "Progress":
        """Return what the argument ``progress`` of a function asks for.

        Args:
            progress: one of these as it is; True for standard error, False for silence; None for
                standard error where somebody looks at it, on a terminal or in a notebook.
        """
        if isinstance(progress, cls):
            return progress
        if not (progress is None or isinstance(progress, bool)):
            raise OptionError(f"progress={progress!r}: give True, False or a Progress")
        shown = cls(sys.stderr)
        is_wanted = shown.takes_bars if progress is None else progress
        return shown if is_wanted else SILENT

    @property
    def takes_bars(self) -> bool:
        """Whether the stream can replace what it has shown."""
        if self.stream is None:
            return False
        return self.stream.isatty() or (self.stream is sys.stderr and _is_notebook())

    @property
    def file_number(self) -> int:
        """Descriptor of the stream for another process, that of nothing where there is none."""
        try:
            return self.stream.fileno() if self.stream else subprocess.DEVNULL
        except OSError:  # only in this process
            return subprocess.DEVNULL

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show one stage of ``total`` units for as long as the context lasts."""
        forecast = self.forecast
        stream = self.stream
        title = self.title + name
        done = num_lines = 0
        if forecast:
            forecast.begin(name, total)

        def left(count: int) -> str:
            nonlocal done
            done += count
            return forecast.text(done / total) if forecast else ""

        def print_line(text: str) -> None:
            show(f"{title}: {done}/{total} {unit}{text and ', '}{text}", file=stream)

        def advance_lines(count: int) -> None:
            nonlocal num_lines
            text = left(count)
            if (wanted := done * self.num_plain_lines // total) > num_lines:
                num_lines = wanted
                print_line(text)

        if stream is None or total == 0:
            yield lambda _: None
        elif self.takes_bars:
            with (
                tqdm(total=total, desc=title, unit=unit, file=stream) as bar,
                _ticking(bar),
            ):

                def advance(count: int) -> None:
                    bar.set_postfix_str(left(count), refresh=False)
                    bar.update(count)

                yield advance
        else:
            yield advance_lines
            if not num_lines:
                print_line("")


@contextmanager
def _ticking(bar: tqdm) -> Iterator[None]:
    """Show each second how long a bar has run: one unit may take a minute."""
    is_over = threading.Event()

    def tick() -> None:
        while not is_over.wait(1.0):
            bar.refresh()

    thread = threading.Thread(target=tick, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


SILENT = Progress()
GivenProgress = Progress | bool | None
"""What functions take as ``progress``, see :meth:`Progress.given`."""


def _is_notebook() -> bool:
    """Tell whether this process is the kernel of a notebook, whose cells show bars."""
    interactive = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return interactive is not None and "IPKernelApp" in interactive.config


def show(text: object, *, file: TextIO | None = None, end: str = "\n") -> None:
    """Print what people or programs read; see :mod:`colmap_affrect.errors`."""
    print(shown(str(text)), file=file, end=end)


class Stopwatch:
    """Adds up the seconds of named steps."""

    def __init__(self, *steps: str) -> None:
        self.seconds = dict.fromkeys(steps, 0.0)  # those named first may stay 0

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a block, also if it fails."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = (
                self.seconds.get(name, 0.0) + time.perf_counter() - start
            )
