"""Which pairs of a set may escalate: those that would tie an image that mapping may well lose."""

import heapq
from collections import defaultdict
from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass, field
from functools import cached_property

from colmap_affrect.colmap.verification import connected_parts, num_in_tracks
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.recipes import EscalateOptions


def insecure_images(
    num_inliers: Mapping[Pair, int], strong_num_inliers: int, weakly_connected: Collection[str] = ()
) -> set[str]:
    """Return the images that mapping may well lose.

    Those are in no pair with ``strong_num_inliers``, or are among those that have little in common
    with two others. ``num_inliers`` of each pair is 0 where it is not verified.
    """
    strong = (pair for pair, count in num_inliers.items() if count >= max(1, strong_num_inliers))
    names = {name for pair in num_inliers for name in pair}
    return names.difference(*strong).union(weakly_connected)


@dataclass(frozen=True)
class EscalationGraph:
    """The pairs of a set as they are now."""

    num_inliers: Mapping[Pair, int]  # of each pair, 0 where it is not verified
    num_consistent: Mapping[Pair, int]  # that confirm each other; of each not verified
    insecure: Set[str]  # images that mapping may well lose
    stalled: Set[Pair] = frozenset()  # to which the last level brought nothing
    num_raw: Mapping[Pair, int] = field(default_factory=dict)  # matches of each not verified

    @cached_property
    def components(self) -> dict[str, int]:
        """The part of the graph of verified pairs that each image is in; 0 is the largest."""
        verified = (pair for pair, count in self.num_inliers.items() if count)
        parts = connected_parts(verified, (name for pair in self.num_inliers for name in pair))
        return {name: number for number, part in enumerate(parts) for name in part}

    def worth(self, pair: Pair) -> tuple[int, int]:
        """Return the inliers of a pair; where there are none, how many matches are consistent."""
        return self.num_inliers[pair], self.num_consistent.get(pair, 0)

    def joining(self, options: EscalateOptions) -> list[Pair]:
        """Return the promising pairs between images that no verified pairs connect.

        And the best of each image outside the largest part, where no level brought nothing to them;
        the best pair of each part escalates in any case.
        """
        parts = self.components
        between = [pair for pair in self.num_inliers if parts[pair[0]] != parts[pair[1]]]
        best: set[Pair] = set()
        of_end: defaultdict[str | int, list[Pair]] = defaultdict(list)  # of an image, or a part
        for pair in between:
            for end in (*pair, parts[pair[0]], parts[pair[1]]):
                of_end[end].append(pair)
        for name in (name for name, part in parts.items() if part):
            own = of_end[name]
            ranked = heapq.nlargest(options.num_best_pairs, own, self.num_consistent.__getitem__)
            best |= set(ranked) - self.stalled
        for part in set(parts.values()) - {0} if options.num_best_pairs else ():
            best.update(heapq.nlargest(1, of_end[part], self.num_consistent.__getitem__))
        return [pair for pair in between if pair in best or self._is_promising(pair, options)]

    def hanging(self, options: EscalateOptions) -> list[Pair]:
        """Return the verified and the promising pairs of images that are not secure."""
        return [
            pair
            for pair, count in self.num_inliers.items()
            if not self.insecure.isdisjoint(pair) and (count or self._is_promising(pair, options))
        ]

    def blind(self, options: EscalateOptions, tried: Collection[Pair]) -> list[Pair]:
        """Return pairs of images that are not secure whatever their matches hint at, the best few.

        Where light or age differ the matches of right ones hint at nothing. Those that were
        ``tried`` count among the few.
        """
        of_image: defaultdict[str, list[Pair]] = defaultdict(list)
        num_left = dict.fromkeys(self.insecure, options.num_blind_pairs)
        for pair in self.num_inliers:
            for name in self.insecure & set(pair):
                if pair in tried:
                    num_left[name] -= 1
                elif pair in self.num_consistent:
                    of_image[name].append(pair)
        best: set[Pair] = set()
        for name, own in of_image.items():
            best.update(heapq.nlargest(max(0, num_left[name]), own, self._rank))
        return [pair for pair in self.num_consistent if pair in best]

    def _rank(self, pair: Pair) -> tuple[int, int]:
        return self.num_consistent[pair], self.num_raw.get(pair, 0)

    def _is_promising(self, pair: Pair, options: EscalateOptions) -> bool:
        enough = self.num_consistent[pair] >= options.min_num_consistent
        return enough and pair not in self.stalled

    def links(self, levels: Mapping[Pair, int], level: int) -> list[Pair]:
        """Return the verified pairs of images that gained matches at a level and need more."""
        gained = {
            name
            for pair, reached in levels.items()
            if reached == level
            and self.num_inliers.get(pair)
            and not self.insecure.isdisjoint(pair)
            for name in pair
        }
        return [pair for pair, n in self.num_inliers.items() if n and not gained.isdisjoint(pair)]


def weakly_connected_images(matches: Mapping[Pair, Indices], min_num_features: int) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    A mapper registers an image by features whose matches it has triangulated already. That takes
    two other images, so a strong pair alone ties an image to nothing.
    """
    return {name for name, count in num_in_tracks(matches).items() if count < min_num_features}
