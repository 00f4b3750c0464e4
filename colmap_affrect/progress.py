"""Progress of long stages: a tqdm bar, lines or silence; and when the first model will be there."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TextIO

from tqdm import tqdm

from colmap_affrect.errors import OptionError, shown

Advance = Callable[[int], None]  # report that so many more units are done
NUM_PLAIN_LINES = 10
COSTS = {"extract": 1.0, "match": 0.2, "verify": 0.08, "map": 0.7}
"""Of an image or a pair in a stage, in the time of an image in ``extract``: measured on runs
of 8 to 1000 photographs, good for a factor of 2."""
# Of a stage: before, it has loaded files and networks, and says too little
MIN_ELAPSED_S = 3.0


# Of silence, until something says that the work goes on (judged); where lines stay, as in a log,
# twice as long after each of them, up to the longest
QUIET_S = 5.0
LONGEST_QUIET_S = 60.0


class Voice:
    """When something was shown last, and about what: one for all stages of a command."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = "beginning"
        self._clock = clock
        self._heard_s = clock()  # when something was shown last
        self._since_s = (
            self._heard_s
        )  # when what is done last showed something of its own
        self._quiet_s = QUIET_S

    def heard(self, doing: str) -> None:
        """Something was shown."""
        self.doing = doing
        self._heard_s = self._clock()
        self._since_s = self._heard_s
        self._quiet_s = QUIET_S

    def wanted(self, *, stays: bool) -> str:
        """Return what to say after a silence, and take it as said; empty while there was none.

        Args:
            stays: whether each line stays, as in a log; else the next one replaces it.
        """
        now_s = self._clock()
        if now_s - self._heard_s < self._quiet_s:
            return ""
        self._heard_s = now_s
        self._quiet_s = 1.0  # a line that is replaced counts the seconds
        if stays:
            silent_s = now_s - self._since_s
            self._quiet_s = min(max(QUIET_S, silent_s), LONGEST_QUIET_S)
        return f"{self.doing}: at work for {now_s - self._since_s:.0f} s"


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
        voice: knows when something was shown last.
    """

    stream: TextIO | None = None
    num_plain_lines: int = NUM_PLAIN_LINES
    title: str = ""
    forecast: Forecast | None = None
    voice: Voice = field(default_factory=Voice)

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
            counts = f"{title}: {done}/{total} {unit}"
            show(f"{counts}{text and ', '}{text}", file=stream)
            self.voice.heard(counts)

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
                _ticking(bar, self.voice, title),
            ):

                def advance(count: int) -> None:
                    bar.set_postfix_str(left(count), refresh=False)
                    bar.update(count)

                yield advance
            self.voice.heard(f"after {title}")
        else:
            self.voice.doing = title
            yield advance_lines
            if not num_lines:
                print_line("")
            self.voice.doing = f"after {title}"

    @contextmanager
    def never_silent(self, interval_s: float = 1.0) -> Iterator[None]:
        """Say that the work goes on, for as long as the context lasts and nothing else speaks."""
        stream = self.stream
        if stream is None:
            yield
            return
        is_over = threading.Event()
        replaces = self.takes_bars
        longest = 0
        self.voice.heard(f"{self.title}beginning")

        def listen() -> None:
            nonlocal longest
            while not is_over.wait(interval_s):
                text = self.voice.wanted(stays=not replaces)
                if text and replaces:
                    longest = max(longest, len(text))
                    stream.write(f"\r{shown(text).ljust(longest)}")
                    stream.flush()
                elif text:
                    show(text, file=stream)

        thread = threading.Thread(target=listen, daemon=True)
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()
            if longest:
                stream.write(f"\r{' ' * longest}\r")


@contextmanager
def _ticking(bar: tqdm, voice: Voice, title: str) -> Iterator[None]:
    """Show each second how long a bar has run: one unit may take a minute."""
    is_over = threading.Event()
    voice.heard(title)

    def tick() -> None:
        while not is_over.wait(1.0):
            bar.refresh()
            voice.heard(title)

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
