"""Which pairs are matched again, and at which level: what is likely to bring most per second.

A pair at a level is worth the chance that it verifies there, times the photographs that it would
connect, over what it costs. The chances are logistic regressions on what is known of a pair, one
for each kind of level, and the costs are nominal: seconds of one core. Both are in
``expected_gain.json``; ``tests/benchmarks/fit_expected_gain.py`` fits the former on photographs
whose poses are known.

A pair is *verified* when its two-view geometry has inliers, and *strong* when these are so many
that nothing more is matched for it (``EscalateOptions.strong_num_inliers``). All other pairs that
are listed may be matched again.
"""

import json
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.match_state import Worth
from colmap_affrect.recipes import Level

COEFFICIENTS = Path(__file__).with_suffix(".json")
# Seconds of one core by image, for the mapping that follows each step; measured on runs
MAPPING_S = 1.0
LEARNED = "learned"  # kind of the level that matches whole photographs by networks


@dataclass(frozen=True)
class PairState:
    """What is known of a pair.

    Attributes:
        num_inliers: 0 where it is not verified.
        num_consistent: raw matches that confirm each other.
        level: the level that its matches are from.
        tried: a bit for each level that it was matched at.
        measured_worth: of the measured matches that learned ones took the place of.
        learned_level: of learned matches that are kept beside those in use; -1 if there are none.
        is_questioned: whether a model stood on it that was surely wrong.
    """

    num_inliers: int
    num_consistent: int = 0
    level: int = 0
    tried: int = 1
    measured_worth: Worth = (0, 0)
    learned_level: int = -1
    is_questioned: bool = False

    @property
    def worth(self) -> Worth:
        """Its inliers; where there are none, how many matches are consistent."""
        return self.num_inliers, self.num_consistent


@dataclass(frozen=True)
class LevelStatistics:
    """How often a kind of level verifies pairs, and what it costs.

    Attributes:
        coefficients: of the regression, by name of the term.
        image_s: seconds of one core by megapixel, for the features of an image.
        pair_s: the same for matching a pair of images.
    """

    coefficients: Mapping[str, float]
    image_s: float
    pair_s: float

    def chance(self, terms: Mapping[str, float]) -> float:
        """Return the probability that a pair verifies, and is right."""
        log_odds = sum(self.coefficients[name] * value for name, value in terms.items())
        return 1.0 / (1.0 + math.exp(-log_odds))

    def seconds(
        self, images: Iterable[float], pairs: Iterable[tuple[float, float]]
    ) -> float:
        """Return what features of images, and matching of pairs, take on one core.

        Args:
            images: megapixels of each image that gets features.
            pairs: megapixels of both images of each pair that is matched.

        Returns:
            Seconds of one core.
        """
        extraction_s = self.image_s * sum(images)
        return extraction_s + self.pair_s * sum(max(pair) for pair in pairs)


@cache
def _statistics_by_kind() -> dict[str, LevelStatistics]:
    content = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    return {
        kind: LevelStatistics(**values) for kind, values in content["levels"].items()
    }


def kind_of(level: Level) -> str:
    """Return the kind of a level: whether its frames are measured, and its warps."""
    warps = level.rectifier.warps
    if level.features.has_shapes:
        return "measured, all tilts" if warps == "all tilts" else "measured, warps"
    return LEARNED if warps == "none" else "learned, warps"


def statistics_of(level: Level) -> LevelStatistics:
    """Return how often a level verifies pairs, and what it costs."""
    return _statistics_by_kind()[kind_of(level)]


def terms(state: PairState, wins: int, losses: int) -> dict[str, float]:
    """Return what the chance of a pair is made of.

    Args:
        state: what is known of the pair.
        wins: pairs of the set that the level has verified so far.
        losses: pairs of the set for which it was tried in vain.

    Returns:
        The value of each term of the regression, by name.
    """
    num_levels_tried = (state.tried >> 1).bit_count()
    return {
        "constant": 1.0,
        "consistent": math.log1p(state.num_consistent),
        "inliers": math.log1p(state.num_inliers),
        "tried": float(num_levels_tried),
        "success_ratio": math.log((1 + wins) / (1 + losses)),
    }


@dataclass(frozen=True)
class Connection:
    """What a pair would connect to the model if it was verified.

    Attributes:
        key: the name of an image, or the number of a component of the verified pairs.
        weight: photographs that this saves.
    """

    key: str | int
    weight: float


@dataclass(frozen=True)
class Candidate:
    """A pair that a level may verify.

    Attributes:
        pair: names of its images.
        chance: probability that it verifies, and is right.
        connections: what it would connect.
    """

    pair: Pair
    chance: float
    connections: Sequence[Connection]

    @property
    def photographs(self) -> float:
        """How many photographs it is expected to save, if nothing else does."""
        return self.chance * sum(connection.weight for connection in self.connections)


