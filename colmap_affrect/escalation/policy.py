"""What is matched again next, and when to stop: the policy of escalation, without its execution.

1. Learned matching of whole photographs comes first, where its weights are there: it helps where
   light, age or season differ. On small sets it matches the pairs of images that may gain what the
   time of their pairs is worth, beside what is there
   (:mod:`colmap_affrect.escalation.alternatives`): the verified ones first, and the others unless
   it ties the verified ones no better. On other sets as many pairs are matched as take what the
   first model took.
2. Afterwards the level and the pairs come that are likely to save most photographs per second
   (:mod:`colmap_affrect.escalation.expected_gain`), until the budget of the effort is spent, or
   nothing is likely to help. Levels that were in vain are given up, except with high effort.

Mapping after each step counts as time spent.

All seconds are nominal, of one core: a run that is killed and goes on, or a busy machine, decides
as any other.
"""

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from colmap_affrect.escalation.expected_gain import (
    LEARNED,
    MAPPING_S,
    PairState,
    Step,
    StepPlanner,
    kind_of,
    statistics_of,
)
from colmap_affrect.forecast import Forecast
from colmap_affrect.options import EffortName
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.report import MatchedAgain
from colmap_affrect.recipes import Level

# Images up to which learned matching may take all pairs of images to match again; resource: these
# are 435 pairs, some minutes of two cores
SMALL = 30
# Photographs expected of all that the budget allows, below which nothing is tried; judged on the
# same sets, by where photographs right against seconds are flat
MIN_PHOTOGRAPHS = 0.2


@dataclass(frozen=True)
class Effort:
    """How long is tried, after learned matching; in seconds of one core.

    Attributes:
        least_s: even if the first model took less.
        times_first_model: of what the first model took, where that is more.
        without_model_s: while nothing is registered.
        gives_up: levels that were in vain, and all that costs while models have become worse.
    """

    least_s: float
    times_first_model: float
    without_model_s: float
    gives_up: bool = True

    @property
    def ends_after_learned_matching(self) -> bool:
        """Whether no level may take any time after learned matching."""
        return not (self.least_s or self.times_first_model or self.without_model_s)

    def budget_s(self, first_model_s: float, *, has_model: bool) -> float:
        """Return what levels after learned matching may take.

        Args:
            first_model_s: what the first model took, seconds of one core.
            has_model: whether images are registered.

        Returns:
            Seconds of one core.
        """
        budget = max(self.least_s, self.times_first_model * first_model_s)
        return budget if has_model else max(budget, self.without_model_s)


# Seconds of one core; judged by photographs right against seconds (tests/benchmarks/effort.py)
EFFORTS: Mapping[EffortName, Effort] = {
    "low": Effort(least_s=0.0, times_first_model=0.0, without_model_s=0.0),
    "normal": Effort(least_s=120.0, times_first_model=1.0, without_model_s=900.0),
    "high": Effort(
        least_s=600.0, times_first_model=5.0, without_model_s=3600.0, gives_up=False
    ),
}


# Photographs that a second must bring at least: as many as one of the whole budget
PHOTOGRAPHS_PER_S = MIN_PHOTOGRAPHS / EFFORTS["normal"].least_s


def learned_level_of(levels: Sequence[Level], usable: Iterable[int]) -> int | None:
    """Return the number of the level that matches whole photographs by networks.

    Args:
        levels: of the recipe.
        usable: numbers of the levels of escalation that may be tried.

    Returns:
        The number; None where no such level can be used.
    """
    for number in usable:
        if kind_of(levels[number]) == LEARNED:
            return number
    return None


