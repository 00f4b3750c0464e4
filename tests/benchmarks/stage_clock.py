"""Core seconds and work by stage of a program, taken from outside of it.

The seconds are those that cores work, so that other programs disturb them little; waiting for a
disk does not count. Named functions are replaced, for the time of a block, by ones that take the
time of each call without that of timed calls inside of it. So the stages add up to the whole. For
programs of one thread.
"""

from __future__ import annotations

import functools
import pkgutil
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock


@dataclass(frozen=True)
class Work:
    """What a stage cannot do without.

    Attributes:
        multiply_adds: multiplications with an addition.
        num_bytes: read from and written to memory.
    """

    multiply_adds: float = 0.0
    num_bytes: float = 0.0

    def __add__(self, other: Work) -> Work:
        """Add up."""
        return Work(self.multiply_adds + other.multiply_adds, self.num_bytes + other.num_bytes)


@dataclass(frozen=True)
class Timed:
    """A function that belongs to a stage.

    Attributes:
        stage: its name.
        target: the function where it is looked up when called, as ``package.module.name`` or
            ``package.module.Class.name``.
        work: from the result of a call and its arguments; not timed.
    """

    stage: str
    target: str
    work: Callable[..., Work] | None = None


class StageClock:
    """Adds up the seconds and the work of stages.

    Attributes:
        seconds: of cores, by stage, without the stages inside of it.
        work: by stage.
    """

    def __init__(self, now: Callable[[], float] = time.process_time) -> None:
        """Start with nothing; ``now`` returns seconds."""
        self.seconds: dict[str, float] = defaultdict(float)
        self.work: dict[str, Work] = defaultdict(Work)
        self._now = now
        self._seconds_inside = [0.0]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Take the time of a block."""
        start = self._now()
        self._seconds_inside.append(0.0)
        try:
            yield
        finally:
            elapsed = self._now() - start
            self.seconds[name] += elapsed - self._seconds_inside.pop()
            self._seconds_inside[-1] += elapsed

    @contextmanager
    def watching(self, functions: Iterable[Timed]) -> Iterator[None]:
        """Take the time of functions while the block runs.

        Raises:
            AttributeError: when there is no function of a name.
        """
        with ExitStack() as stack:
            for timed in functions:
                function = pkgutil.resolve_name(timed.target)
                stack.enter_context(mock.patch(timed.target, self._wrapped(function, timed)))
            yield

    def _wrapped(self, function: Callable[..., Any], timed: Timed) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*arguments: Any, **options: Any) -> Any:
            with self.stage(timed.stage):
                result = function(*arguments, **options)
            if timed.work:
                start = self._now()
                self.work[timed.stage] += timed.work(result, *arguments, **options)
                self._seconds_inside[-1] += self._now() - start
            return result

        return call
