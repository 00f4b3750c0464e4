"""How long a whole run takes, roughly: from what its first images and pairs have taken."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

logger = logging.getLogger(__name__)

COSTS = {"extract": 1.0, "match": 0.25, "match by network": 0.7, "verify": 0.15, "map": 0.7}
"""What one unit of a stage takes in the time that one image takes in ``extract``, of a stage that
has not begun. With them what is left after ``extract`` was forecast within a factor of 2 in ten
runs on 8 to 16 photographs and in one on a thousand."""

MAP_COST_PER_IMAGE = 0.015  # that each image adds to the cost of mapping one: adjustments grow
MIN_DONE, MIN_ELAPSED_S = 5, 3.0
"""Less of a stage says too little of the rest: the first unit waits for what has to be loaded."""


@dataclass
class _Stage:
    cost: float
    ahead: int
    done: int = 0
    elapsed_s: float = 0.0
    is_logged: bool = False  # that the run takes long

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
        if name == "extract":
            share_old = 1 - total / max(known.ahead, total, 1)
            self._expect_pairs(round(self._stages["match"].ahead * (1 - share_old**2)))
        if name == "match":
            self._expect_pairs(total)
        self._stages[name] = _Stage(known.cost, total)
        self._may_escalate &= name not in ("cameras", "guide", "map")
        self._current, self._start_s = name, self._clock()

    def _expect_pairs(self, count: int) -> None:
        for name in ("match", "verify"):
            self._stages[name].ahead = count

    def advance(self, count: int) -> str:
        """So many units of the stage that began last are done; return and log :meth:`text`."""
        stage = self._stages[self._current]
        stage.done += count
        stage.ahead = max(stage.ahead - count, 0)
        stage.elapsed_s = self._clock() - self._start_s
        text = self.text()
        if text and not stage.is_logged:
            stage.is_logged = True
            logger.info("%s", text)
        return text

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
        left_s = self.left_s() or 0.0
        if left_s < 60 or not self._stages["map"].ahead or self._current == "map":
            return ""
        but = " without further warps" if self._may_escalate else ""
        return f"whole run: {duration_text(left_s)} left{but}"


def duration_text(seconds: float) -> str:
    """Write a duration as roughly as it is known.

    >>> [duration_text(seconds) for seconds in (110, 1500, 9000)]
    ['about 2 min', 'about 25 min', 'about 2.5 h']
    """
    minutes = seconds / 60
    if minutes < 90:
        return f"about {minutes:.0f} min"
    return f"about {minutes / 60:.1f} h"