@dataclass(frozen=True)
class Situation:
    """What is known of a set of images, as escalation sees it.

    Attributes:
        levels: of the recipe, that of every image first.
        usable: numbers of the levels of escalation that may be tried.
        states: of all pairs.
        weights: of the images to match again, in photographs.
        gains: what matches may bring to each of these, not less where an image is likely right.
        weakly_connected: images with few features in tracks through three.
        anchored: images of the model that measured frames connect to a likely one.
        megapixels: of each image, by level.
        lacking: images without features of a level, by level.
        registered: images of the largest model.
        strong_num_inliers: pairs with as many inliers need nothing more.
        rounds: levels of the steps that mapping follows.
    """

    levels: Sequence[Level]
    usable: Sequence[int]
    states: Mapping[Pair, PairState]
    weights: Mapping[str, float]
    gains: Mapping[str, float]
    weakly_connected: Collection[str]
    anchored: Collection[str]
    megapixels: Sequence[Mapping[str, float]]
    lacking: Sequence[Collection[str]]
    registered: Collection[str] = ()
    strong_num_inliers: int = 100
    rounds: Sequence[int] = ()

    @property
    def is_small(self) -> bool:
        """Whether learned matching may take all pairs of images to match again."""
        return len(self.megapixels[0]) <= SMALL

    @property
    def learned_level(self) -> int | None:
        """Number of the level that matches whole photographs by networks, if it can be used."""
        return learned_level_of(self.levels, self.usable)

    def is_measured(self, number: int) -> bool:
        """Tell whether the frames of a level are measured one by one."""
        return self.levels[number].features.has_shapes

    def pairs_without_learned_matches(self) -> list[Pair]:
        """Return the pairs without learned matches, used or beside those that are."""
        pairs = list[Pair]()
        for pair, state in self.states.items():
            if state.learned_level < 0 and self.is_measured(state.level):
                pairs.append(pair)
        return pairs

    def images_worth_learned_matching(self, number: int) -> set[str]:
        """Return the images to match again that gain what the time of their pairs is worth.

        Args:
            number: of the level that matches by networks.
        """
        pairs_of = defaultdict[str, list[Pair]](list)
        for pair in self.pairs_without_learned_matches():
            for name in pair:
                pairs_of[name].append(pair)
        images = set[str]()
        for name, gain in self.gains.items():
            if gain >= PHOTOGRAPHS_PER_S * self.seconds(number, (), pairs_of[name]):
                images.add(name)
        return images

    def seconds(
        self, number: int, names: Collection[str], pairs: Collection[Pair]
    ) -> float:
        """Return what features of images, and matching of pairs, take at a level.

        Args:
            number: of the level in the recipe.
            names: images that get features.
            pairs: pairs that are matched.

        Returns:
            Nominal seconds of one core.
        """
        sizes = self.megapixels[number]
        image_sizes = [sizes[name] for name in names]
        pair_sizes = [(sizes[first], sizes[second]) for first, second in pairs]
        return statistics_of(self.levels[number]).seconds(image_sizes, pair_sizes)

    def is_in_vain(self, number: int) -> bool:
        """Tell whether a level was tried for a small set, and not one pair uses its matches.

        These were worse, or models with them were, which have been gone back from. While nothing is
        registered, nothing is known of that. The pairs that promised most were tried first.
        """
        has_been_tried = False
        for state in self.states.values():
            if state.level == number:
                return False
            has_been_tried |= bool(state.tried >> number & 1)
        return has_been_tried and self.is_small and bool(self.registered)

    def costs_nothing(self, number: int) -> bool:
        """Tell whether the matches of a level are there for all pairs of the set, used or not."""
        has_all = not self.pairs_without_learned_matches()
        return number == self.learned_level and has_all

    def levels_worth_trying(self, *, may_cost: bool) -> list[int]:
        """Return the usable levels that cost nothing, or may cost and were not in vain."""
        found = list[int]()
        for number in self.usable:
            may_help = may_cost and not self.is_in_vain(number)
            if may_help or self.costs_nothing(number):
                found.append(number)
        return found

    @property
    def first_model_s(self) -> float:
        """Nominal seconds of all that comes before escalation."""
        names = self.megapixels[0].keys()
        return self.seconds(0, names, self.states.keys()) + self.mapping_s

    @property
    def mapping_s(self) -> float:
        """Nominal seconds of mapping once."""
        return MAPPING_S * len(self.megapixels[0])

    def pairs_tried(self, number: int) -> list[Pair]:
        """Return the pairs that were matched at a level, also if the matches are not used."""
        pairs = list[Pair]()
        for pair, state in self.states.items():
            if state.tried >> number & 1 or state.learned_level == number:
                pairs.append(pair)
        return pairs

    def seconds_spent_at(self, number: int) -> float:
        """Return the nominal seconds that a level has taken so far."""
        pairs = self.pairs_tried(number)
        names = set[str]()
        for pair in pairs:
            names.update(pair)
        return self.seconds(number, names, pairs)

    def seconds_mapped_after(self, number: int) -> float:
        """Return the nominal seconds of mapping that followed steps of a level."""
        return self.rounds.count(number) * self.mapping_s

    def seconds_spent(self) -> float:
        """Return the nominal seconds that escalation has taken, but for learned matching.

        Mapping after steps counts: on sets of some size it takes as long as these. Of sets that
        are not small, mapping after steps of learned matching is part of that, and of both only as
        much is left out as the first model took.
        """
        spent_s = 0.0
        learned_s = 0.0
        for number in range(1, len(self.levels)):
            matched_s = self.seconds_spent_at(number)
            mapped_s = self.seconds_mapped_after(number)
            spent_s += matched_s + mapped_s
            if kind_of(self.levels[number]) == LEARNED:
                learned_s += matched_s if self.is_small else matched_s + mapped_s
        if not self.is_small:
            learned_s = min(learned_s, self.first_model_s)
        return spent_s - learned_s

    def planner(self, number: int, weights: Mapping[str, float]) -> StepPlanner:
        """Return what chooses the pairs of a level.

        Args:
            number: of the level in the recipe.
            weights: of the images that it may help, in photographs.

        Returns:
            A planner with all pairs as they are now.
        """
        numbers = range(len(self.levels))
        return StepPlanner(
            states=self.states,
            weakly_connected=set(self.weakly_connected),
            weights=weights,
            megapixels=self.megapixels[number],
            unmeasured=[k for k in numbers if not self.is_measured(k)],
            lacking=self.lacking[number],
            registered=self.registered,
            strong_num_inliers=self.strong_num_inliers,
        )

    def needless_after(self, number: int) -> int:
        """Return bits of the levels that make one needless: it and later ones of its kind."""
        bits = 0
        for later in range(number, len(self.levels)):
            if self.is_measured(later) == self.is_measured(number):
                bits |= 1 << later
        return bits

    def best_step(self, number: int, budget_s: float) -> Step:
        """Return the best step of a level.

        Features without shapes mistake similar things for the same: images that others anchor do
        not need them.

        Args:
            number: of the level in the recipe.
            budget_s: seconds of one core that its pairs may take.

        Returns:
            The step; without pairs where there is nothing to match.
        """
        weights = dict(self.weights)
        if not self.is_measured(number):
            for name in self.anchored:
                weights.pop(name, None)
        return self.planner(number, weights).best_step(
            number=number,
            level=self.levels[number],
            needless_after=self.needless_after(number),
            budget_s=budget_s,
        )