@dataclass(frozen=True)
class Step:
    """Pairs to match again at a level now, and what is expected of that.

    Attributes:
        level: number of the level in the recipe.
        pairs: those that are matched now.
        photographs: expected to be saved by these pairs.
        seconds: of one core, with the mapping that follows.
        all_photographs: expected of all pairs that the budget allows at this level.
        all_seconds: what these take.
        num_pairs: how many these are.
    """

    level: int = 0
    pairs: Sequence[Pair] = ()
    photographs: float = 0.0
    seconds: float = 0.0
    all_photographs: float = 0.0
    all_seconds: float = 0.0
    num_pairs: int = 0

    @property
    def rate(self) -> float:
        """Photographs saved per second."""
        return self.photographs / self.seconds if self.pairs else 0.0


@dataclass(frozen=True)
class StepPlanner:
    """Chooses the pairs that a level is likely to verify, from the pairs as they are now.

    Attributes:
        states: of all pairs.
        weakly_connected: images with few features in tracks through three.
        weights: of the images to match again, in photographs.
        megapixels: of each image, as its features are extracted.
        unmeasured: numbers of the levels whose frames are not measured.
        lacking: images without features of the level yet.
        registered: images of the model before.
        strong_num_inliers: pairs with as many inliers need nothing more.
    """

    states: Mapping[Pair, PairState]
    weakly_connected: Set[str]
    weights: Mapping[str, float]
    megapixels: Mapping[str, float]
    unmeasured: Collection[int]
    lacking: Collection[str]
    registered: Collection[str]
    strong_num_inliers: int

    @cached_property
    def _verified(self) -> list[Pair]:
        return [pair for pair, state in self.states.items() if state.num_inliers]

    @cached_property
    def _components(self) -> list[set[str]]:
        """The connected components of the verified pairs, the largest first."""
        names = list[str]()
        for pair in self.states:
            names += pair
        return connected_parts(self._verified, names)

    @cached_property
    def _component_of(self) -> dict[str, int]:
        numbers = dict[str, int]()
        for number, component in enumerate(self._components):
            numbers.update(dict.fromkeys(component, number))
        return numbers

    @cached_property
    def _num_pairs_to_model(self) -> Counter[str]:
        """Count the verified pairs of each image with images of the model."""
        counts = Counter[str]()
        for first, second in self._verified:
            if second in self.registered:
                counts[first] += 1
            if first in self.registered:
                counts[second] += 1
        return counts

    def _connections(self, pair: Pair) -> list[Connection]:
        """Return what a pair would connect, and how many photographs that saves.

        A component apart from the largest one must be joined to others before all. Where n
        verified pairs with images of the model did not save an image, another does with
        1 / (n + 1), about. While there is no model, each pair of images to match again may begin
        one, and so may other matches of a pair that a wrong model stood on.
        """
        component = self._component_of[pair[0]]
        other = self._component_of[pair[1]]
        if component != other:
            return self._joined_component(max(component, other))  # the smaller one
        is_of_largest = component == 0
        may_begin = not self.registered or self.states[pair].is_questioned
        if not (is_of_largest or may_begin):
            return []
        connections = list[Connection]()
        for name in pair:
            if name in self.weights:
                num_pairs = self._num_pairs_to_model[name]
                weight = self.weights[name] / (1 + num_pairs)
                connections.append(Connection(name, weight))
        return connections

    def _joined_component(self, number: int) -> list[Connection]:
        """Return the connection of a component, if it has images to match again."""
        names = self._components[number]
        weight = sum(self.weights.get(name, 0.0) for name in names)
        return [Connection(number, weight)] if weight else []

    def _is_strong(self, pair: Pair) -> bool:
        """Tell whether a pair needs nothing more; while there is no model, none is.

        Nor is one that only speaks for a model that was surely wrong.
        """
        if self.states[pair].is_questioned:
            return False
        has_many = self.states[pair].num_inliers >= self.strong_num_inliers
        is_well_connected = self.weakly_connected.isdisjoint(pair)
        return has_many and bool(self.registered) and is_well_connected

    def _of_measured(self, state: PairState) -> PairState:
        """Return what the best matches of measured frames say of a pair."""
        if state.level not in self.unmeasured:
            return state
        num_inliers, num_consistent = state.measured_worth
        return replace(state, num_inliers=num_inliers, num_consistent=num_consistent)

    def candidates(
        self, number: int, level: Level, needless_after: int
    ) -> list[Candidate]:
        """Return the pairs that a level may verify, the most promising one first.

        Args:
            number: of the level in the recipe.
            level: what is extracted and matched there.
            needless_after: bits of the levels that make this one needless where they were tried.

        Returns:
            Candidates by falling number of photographs that they are expected to save.
        """
        statistics = statistics_of(level)
        wins, losses = self._wins_and_losses(number)
        candidates = list[Candidate]()
        for pair, state in self.states.items():
            if state.tried & needless_after or self._is_strong(pair):
                continue
            connections = self._connections(pair)
            if not connections:
                continue
            known = self._of_measured(state) if level.features.has_shapes else state
            chance = statistics.chance(terms(known, wins, losses))
            candidates.append(
                Candidate(pair=pair, chance=chance, connections=connections)
            )
        candidates.sort(key=lambda one: (-one.photographs, one.pair))
        return candidates

    def _wins_and_losses(self, number: int) -> tuple[int, int]:
        """Return for how many pairs a level was tried with and without success."""
        num_tried = 0
        wins = 0
        for state in self.states.values():
            num_tried += state.tried >> number & 1
            wins += state.level == number and state.num_inliers > 0
        return wins, max(0, num_tried - wins)

    def best_step(
        self, number: int, level: Level, needless_after: int, budget_s: float
    ) -> Step:
        """Return the pairs to match at a level now.

        A step has the pairs that save more per second than it does as a whole, with the mapping
        that follows.

        Args:
            number: of the level in the recipe.
            level: what is extracted and matched there.
            needless_after: bits of the levels that make this one needless where they were tried.
            budget_s: seconds of one core that the pairs may take.

        Returns:
            The step; one without pairs where there is nothing to match.
        """
        mapping_s = MAPPING_S * len(self.megapixels)
        statistics = statistics_of(level)
        now = _Selection(self, statistics, seconds=mapping_s)
        affordable = _Selection(self, statistics, seconds=mapping_s)
        for one in self.candidates(number, level, needless_after):
            if affordable.seconds + affordable.seconds_of(one) - mapping_s > budget_s:
                continue
            affordable.add(one)
            if now.is_worthwhile(one):
                now.add(one)
        return Step(
            level=number,
            pairs=now.pairs,
            photographs=now.photographs,
            seconds=now.seconds,
            all_photographs=affordable.photographs,
            all_seconds=affordable.seconds,
            num_pairs=len(affordable.pairs),
        )


