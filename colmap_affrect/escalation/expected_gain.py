"""Which pairs are matched again, and at which level: what is likely to bring most per second.

A pair at a level is worth the chance that it verifies there, times the photographs that it would
tie, over what it costs. The chances are logistic regressions on what is known of a pair, one for
each kind of level, and the costs are nominal: seconds of one core. Both are in
``expected_gain.json``; ``tests/benchmarks/fit_expected_gain.py`` fits the former on photographs
whose poses are known.
"""

import json
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path

from colmap_affrect.colmap.verification import connected_parts
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.match_state import Worth
from colmap_affrect.recipes import Level

COEFFICIENTS = Path(__file__).with_suffix(".json")
MAPPING_S = 1.0  # of one core, by image: what follows on each step, mapping again
LEARNED = "learned"  # kind of the level that matches whole photographs by networks


@dataclass(frozen=True)
class PairState:
    """What is known of a pair."""

    num_inliers: int  # 0 where it is not verified
    num_consistent: int = 0  # raw matches that confirm each other
    level: int = 0  # that its matches are from
    tried: int = 1  # a bit for each level
    measured_worth: Worth = (
        0,
        0,
    )  # of the measured matches that learned ones took the place of
    learned_level: int = (
        -1
    )  # of learned matches that are kept beside those in use; -1: none

    @property
    def worth(self) -> Worth:
        """Its inliers; where there are none, how many matches are consistent."""
        return self.num_inliers, self.num_consistent


@dataclass(frozen=True)
class LevelGain:
    """What a kind of level usually brings and costs."""

    coefficients: Mapping[str, float]  # of the regression, by name of the term
    image_s: float  # of one core, for the features of an image, by megapixel
    pair_s: float  # the same for matching a pair of images

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
def _known() -> dict[str, LevelGain]:
    content = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    return {kind: LevelGain(**values) for kind, values in content.items()}


def kind_of(level: Level) -> str:
    """Return the kind of a level: whether its frames are measured, and its warps."""
    warps = level.rectifier.warps
    if level.features.has_shapes:
        return "measured, all tilts" if warps == "all tilts" else "measured, warps"
    return LEARNED if warps == "none" else "learned, warps"


def gain_of(level: Level) -> LevelGain:
    """Return what a level brings and costs."""
    return _known()[kind_of(level)]


def terms(state: PairState, wins: int, losses: int) -> dict[str, float]:
    """Return what the chance of a pair is made of.

    ``wins`` and ``losses``: pairs of the set that the level has verified so far, and others.
    """
    return {
        "constant": 1.0,
        "consistent": math.log1p(state.num_consistent),
        "inliers": math.log1p(state.num_inliers),
        "tried": float((state.tried >> 1).bit_count()),  # in vain
        "success_ratio": math.log((1 + wins) / (1 + losses)),
    }


@dataclass(frozen=True)
class Candidate:
    """A pair that a level may verify."""

    pair: Pair
    chance: float  # that it verifies, and is right
    ties: Sequence[
        tuple[str | int, float]
    ]  # images or a part of the graph, and photographs saved

    @property
    def photographs(self) -> float:
        """How many photographs it is expected to save, if nothing else does."""
        return self.chance * sum(value for _, value in self.ties)


@dataclass(frozen=True)
class Step:
    """Pairs to match again at a level now, and what is expected of that."""

    level: int = 0
    pairs: Sequence[Pair] = ()
    photographs: float = 0.0  # expected to be saved by these pairs
    seconds: float = 0.0  # of one core, with the mapping that follows
    all_photographs: float = 0.0  # by all pairs that the budget allows at this level
    all_seconds: float = 0.0  # that these take
    num_pairs: int = 0  # how many these are

    @property
    def rate(self) -> float:
        """Photographs saved per second."""
        return self.photographs / self.seconds if self.pairs else 0.0