def forecast_of(
    levels: Sequence[Level],
    usable: Collection[int],
    num_images: int,
    num_pairs: int,
    megapixels: float = 0.0,
    *,
    is_new: bool = True,
) -> Forecast:
    """Return what forecasts a run, with what may follow its first model.

    Args:
        levels: of the recipe.
        usable: numbers of those whose weights are there.
        num_images: photographs of the set.
        num_pairs: pairs of the set.
        megapixels: of all photographs, at the size of processing.
        is_new: whether the run begins.
    """
    escalating = [number for number in usable if number > 0]
    num_learned = 0  # of a larger set learned matching takes no longer than the rest
    if num_images <= SMALL and learned_level_of(levels, escalating) is not None:
        num_learned = num_pairs
    return Forecast(
        num_images,
        num_pairs,
        num_learned_pairs=num_learned,
        more_may_follow=len(levels) > 1,
        megapixels=megapixels,
        num_cores=available_cores(),
        is_new=is_new,
    )


def learned_step(situation: Situation, effort: EffortName) -> Step:
    """Return the pairs for learned matching.

    Of a small set these are all pairs of images to match again that are worth it, or of all such
    images where the effort gives up nothing. The other pairs are matched, too, where they take no
    longer than the first model: models of learned matches alone need them. Of a larger set the most
    promising pairs are matched, until they and mapping after them take what the first model took.

    Args:
        situation: what is known of the set.
        effort: how long is tried.
    """
    number = situation.learned_level
    if number is None or not situation.weights:
        return Step()
    if not situation.is_small:
        spent_s = situation.seconds_spent_at(number)
        spent_s += situation.seconds_mapped_after(number)
        return situation.best_step(number, situation.first_model_s - spent_s)
    images = set(situation.weights)
    if EFFORTS[effort].gives_up:
        images = situation.images_worth_learned_matching(number)
    lacking = situation.pairs_without_learned_matches()
    needed = list[Pair]()
    others = list[Pair]()
    for pair in lacking:
        is_needed = not images.isdisjoint(pair)
        (needed if is_needed else others).append(pair)
    is_cheap = situation.seconds(number, (), others) <= situation.first_model_s
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


