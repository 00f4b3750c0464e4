"""How long a whole run still takes: by what is measured in it, and before by its photographs."""

import math
import os
import time
from collections.abc import Callable

COSTS = {"extract": 1.0, "match": 0.2, "verify": 0.08, "map": 0.7}
"""Of an image or a pair in a stage, in the time of an image in ``extract``: measured on runs
of 8 to 1000 photographs, good for a factor of 2."""
LOADING_CORE_S = 1.5
"""Until the first photograph is worked on: packages and files of weights;
measured there, 1.5 to 1.6 on six sets."""
MAP_CORE_S = 0.3
"""Of an image in ``map``, whatever its size; measured there, 0.1 to 0.7 on small sets."""
CORE_S_PER_MEGAPIXEL = 1.5
"""Of ``extract``, at the size of processing; measured there: 1.2 to 1.8 on five sets."""
LEARNED_COSTS = {"image": 1.25, "pair": 2.15}
"""Of learned matching, in the same unit: measured there, 0.5 to 1.7 times that on four sets."""
AFTER_FIRST_MODEL = ("escalate", "pictures")
"""Stages that follow the first model."""
AFTER_SHARE = 1.0
"""Of the time until the first model, the most that follows it beside learned matching; the effort
``normal``, as its definition has it (theory). Nothing follows a model that is sure of all: which
of both, only it can tell."""
FACTOR = 2.0  # that a forecast may be off; where it may be more, two are told; display
GOES_ON_SHARE = 0.5
"""Of the time that mapping took already: hypotheses after the last image; measured there."""
LIKELY_SHARE = 0.5  # of the time that all steps may still take: most help; measured
# Of a run of whose photographs nothing is known: before, it says too little; display
MIN_ELAPSED_S = 3.0
# Units after the first ones that tell how fast a stage is; display
MIN_NUM_MEASURED = 2
LONGEST_IN_SECONDS = 90.0  # that a forecast tells in seconds; display