@dataclass(frozen=True)
class ExpectedGain:
    """The pairs of a set as they are now, and what a level may bring to them."""

    states: Mapping[Pair, PairState]  # of all pairs
    weakly_connected: Set[str]  # images with few features in tracks through three
    weights: Mapping[str, float]  # of the images to match again, in photographs
    megapixels: Mapping[str, float]  # of each image, as its features are extracted
    unmeasured: Collection[int]  # levels whose frames are not measured
    lacking: Collection[str]  # images without features of the level yet
    registered: Collection[str]  # images of the model before
    strong_num_inliers: int  # pairs with as many need nothing more

    @cached_property
    def _parts(self) -> list[set[str]]:
        verified = (pair for pair, state in self.states.items() if state.num_inliers)
        return connected_parts(
            verified, (name for pair in self.states for name in pair)
        )

    @cached_property
    def _part_of(self) -> dict[str, int]:
        return {
            name: number for number, part in enumerate(self._parts) for name in part
        }

    @cached_property
    def _num_pairs_to_model(self) -> Counter[str]:
        """Count the verified pairs of each image with images of the model."""
        verified = [pair for pair, state in self.states.items() if state.num_inliers]
        both = [*verified, *(pair[::-1] for pair in verified)]
        return Counter(name for name, other in both if other in self.registered)

    def _ties(self, pair: Pair) -> list[tuple[str | int, float]]:
        """Return what would be tied by a pair, images or a part, and how many images that saves.

        What is apart from the largest part must be joined to others before all. Where n verified
        pairs with images of the model did not save one, another does with 1 / (n + 1), about.
        While there is no model, each pair of images to match again may begin one.
        """
        first, second = (self._part_of[name] for name in pair)
        if first == second:
            if first and self.registered:
                return []
            needy = [name for name in pair if name in self.weights]
            num_pairs = self._num_pairs_to_model
            return [
                (name, self.weights[name] / (1 + num_pairs[name])) for name in needy
            ]
        smaller = max(first, second)  # parts come by size
        need = sum(self.weights.get(name, 0.0) for name in self._parts[smaller])
        return [(smaller, need)] if need else []

    def _is_strong(self, pair: Pair) -> bool:
        """Tell whether a pair needs nothing more; while there is no model, none is."""
        is_many = self.states[pair].num_inliers >= self.strong_num_inliers
        return (
            is_many and bool(self.registered) and self.weakly_connected.isdisjoint(pair)
        )

    def _of_measured(self, state: PairState) -> PairState:
        """Return what the best matches of measured frames say of a pair."""
        if state.level not in self.unmeasured:
            return state
        num_inliers, num_consistent = state.measured_worth
        return replace(state, num_inliers=num_inliers, num_consistent=num_consistent)

    def candidates(self, number: int, level: Level, others: int) -> list[Candidate]:
        """Return the pairs that a level may verify, the most promising one first.

        Args:
            number: of the level in the recipe.
            level: what is extracted and matched there.
            others: bits of the levels that make this one needless where they were tried.

        Returns:
            Candidates by falling number of photographs that they are expected to save.
        """
        gain = gain_of(level)
        num_tried = sum(state.tried >> number & 1 for state in self.states.values())
        wins = sum(
            s.level == number and s.num_inliers > 0 for s in self.states.values()
        )
        losses = max(0, num_tried - wins)
        found = list[Candidate]()
        for pair, state in self.states.items():
            if state.tried & others or self._is_strong(pair):
                continue
            ties = self._ties(pair)
            if not ties:
                continue
            hint = self._of_measured(state) if level.features.has_shapes else state
            found.append(Candidate(pair, gain.chance(terms(hint, wins, losses)), ties))
        found.sort(key=lambda one: (-one.photographs, one.pair))
        return found

    def best_step(
        self, number: int, level: Level, others: int, budget_s: float
    ) -> Step:
        """Return the pairs to match at a level now.

        A step has the pairs that save more per second than it does as a whole, with the mapping
        that follows.

        Args:
            number: of the level in the recipe.
            level: what is extracted and matched there.
            others: bits of the levels that make this one needless where they were tried.
            budget_s: seconds of one core that the pairs may take.

        Returns:
            The step; one without pairs where there is nothing to match.
        """
        mapping_s = MAPPING_S * len(self.megapixels)
        step = _Selection(self, gain_of(level), mapping_s)
        everything = _Selection(self, gain_of(level), mapping_s)
        for one in self.candidates(number, level, others):
            if everything.seconds + everything.cost_of(one) - mapping_s > budget_s:
                continue
            everything.add(one)
            if step.photographs * step.cost_of(one) <= step.gain_of(one) * step.seconds:
                step.add(one)
        return Step(
            number,
            step.pairs,
            step.photographs,
            step.seconds,
            everything.photographs,
            everything.seconds,
            len(everything.pairs),
        )


@dataclass
class _Selection:
    """Pairs that are matched together, what they are expected to save, and what they take."""

    gain: ExpectedGain
    level: LevelGain
    seconds: float  # of one core; at first that of mapping
    photographs: float = 0.0
    pairs: list[Pair] = field(default_factory=list)
    _there: set[str] = field(
        default_factory=set
    )  # images that get features of the level
    _lost: dict[str | int, float] = field(
        default_factory=dict
    )  # chance that none tied it so far

    def gain_of(self, one: Candidate) -> float:
        """Return how many photographs a pair is expected to save that no other has saved."""
        return one.chance * sum(
            value * self._lost.get(key, 1.0) for key, value in one.ties
        )

    def cost_of(self, one: Candidate) -> float:
        """Return the seconds of a pair, and of the features that its images lack."""
        sizes = self.gain.megapixels
        first, second = one.pair
        lacking = [
            n for n in one.pair if n in self.gain.lacking and n not in self._there
        ]
        return self.level.seconds(
            [sizes[n] for n in lacking], [(sizes[first], sizes[second])]
        )

    def add(self, one: Candidate) -> None:
        """Take a pair in."""
        self.seconds += self.cost_of(one)
        self.photographs += self.gain_of(one)
        self.pairs.append(one.pair)
        self._there.update(one.pair)
        for key, _ in one.ties:
            self._lost[key] = self._lost.get(key, 1.0) * (1.0 - one.chance)


def insecure_images(
    num_inliers: Mapping[Pair, int],
    strong_num_inliers: int,
    weakly_connected: Collection[str] = (),
) -> set[str]:
    """Return the images that mapping may well lose: without a strong pair, or weakly connected.

    ``num_inliers`` of each pair is 0 where it is not verified.
    """
    strong = (
        pair
        for pair, count in num_inliers.items()
        if count >= max(1, strong_num_inliers)
    )
    names = {name for pair in num_inliers for name in pair}
    return names.difference(*strong).union(weakly_connected)