@dataclass
class _Selection:
    """Pairs that are matched together, what they are expected to save, and what they take.

    Attributes:
        planner: what is known of the set.
        statistics: of the level.
        seconds: of one core; at first that of mapping.
        photographs: expected to be saved.
        pairs: those selected so far.
    """

    planner: StepPlanner
    statistics: LevelStatistics
    seconds: float
    photographs: float = 0.0
    pairs: list[Pair] = field(default_factory=list)
    # Names of the images that get features of the level
    _extended: set[str] = field(default_factory=set)
    # Probability that no selected pair connects an image or a component, by key
    _chance_missed: dict[str | int, float] = field(default_factory=dict)

    def photographs_saved_by(self, one: Candidate) -> float:
        """Return how many photographs a pair is expected to save that no other has saved."""
        saved = 0.0
        for connection in one.connections:
            saved += connection.weight * self._chance_missed.get(connection.key, 1.0)
        return one.chance * saved

    def seconds_of(self, one: Candidate) -> float:
        """Return the seconds of a pair, and of the features that its images lack."""
        sizes = self.planner.megapixels
        images = list[float]()
        for name in one.pair:
            if name in self.planner.lacking and name not in self._extended:
                images.append(sizes[name])
        first, second = one.pair
        return self.statistics.seconds(images, [(sizes[first], sizes[second])])

    def is_worthwhile(self, one: Candidate) -> bool:
        """Tell whether a pair saves no less per second than the pairs so far."""
        so_far = self.photographs * self.seconds_of(one)
        return so_far <= self.photographs_saved_by(one) * self.seconds

    def add(self, one: Candidate) -> None:
        """Take a pair in."""
        self.seconds += self.seconds_of(one)
        self.photographs += self.photographs_saved_by(one)
        self.pairs.append(one.pair)
        self._extended.update(one.pair)
        for connection in one.connections:
            missed = self._chance_missed.get(connection.key, 1.0)
            self._chance_missed[connection.key] = missed * (1.0 - one.chance)


def insecure_images(
    num_inliers: Mapping[Pair, int],
    strong_num_inliers: int,
    weakly_connected: Collection[str] = (),
) -> set[str]:
    """Return the images that mapping may well lose: without a strong pair, or weakly connected.

    Args:
        num_inliers: of each pair, 0 where it is not verified.
        strong_num_inliers: inliers from which on a pair is strong.
        weakly_connected: images that are insecure in any case.

    Returns:
        Names of images.
    """
    insecure = set[str]()
    for pair in num_inliers:
        insecure.update(pair)
    for pair, count in num_inliers.items():
        if count >= max(1, strong_num_inliers):
            insecure.difference_update(pair)
    return insecure.union(weakly_connected)