class Forecast:
    """What is left of a whole run: measured where it has begun, learned from there for the rest."""

    def __init__(
        self,
        num_images: int,
        num_pairs: int,
        clock: Callable[[], float] = time.monotonic,
        *,
        num_learned_pairs: int = 0,
        more_may_follow: bool = True,
        megapixels: float = 0.0,
        num_cores: int = 1,
        is_new: bool = True,
    ) -> None:
        """Take what is ahead if all images are new.

        Args:
            num_images: photographs of the run.
            num_pairs: pairs that will be matched.
            clock: seconds from anywhere on.
            num_learned_pairs: pairs that learned matching takes if the first model needs it.
            more_may_follow: whether anything may follow the first model.
            megapixels: of all photographs at the size of processing, by which a run is forecast
                until something is measured; 0: it is not.
            num_cores: that work at once.
            is_new: whether nothing of the run is there already: else the first stage tells how
                much is left.
        """
        self._expected_unit_s = 0.0  # of a unit of cost, until something is measured
        if num_images:
            core_s = CORE_S_PER_MEGAPIXEL * megapixels
            self._expected_unit_s = core_s / num_images / max(1, num_cores)
        self._num_cores = max(1, num_cores)
        self._more_may_follow = more_may_follow
        self._is_new = is_new
        self._learned_cost = 0.0
        if num_learned_pairs:
            self._learned_cost = LEARNED_COSTS["image"] * num_images
            self._learned_cost += LEARNED_COSTS["pair"] * num_learned_pairs
        self._ahead = {
            "extract": COSTS["extract"] * num_images,
            "match": COSTS["match"] * num_pairs,
            "verify": COSTS["verify"] * num_pairs,
            "map": self._cost_of_map(num_images),
        }
        """Costs of the stages until the first model that have not begun."""
        self._clock = clock
        self._run_began_s = clock()
        self._work_began_s = clock()  # files and networks are loaded before
        self._stage = _RunningStage(0.0, 0, clock())
        self._name = ""  # of the stage
        self._is_first_model = True  # that is being made
        self._is_learned_matching = False  # that is at work
        self._done_cost = 0.0  # of the stages that have a cost and have ended
        self._done_s = 0.0  # that they took
        self._limit_s = 0.0  # of all that may follow the first model
        self._limit_told_s = clock()

    def _cost_of_map(self, num_images: int) -> float:
        """Return what mapping costs, in the time of an image in ``extract``.

        Adjustments grow with the model. What else an image takes does not hang on its size, which
        is known where a run is forecast by its megapixels.
        """
        adjusting = COSTS["map"] * (num_images**2 // 50)
        if not self._expected_unit_s:
            return COSTS["map"] * num_images + adjusting
        core_s = self._expected_unit_s * self._num_cores
        return MAP_CORE_S / core_s * num_images + adjusting

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
        self._is_learned_matching = False
        if is_after and self._is_first_model:
            self._is_first_model = False
            self._ahead.clear()
            if total and name != "pictures":
                self._is_learned_matching = bool(self._learned_cost)
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
        here_s = self._left_of_stage_s(now_s)
        if not self._is_first_model:
            return self._least_and_most_of_steps_s(here_s, now_s)
        if here_s is None:
            return None
        if not self._expected_unit_s and now_s - self._run_began_s < MIN_ELAPSED_S:
            return None
        pace = self._pace(now_s)
        least_s = here_s + pace * sum(self._ahead.values())
        if not self._more_may_follow:
            return least_s, least_s
        after_s = pace * self._learned_cost
        if not after_s:
            after_s = AFTER_SHARE * (now_s - self._work_began_s + least_s)
        return least_s, least_s + after_s

    def _least_and_most_of_steps_s(
        self, here_s: float | None, now_s: float
    ) -> tuple[float, float] | None:
        """Return the seconds that are left after the first model.

        Whether steps follow learned matching, only what it finds can tell.
        """
        if here_s is None and not self._limit_s:
            return None
        known_s = here_s or 0.0
        if self._is_learned_matching:
            return known_s, known_s + LIKELY_SHARE * self._limit_s
        passed_s = now_s - self._limit_told_s
        left_s = max(known_s, LIKELY_SHARE * (self._limit_s - passed_s))
        return left_s, left_s

    def _left_of_stage_s(self, now_s: float) -> float | None:
        """Return the seconds that are left of the stage; None while nobody knows."""
        if not self._name:
            return self._left_of_loading_s(now_s)
        here_s = self._stage.left_s(now_s)
        if here_s is None and self._stage.cost:
            here_s = self._left_by_cost_s(now_s)
        if here_s is None and self._stage.cost:
            here_s = self._expected_left_s(now_s)
        if here_s is not None and self._name == "map":
            here_s = max(here_s, self._left_of_map_s(now_s))
        return here_s

    def _left_of_loading_s(self, now_s: float) -> float | None:
        """Return how long it takes until the first stage begins; None where nobody knows."""
        if not self._expected_unit_s or not self._is_new:
            return None
        return max(0.0, LOADING_CORE_S - (now_s - self._run_began_s))

    def _expected_left_s(self, now_s: float) -> float | None:
        """Return how long a stage takes of which nothing is done; None where nobody knows."""
        if not self._expected_unit_s:
            return None
        elapsed_s = now_s - self._stage.began_s
        return max(0.0, self._expected_stage_s(elapsed_s) - elapsed_s)

    def _expected_stage_s(self, elapsed_s: float) -> float:
        """Return how long a stage takes: what cores work on has taken all of the time until now."""
        num_begun = min(os.cpu_count() or 1, self._stage.total)
        at_least_s = elapsed_s * self._stage.total / max(1, num_begun)
        return max(self._expected_unit_s * self._stage.cost, at_least_s)

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
        if cost:
            return seconds / cost
        if not self._stage.cost:
            return self._expected_unit_s
        elapsed_s = now_s - self._stage.began_s
        return self._expected_stage_s(elapsed_s) / self._stage.cost

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