def next_step(
    situation: Situation, effort: EffortName, *, may_cost: bool = True
) -> Plan:
    """Return what is matched again now; a step without pairs where nothing is likely to help.

    Args:
        situation: what is known of the set.
        effort: how long is tried.
        may_cost: otherwise only matches that are there already may take the place of others,
            unless the effort gives up nothing.

    Returns:
        The step, and at most how long it and those after it take, in seconds of one core.
    """
    if not situation.weights:
        return Plan()
    has_model = bool(situation.registered)
    budget_s = EFFORTS[effort].budget_s(situation.first_model_s, has_model=has_model)
    left_s = budget_s - situation.seconds_spent()
    if not situation.is_small:
        learned = learned_step(situation, effort)
        if learned.pairs:
            return Plan(learned, max(0.0, left_s) + situation.first_model_s)
    hopeful = list[Step]()
    numbers = situation.usable
    if EFFORTS[effort].gives_up:
        numbers = situation.levels_worth_trying(may_cost=may_cost)
    for number in numbers:
        step = situation.best_step(number, left_s)
        if is_hopeful(step, situation):
            hopeful.append(step)
    if not hopeful:
        return Plan()
    all_s = sum(step.all_seconds for step in hopeful)
    return Plan(max(hopeful, key=lambda step: step.rate), min(left_s, all_s))


def matched_by_level(situation: Situation) -> list[MatchedAgain]:
    """Return how many pairs were matched again at each level of escalation, if any."""
    found = list[MatchedAgain]()
    for number in range(1, len(situation.levels)):
        pairs = situation.pairs_tried(number)
        if pairs:
            kind = kind_of(situation.levels[number])
            core_s = situation.seconds_spent_at(number)
            found.append(MatchedAgain(kind=kind, num_pairs=len(pairs), core_s=core_s))
    return found


def untried_by_level(situation: Situation) -> list[MatchedAgain]:
    """Return what a greater effort would try for images to match again, by level."""
    found = list[MatchedAgain]()
    for number in situation.usable:
        if situation.is_small and situation.costs_nothing(number):
            continue  # it was tried for all pairs, beside the others
        step = situation.best_step(number, math.inf)
        if is_hopeful(step, situation):
            kind = kind_of(situation.levels[number])
            found.append(
                MatchedAgain(
                    kind=kind, num_pairs=step.num_pairs, core_s=step.all_seconds
                )
            )
    return found
