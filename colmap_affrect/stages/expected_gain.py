"""Which pairs are matched again, and at which level: what is likely to bring most per second.

A pair at a level is worth the chance that it verifies there, times the photographs that it would
tie, in megapixels as are costs, over what it costs. The chances are logistic regressions on what is
known of a pair, one for each kind of level, and the costs are nominal. Both are in
``expected_gain.json``; ``tests/benchmarks/fit_expected_gain.py`` fits the former on photographs
whose poses are known.
"""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

from colmap_affrect.colmap.verification import connected_parts, num_in_tracks
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.recipes import EscalateOptions, Level

COEFFICIENTS = Path(__file__).with_suffix(".json")
MAPPING_S = 0.06  # of one core, by listed pair: what follows on each step, mapping again


@dataclass(frozen=True)
class PairState:
    """What is known of a pair."""

    num_inliers: int  # 0 where it is not verified
    num_consistent: int = 0  # raw matches that confirm each other
    level: int = 0  # that its matches are from
    tried: int = 1  # a bit for each level

    @property
    def worth(self) -> tuple[int, int]:
        """Its inliers; where there are none, how many matches are consistent."""
        return self.num_inliers, self.num_consistent


@dataclass(frozen=True)
class LevelGain:
    """What a kind of level usually brings and costs."""

    weights: Mapping[str, float]  # of the regression, by name of the term
    image_s: float  # of one core, for the features of an image, by megapixel
    pair_s: float  # the same for matching a pair of images

    def chance(self, terms: Mapping[str, float]) -> float:
        """Return the probability that a pair verifies, and is right."""
        log_odds = sum(self.weights[name] * value for name, value in terms.items())
        return 1.0 / (1.0 + math.exp(-log_odds))


@cache
def _known() -> dict[str, LevelGain]:
    content = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    return {kind: LevelGain(**values) for kind, values in content.items()}


def kind_of(level: Level) -> str:
    """Return the kind of a level: whether its frames are measured, and its warps."""
    warps = level.rectifier.name
    if level.features.has_shapes:
        return "measured, all tilts" if warps == "asift" else "measured, warps"
    return "learned" if warps == "identity" else "learned, warps"


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
        "luck": math.log((1 + wins) / (1 + losses)),
    }


@dataclass(frozen=True)
class ExpectedGain:
    """The pairs of a set as they are now, and what a level may bring to them."""

    states: Mapping[Pair, PairState]  # of all pairs
    loose: Set[str]  # images with few features in tracks through three images
    needs: Mapping[str, float]  # what more matches may be worth: megapixels, of lost images all
    megapixels: Mapping[str, float]  # of each image, as its features are extracted
    unmeasured: Collection[int]  # levels whose frames are not measured
    lacking: Collection[str]  # images without features of the level yet
    registered: Collection[str]  # images of the model before

    @cached_property
    def _parts(self) -> list[set[str]]:
        verified = (pair for pair, state in self.states.items() if state.num_inliers)
        return connected_parts(verified, (name for pair in self.states for name in pair))

    @cached_property
    def _part_of(self) -> dict[str, int]:
        return {name: number for number, part in enumerate(self._parts) for name in part}

    @cached_property
    def _in_vain(self) -> Counter[str]:
        """Count the verified pairs of each image with images of the model."""
        verified = [pair for pair, state in self.states.items() if state.num_inliers]
        both = [*verified, *(pair[::-1] for pair in verified)]
        return Counter(name for name, other in both if other in self.registered)

    def _tied(self, pair: Pair) -> list[tuple[str | int, float]]:
        """Return what would be tied by a pair, images or a part, and how many images that saves.

        What is apart from the largest part must be joined to others before all. Where n verified
        pairs with images of the model did not save one, another does with 1 / (n + 1), about.
        """
        first, second = (self._part_of[name] for name in pair)
        if first == second:
            needy = [name for name in pair if name in self.needs] if first == 0 else []
            return [(name, self.needs[name] / (1 + self._in_vain[name])) for name in needy]
        smaller = max(first, second)  # parts come by size
        need = sum(self.needs.get(name, 0.0) for name in self._parts[smaller])
        return [(smaller, need)] if need else []

    def best_pairs(
        self, number: int, level: Level, others: int, options: EscalateOptions
    ) -> tuple[float, list[Pair], float]:
        """Return megapixels saved by second, pairs for a level now, and seconds of all worth it.

        A step has the pairs that save more by second than it does as a whole. Mapping is included.
        ``others``: bits of the levels that make this one needless.
        """
        gain, states = gain_of(level), self.states
        num_tried = sum(state.tried >> number & 1 for state in states.values())
        wins = sum(state.level == number and state.num_inliers > 0 for state in states.values())
        found = []
        for pair, state in states.items():
            is_strong = state.num_inliers >= options.strong_num_inliers
            is_done = state.tried & others or (is_strong and self.loose.isdisjoint(pair))
            if not is_done and (tied := self._tied(pair)):
                is_hint = not level.features.has_shapes or state.level not in self.unmeasured
                hint = state if is_hint else replace(state, num_inliers=0)
                known = terms(hint, wins, max(0, num_tried - wins))
                found.append((gain.chance(known), tied, pair))
        found.sort(key=lambda item: (-item[0] * sum(value for _, value in item[1]), item[2]))
        left: defaultdict[str | int, float] = defaultdict(lambda: 1.0)  # chance of being lost still
        chosen, there = list[Pair](), set[str]()
        saved, spent_s, all_s = 0.0, MAPPING_S * len(states), MAPPING_S * len(states)
        for chance, tied, pair in found:
            lacking = [name for name in pair if name in self.lacking and name not in there]
            seconds = gain.image_s * sum(self.megapixels[name] for name in lacking)
            seconds += gain.pair_s * max(self.megapixels[name] for name in pair)
            brought = chance * sum(value * left[key] for key, value in tied)
            rate = brought / seconds
            if rate * options.max_seconds_per_megapixel < 1.0:
                continue
            all_s += seconds
            if rate * spent_s < saved:
                continue
            chosen.append(pair)
            there.update(lacking)
            saved, spent_s = saved + brought, spent_s + seconds
            for key, _ in tied:
                left[key] *= 1.0 - chance
        if not chosen or saved * options.max_seconds_per_megapixel < spent_s:
            return 0.0, [], 0.0
        return saved / spent_s, chosen, all_s


def insecure_images(
    num_inliers: Mapping[Pair, int], strong_num_inliers: int, weakly_connected: Collection[str] = ()
) -> set[str]:
    """Return the images that mapping may well lose: without a strong pair, or weakly connected.

    ``num_inliers`` of each pair is 0 where it is not verified.
    """
    strong = (pair for pair, count in num_inliers.items() if count >= max(1, strong_num_inliers))
    names = {name for pair in num_inliers for name in pair}
    return names.difference(*strong).union(weakly_connected)


def weakly_connected_images(matches: Mapping[Pair, Indices], min_num_features: int) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    Mappers register images by features that two others have triangulated already.
    """
    return {name for name, count in num_in_tracks(matches).items() if count < min_num_features}
