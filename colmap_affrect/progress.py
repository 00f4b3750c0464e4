"""Progress of long stages: a tqdm bar, lines or silence."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TextIO

from tqdm import tqdm

from colmap_affrect.errors import OptionError, shown
from colmap_affrect.forecast import Forecast

Advance = Callable[[int], None]  # report that so many more units are done
NUM_PLAIN_LINES = 10  # display
# Of silence, until something says that the work goes on (display): with the start of Python and
# the second between two looks less than 5
QUIET_S = 4.0
USUAL_SIZE = (80, 24)  # columns and rows of a terminal; display


class Voice:
    """When something was shown last, and about what: one for all stages of a command."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = "beginning"
        self.is_listened_to = False  # something speaks where nothing else does
        self.forecast: Forecast | None = None  # of the run that is at work
        self._clock = clock
        self._heard_s = clock()  # when something was shown last
        self._since_s = (
            self._heard_s
        )  # when what is done last showed something of its own
        self._quiet_s = QUIET_S

    def heard(self, doing: str, ago_s: float = 0.0) -> None:
        """Something was shown, or a person began to wait.

        Args:
            doing: what is done.
            ago_s: seconds since then.
        """
        self.doing = doing
        self._heard_s = self._clock() - ago_s
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
        # A line that is replaced counts the seconds
        self._quiet_s = QUIET_S if stays else 1.0
        text = f"{self.doing}: at work for {now_s - self._since_s:.0f} s"
        left = self.forecast.text() if self.forecast else ""
        return f"{text}, {left}" if left else text


