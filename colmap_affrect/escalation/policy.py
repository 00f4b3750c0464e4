"""What is matched again next, and when to stop: the policy of escalation, without its execution.

1. Learned matching of whole photographs comes first, where its weights are there: it costs little
   and helps where light, age or season differ. On small sets all pairs of images to match again are
   matched by it, beside what is there (:mod:`colmap_affrect.escalation.alternatives`); on others as
   many as take what the first model took.
2. Afterwards the level and the pairs come that are likely to save most photographs per second
   (:mod:`colmap_affrect.escalation.expected_gain`), until the budget of the effort is spent, or
   nothing is likely to help.

All seconds are nominal, of one core: a run that is killed and goes on, or a busy machine, decides
as any other.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from colmap_affrect.escalation.expected_gain import (
    LEARNED,
    MAPPING_S,
    ExpectedGain,
    PairState,
    Step,
    gain_of,
    kind_of,
)
from colmap_affrect.options import EffortName
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.report import MatchedAgain
from colmap_affrect.recipes import Level

# Images up to which learned matching takes all pairs of images to match again
SMALL = 30
# Expected of all that the budget allows, below which nothing is tried
MIN_PHOTOGRAPHS = 0.2


@dataclass(frozen=True)
class Effort:
    """How long is tried, after learned matching; in seconds of one core."""

    least_s: float  # even if the first model took less
    times_first_model: float  # of what the first model took, where that is more
    without_model_s: float  # while nothing is registered

    def budget_s(self, first_model_s: float, *, has_model: bool) -> float:
        """Return the seconds of one core that levels after learned matching may take."""
        budget = max(self.least_s, self.times_first_model * first_model_s)
        return budget if has_model else max(budget, self.without_model_s)


EFFORTS: Mapping[EffortName, Effort] = {
    "low": Effort(0.0, 0.0, 0.0),
    "normal": Effort(120.0, 1.0, 900.0),
    "high": Effort(600.0, 5.0, 3600.0),
}


@dataclass(frozen=True)
class Situation:
    """What is known of a set of images, as escalation sees it."""

    levels: Sequence[Level]  # of the recipe, that of every image first
    usable: Sequence[int]  # numbers of the levels of escalation that may be tried
    states: Mapping[Pair, PairState]  # of all pairs
    weights: Mapping[str, float]  # of the images to match again, in photographs
    weakly_connected: Collection[
        str
    ]  # images with few features in tracks through three
    anchored: Collection[
        str
    ]  # images of the model that measured frames tie to a likely one
    megapixels: Sequence[Mapping[str, float]]  # of each image, by level
    lacking: Sequence[Collection[str]]  # images without features of a level, by level
    registered: Collection[str] = ()  # images of the largest model
    strong_num_inliers: int = 100  # pairs with as many need nothing more

    @property
    def is_small(self) -> bool:
        """Whether learned matching takes all pairs of images to match again."""
        return len(self.megapixels[0]) <= SMALL

    @property
    def learned_level(self) -> int | None:
        """Number of the level that matches whole photographs by networks, if it can be used."""
        kinds = ((number, kind_of(self.levels[number])) for number in self.usable)
        return next((number for number, kind in kinds if kind == LEARNED), None)

    def is_measured(self, number: int) -> bool:
        """Tell whether the frames of a level are measured one by one."""
        return self.levels[number].features.has_shapes

    def has_learned(self, state: PairState) -> bool:
        """Tell whether there are learned matches of a pair, used or beside those that are."""
        return state.learned_level >= 0 or not self.is_measured(state.level)

    @property
    def first_model_s(self) -> float:
        """Nominal seconds of all that comes before escalation."""
        sizes = self.megapixels[0]
        pairs = [(sizes[first], sizes[second]) for first, second in self.states]
        matching_s = gain_of(self.levels[0]).seconds(sizes.values(), pairs)
        return matching_s + MAPPING_S * len(sizes)

    def has_tried(self, state: PairState, number: int) -> bool:
        """Tell whether a pair was matched at a level, also if the matches are not used."""
        return bool(state.tried >> number & 1) or state.learned_level == number

    def spent_on(self, number: int) -> float:
        """Return the nominal seconds that a level has taken so far."""
        sizes = self.megapixels[number]
        tried = [
            pair for pair, state in self.states.items() if self.has_tried(state, number)
        ]
        images = [sizes[name] for name in {name for pair in tried for name in pair}]
        pairs = [(sizes[first], sizes[second]) for first, second in tried]
        return gain_of(self.levels[number]).seconds(images, pairs)

    def spent_s(self) -> float:
        """Return the nominal seconds spent after learned matching, of which some is free."""
        spent = {number: self.spent_on(number) for number in range(1, len(self.levels))}
        learned_s = sum(
            s for k, s in spent.items() if kind_of(self.levels[k]) == LEARNED
        )
        free_s = learned_s if self.is_small else min(learned_s, self.first_model_s)
        return sum(spent.values()) - free_s

    def gain(self, number: int, weights: Mapping[str, float]) -> ExpectedGain:
        """Return what a level may bring to images to match again."""
        return ExpectedGain(
            self.states,
            set(self.weakly_connected),
            weights,
            self.megapixels[number],
            [k for k in range(len(self.levels)) if not self.is_measured(k)],
            self.lacking[number],
            self.registered,
            self.strong_num_inliers,
        )

    def needless_after(self, number: int) -> int:
        """Return bits of the levels that make one needless: it and later ones of its kind."""
        kind = self.is_measured(number)
        later = range(number, len(self.levels))
        return sum(1 << k for k in later if self.is_measured(k) == kind)

    def best_at(self, number: int, budget_s: float) -> Step:
        """Return the best step of a level within a budget."""
        weights = dict(self.weights)
        if not self.is_measured(number):
            # Features without shapes mistake similar things for the same: images that others anchor
            # do not need them.
            for name in self.anchored:
                weights.pop(name, None)
        gain = self.gain(number, weights)
        return gain.best_step(
            number, self.levels[number], self.needless_after(number), budget_s
        )


def learned_step(situation: Situation) -> Step:
    """Return the pairs for learned matching.

    Of a small set all of images to match again, and the others, too, where they take no longer
    than the first model: models of learned matches alone need them. Of a larger set as many as
    take what the first model took, the most promising ones.
    """
    number = situation.learned_level
    if number is None or not situation.weights:
        return Step()
    if not situation.is_small:
        left_s = situation.first_model_s - situation.spent_on(number)
        return situation.best_at(number, left_s)
    lacking = [
        p for p, state in situation.states.items() if not situation.has_learned(state)
    ]
    needed = [pair for pair in lacking if not situation.weights.keys().isdisjoint(pair)]
    sizes = situation.megapixels[number]
    others = [(sizes[a], sizes[b]) for a, b in lacking if (a, b) not in needed]
    others_s = gain_of(situation.levels[number]).seconds((), others)
    is_cheap = others_s <= situation.first_model_s
    return Step(number, lacking if needed and is_cheap else needed)


def is_hopeful(step: Step, situation: Situation) -> bool:
    """Tell whether a level is worth a try; while nothing is registered, each is."""
    if not step.pairs:
        return False
    return step.all_photographs >= MIN_PHOTOGRAPHS or not situation.registered


@dataclass(frozen=True)
class Plan:
    """What comes next, and how long all of it may take."""

    step: Step = field(default_factory=Step)
    left_s: float = 0.0  # of one core, at most


def next_step(situation: Situation, effort: EffortName) -> Plan:
    """Return what is matched again now; a step without pairs where nothing is likely to help.

    Args:
        situation: what is known of the set.
        effort: how long is tried.

    Returns:
        The step, and at most how long it and those after it take, in seconds of one core.
    """
    if not situation.weights:
        return Plan()
    budget = EFFORTS[effort].budget_s(
        situation.first_model_s, has_model=bool(situation.registered)
    )
    left_s = budget - situation.spent_s()
    if not situation.is_small:
        learned = learned_step(situation)
        if learned.pairs:
            return Plan(learned, max(0.0, left_s) + situation.first_model_s)
    steps = [situation.best_at(number, left_s) for number in situation.usable]
    hopeful = [step for step in steps if is_hopeful(step, situation)]
    if not hopeful:
        return Plan()
    all_s = sum(step.all_seconds for step in hopeful)
    return Plan(max(hopeful, key=lambda step: step.rate), min(left_s, all_s))


def tried(situation: Situation) -> list[MatchedAgain]:
    """Return for how many pairs each level of escalation was tried."""
    found = list[MatchedAgain]()
    for number in range(1, len(situation.levels)):
        states = situation.states.items()
        pairs = [pair for pair, state in states if situation.has_tried(state, number)]
        if pairs:
            kind = kind_of(situation.levels[number])
            found.append(MatchedAgain(kind, len(pairs), situation.spent_on(number)))
    return found


def untried(situation: Situation) -> list[MatchedAgain]:
    """Return what a greater effort would try for images to match again, by level."""
    found = list[MatchedAgain]()
    for number in situation.usable:
        if situation.is_small and number == situation.learned_level:
            continue  # it was tried beside the others
        step = situation.best_at(number, math.inf)
        if is_hopeful(step, situation):
            kind = kind_of(situation.levels[number])
            found.append(MatchedAgain(kind, step.num_pairs, step.all_seconds))
    return found
