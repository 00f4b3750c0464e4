"""Progress of long stages: a tqdm bar, lines or silence; and how long a whole run still takes."""

import math
import os
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
NUM_PLAIN_LINES = 10  # display
COSTS = {"extract": 1.0, "match": 0.2, "verify": 0.08, "map": 0.7}
"""Of an image or a pair in a stage, in the time of an image in ``extract``: measured on runs
of 8 to 1000 photographs, good for a factor of 2."""
LEARNED_COSTS = {"image": 1.0, "pair": 1.75}
"""Of learned matching, in the same unit: as ``expected_gain.json`` has them, measured there."""
AFTER_FIRST_MODEL = ("escalate", "pictures")
"""Stages that follow the first model."""
AFTER_SHARE = 1.0
"""Of the time until the first model, the most that follows it beside learned matching; the effort
``normal``, as its definition has it (theory). Nothing follows a model that is sure of all: which
of both, only it can tell."""
FACTOR = 2.0  # that a forecast may be off; where it may be more, two are told; display
GOES_ON_SHARE = 0.5
"""Of the time that mapping took already: hypotheses after the last image; measured there."""
LIKELY_SHARE = 0.5  # of the time that all steps may take at most: most help; measured
# Of a run: before, it has loaded files and networks, and says too little; display
MIN_ELAPSED_S = 3.0
# Units after the first ones that tell how fast a stage is; display
MIN_NUM_MEASURED = 2
LONGEST_IN_SECONDS = 90.0  # that a forecast tells in seconds; display


# Of silence, until something says that the work goes on (display): with the start of Python and
# the second between two looks less than 5; where lines stay, as in a log,
# twice as long after each of them, up to the longest
QUIET_S = 4.0
LONGEST_QUIET_S = 60.0  # Display