@dataclass(eq=False)
class Progress:
    """Where progress goes, and how it is shown: a bar on a terminal or in a notebook, else lines.

    Attributes:
        stream: where it is written to, as ``sys.stderr``; None is silence.
        num_plain_lines: most lines of a stage, where the stream takes no bars.
        title: with which the names of stages begin.
        forecast: says how long all stages still take.
        voice: knows when something was shown last.
    """

    stream: TextIO | None = None
    num_plain_lines: int = NUM_PLAIN_LINES
    title: str = ""
    forecast: Forecast | None = None
    voice: Voice = field(default_factory=Voice)

    def __post_init__(self) -> None:
        if self.stream is not None and not hasattr(self.stream, "write"):
            raise OptionError(
                "give None or a stream, as sys.stderr", where=f"stream={self.stream!r}"
            )

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
            raise OptionError(
                "give True, False or a Progress", where=f"progress={progress!r}"
            )
        shown = cls(sys.stderr)
        is_wanted = shown.takes_bars if progress is None else progress
        return shown if is_wanted else SILENT

    def with_forecast(self, forecast: Forecast) -> "Progress":
        """Return the same progress that says how long all stages still take."""
        self.voice.forecast = forecast
        return replace(self, forecast=forecast)

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
    def stage(
        self, name: str, total: int, unit: str, part: str = ""
    ) -> Iterator[Advance]:
        """Show one stage for as long as the context lasts.

        Args:
            name: of the stage.
            total: how many units there are to be done.
            unit: what is counted, such as ``images``.
            part: what is done in this stage now; empty where that is all of it.

        Yields:
            A function that is called with the number of units that were done since.
        """
        if self.forecast:
            self.forecast.begin(name, total, part)
        name = f"{name}, {part}" if part else name
        if self.stream is None or total == 0:
            yield lambda _: None
        elif self.takes_bars:
            yield from self._bar(name, total, unit)
            self.voice.heard(f"after {self.title}{name}")
        else:
            self.voice.doing = self.title + name
            yield from self._lines(name, total, unit)
            self.voice.doing = f"after {self.title}{name}"

    def _bar(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show a stage as a bar; yield what is called with the number of units done."""
        title = self.title + name
        columns, rows = self._size() or (None, None)
        bar = tqdm(
            total=total,
            desc=title,
            unit=unit,
            file=self.stream,
            ncols=columns,
            nrows=rows,
        )

        def advance(count: int) -> None:
            if self.forecast:
                self.forecast.advance(bar.n + count)
            show_forecast()
            bar.update(count)

        def show_forecast() -> None:
            text = self.forecast.text() if self.forecast else ""
            bar.set_postfix_str(text, refresh=False)

        with bar, _refresh_each_second(bar, self.voice, title, show_forecast):
            yield advance

    def _size(self) -> tuple[int, int] | None:
        """Return columns and rows where a terminal says 0, as in containers; None elsewhere."""
        try:
            columns = os.get_terminal_size(self.file_number).columns
        except OSError:  # a notebook
            return None
        return None if columns else USUAL_SIZE

    def _lines(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        """Show a stage as lines; yield what is called with the number of units done."""
        num_done = 0
        num_lines = 0

        def print_line(text: str) -> None:
            counts = f"{self.title}{name}: {num_done}/{total} {unit}"
            more = f", {text}" if text else ""
            show(counts + more, file=self.stream)
            self.voice.heard(counts)

        def advance(count: int) -> None:
            nonlocal num_done, num_lines
            num_done += count
            text = self._remaining_text(num_done)
            num_wanted = num_done * self.num_plain_lines // total
            if num_wanted > num_lines:
                num_lines = num_wanted
                print_line(text)

        yield advance
        if not num_lines:
            print_line("")

    def expect(self, seconds: float) -> None:
        """Tell the forecast how long all that follows may take at most."""
        if self.forecast:
            self.forecast.expect(seconds)

    def _remaining_text(self, num_done: int) -> str:
        """Say how long the run still takes, where that is known."""
        if not self.forecast:
            return ""
        self.forecast.advance(num_done)
        return self.forecast.text()

    @contextmanager
    def never_silent(
        self, doing: str = "beginning", interval_s: float = 1.0, waited_s: float = 0.0
    ) -> Iterator[None]:
        """Say that the work goes on, for as long as the context lasts and nothing else speaks.

        Args:
            doing: what is done, until a stage begins; inside of another such context that one's.
            interval_s: how often to see whether something was said, seconds.
            waited_s: how long a person has waited already.
        """
        stream = self.stream
        voice = self.voice
        if stream is None or voice.is_listened_to:
            yield
            return
        is_over = threading.Event()
        replaces = self.takes_bars
        voice.heard(f"{self.title}{doing}", waited_s)
        voice.is_listened_to = True

        def listen() -> None:
            """Speak where nothing else does."""
            while not is_over.wait(interval_s):
                text = voice.wanted(stays=not replaces)
                if text and replaces:
                    _AT_WORK.show(text, stream)
                elif text:
                    show(text, file=stream)

        try:
            with _in_background(listen, is_over):
                yield
        finally:
            voice.is_listened_to = False
            _AT_WORK.wipe()


class _ReplacedLine:
    """The line of a terminal that says what is at work, until something else is printed."""

    def __init__(self) -> None:
        """Begin with nothing shown."""
        self._stream: TextIO | None = None
        self._longest = 0  # characters that were shown and are not wiped
        self._lock = threading.Lock()

    def show(self, text: str, stream: TextIO) -> None:
        """Put a text in the place of the one before."""
        with self._lock:
            self._stream = stream
            self._longest = max(self._longest, len(text))
            stream.write(f"\r{shown(text).ljust(self._longest)}")
            stream.flush()

    def wipe(self) -> None:
        """Take away what is shown."""
        with self._lock:
            if self._stream and self._longest:
                self._stream.write(f"\r{' ' * self._longest}\r")
                self._stream.flush()
            self._longest = 0


_AT_WORK = _ReplacedLine()


@contextmanager
def _refresh_each_second(
    bar: tqdm, voice: Voice, title: str, update: Callable[[], None]
) -> Iterator[None]:
    """Show each second how long a bar has run: one unit may take a minute."""
    is_over = threading.Event()
    voice.heard(title)

    def tick() -> None:
        while not is_over.wait(1.0):
            update()
            bar.refresh()
            voice.heard(title)

    with _in_background(tick, is_over):
        yield


@contextmanager
def _in_background(
    work: Callable[[], None], is_over: threading.Event
) -> Iterator[None]:
    """Have another thread work for as long as the context lasts, until an event tells it to end."""
    thread = threading.Thread(target=work, daemon=True)
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
    """Print what people or programs read; see :mod:`colmap_affrect.errors`.

    Args:
        text: anything; characters that do not print are escaped.
        file: where to; None: standard output.
        end: what follows the text.
    """
    _AT_WORK.wipe()
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
            before_s = self.seconds.get(name, 0.0)
            self.seconds[name] = before_s + time.perf_counter() - start