class Voice:
    """When something was shown last, and about what: one for all stages of a command."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.doing = "beginning"
        self.is_listened_to = False  # something speaks where nothing else does
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
    """What is left of a whole run: measured where it has begun, learned from there for the rest."""

    def __init__(
        self,
        num_images: int,
        num_pairs: int,
        clock: Callable[[], float] = time.monotonic,
        *,
        num_learned_pairs: int = 0,
        goes_on: bool = True,
    ) -> None:
        """Take what is ahead if all images are new.

        Args:
            num_images: photographs of the run.
            num_pairs: pairs that will be matched.
            clock: seconds from anywhere on.
            num_learned_pairs: pairs that learned matching takes if the first model needs it.
            goes_on: whether anything may follow the first model.
        """
        self._goes_on = goes_on
        self._learned_cost = 0.0
        if num_learned_pairs:
            self._learned_cost = LEARNED_COSTS["image"] * num_images
            self._learned_cost += LEARNED_COSTS["pair"] * num_learned_pairs
        self._ahead = {
            "extract": COSTS["extract"] * num_images,
            "match": COSTS["match"] * num_pairs,
            "verify": COSTS["verify"] * num_pairs,
            # Adjustments grow with the model.
            "map": COSTS["map"] * (num_images + num_images**2 // 50),
        }
        """Costs of the stages until the first model that have not begun."""
        self._clock = clock
        self._run_began_s = clock()
        self._work_began_s = clock()  # files and networks are loaded before
        self._stage = _RunningStage(0.0, 0, clock())
        self._name = ""  # of the stage
        self._is_first_model = True  # that is being made
        self._done_cost = 0.0  # of the stages that have a cost and have ended
        self._done_s = 0.0  # that they took
        self._limit_s = 0.0  # of all that may follow the first model
        self._limit_told_s = clock()

    def begin(self, name: str, total: int, part: str = "") -> None:
        """Take note that a stage begins.

        Args:
            name: of the stage.
            total: images or pairs that it will work on.
            part: what is done in it now; empty where that is all of it.
        """
        self._end_stage()
        self._name = name
        if name == "extract":
            self._work_began_s = self._clock()
        known = 0.0 if part else self._ahead.pop(name, 0.0)
        unit_cost = COSTS.get(name, 0.0)
        if name == "map":
            unit_cost = known / max(total, 1)
        self._stage = _RunningStage(unit_cost * total, total, self._clock())
        is_after = name in AFTER_FIRST_MODEL
        if is_after and self._is_first_model:
            self._is_first_model = False
            self._ahead.clear()
            if total and name != "pictures":
                self._stage = _RunningStage(self._learned_cost, total, self._clock())

    def advance(self, num_done: int) -> None:
        """Take note of how many units of the stage are done."""
        self._stage.advance(num_done, self._clock())

    def expect(self, seconds: float) -> None:
        """Take note of how long all that follows may take at most, where nothing helps."""
        self._limit_s = seconds
        self._limit_told_s = self._clock()

    def left_s(self) -> float | None:
        """Return the seconds that are left of the run; None while too little is measured.

        Where it is open what follows the first model this is between the least and the most, as
        many times the one as the other is times it.
        """
        ends_s = self.least_and_most_s()
        return math.sqrt(ends_s[0] * ends_s[1]) if ends_s else None

    def least_and_most_s(self) -> tuple[float, float] | None:
        """Return the seconds that are left if nothing follows the first model, and if all does."""
        now_s = self._clock()
        here_s = self._stage.left_s(now_s)
        if here_s is None and self._stage.cost:
            here_s = self._left_by_cost_s(now_s)
        if here_s is None or now_s - self._run_began_s < MIN_ELAPSED_S:
            return None
        if self._name == "map":
            here_s = max(here_s, self._left_of_map_s(now_s))
        if not self._is_first_model:
            passed_s = now_s - self._limit_told_s
            left_s = max(here_s, LIKELY_SHARE * self._limit_s - passed_s)
            return left_s, left_s
        pace = self._pace(now_s)
        least_s = here_s + pace * sum(self._ahead.values())
        if not self._goes_on:
            return least_s, least_s
        after_s = pace * self._learned_cost
        if not after_s:
            after_s = AFTER_SHARE * (now_s - self._work_began_s + least_s)
        return least_s, least_s + after_s

    def _left_of_map_s(self, now_s: float) -> float:
        """Return how long mapping takes by what it costs, and by what it has taken."""
        elapsed_s = now_s - self._stage.began_s
        return max(self._left_by_cost_s(now_s) or 0.0, GOES_ON_SHARE * elapsed_s)

    def _left_by_cost_s(self, now_s: float) -> float | None:
        """Return how long the stage takes by its cost; None before the end of another one."""
        if not self._done_cost:
            return None
        elapsed_s = now_s - self._stage.began_s
        pace = self._done_s / self._done_cost
        return max(0.0, pace * self._stage.cost - elapsed_s)

    def text(self) -> str:
        """Say how long the run still takes; empty while too little is measured."""
        ends_s = self.least_and_most_s()
        if ends_s is None:
            return ""
        least_s, most_s = ends_s
        if most_s <= FACTOR * least_s:
            return f"about {_duration(math.sqrt(least_s * most_s))} left in all"
        return f"{_duration(least_s)} to {_duration(most_s)} left in all"

    def _pace(self, now_s: float) -> float:
        """Return the seconds of a unit of cost, measured in this stage and those before."""
        cost = self._done_cost + self._stage.done_cost
        seconds = self._done_s
        if self._stage.cost:
            seconds += now_s - self._stage.began_s
        return seconds / cost if cost else 0.0

    def _end_stage(self) -> None:
        """Learn from the stage that has ended."""
        if self._stage.done_cost:
            self._done_cost += self._stage.done_cost
            self._done_s += self._clock() - self._stage.began_s


class _RunningStage:
    """A stage that runs, and how fast."""

    def __init__(self, cost: float, total: int, began_s: float) -> None:
        self.cost = cost  # of all its units; 0 where it is not known
        self.total = total
        self.began_s = began_s
        self._num_done = 0
        self._first_s = began_s  # when its first units were done
        self._num_first = 0

    @property
    def done_cost(self) -> float:
        """Of the units that are done, and of half of those that cores work on."""
        num = self._num_done + self._num_begun
        return self.cost * num / self.total if self._num_done else 0.0

    @property
    def _num_begun(self) -> float:
        """Units that cores work on, each as half of one."""
        return min(os.cpu_count() or 1, self.total - self._num_done) / 2

    def advance(self, num_done: int, now_s: float) -> None:
        """Take note of how many units are done."""
        if not self._num_done:
            self._first_s = now_s
            self._num_first = num_done
        self._num_done = num_done

    def left_s(self, now_s: float) -> float | None:
        """Return how long the other units take; None while none is done.

        The first units wait for files and networks that are loaded, and do not count once there
        are more. Before, what cores work on meanwhile counts as half done.
        """
        if not self._num_done:
            return None
        num_left = self.total - self._num_done
        num_measured = self._num_done - self._num_first
        if num_measured >= MIN_NUM_MEASURED:
            return (now_s - self._first_s) / num_measured * num_left
        pace = (now_s - self.began_s) / (self._num_done + self._num_begun)
        return pace * (num_left - self._num_begun)


def _duration(seconds: float) -> str:
    """Return a duration in few words, as exactly as a forecast is."""
    if seconds < LONGEST_IN_SECONDS:
        return f"{max(math.ceil(seconds / 10), 1) * 10} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


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
        bar = tqdm(total=total, desc=title, unit=unit, file=self.stream)

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
        self, doing: str = "beginning", interval_s: float = 1.0
    ) -> Iterator[None]:
        """Say that the work goes on, for as long as the context lasts and nothing else speaks.

        Args:
            doing: what is done, until a stage begins; inside of another such context that one's.
            interval_s: how often to see whether something was said, seconds.
        """
        stream = self.stream
        voice = self.voice
        if stream is None or voice.is_listened_to:
            yield
            return
        is_over = threading.Event()
        replaces = self.takes_bars
        voice.heard(f"{self.title}{doing}")
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
