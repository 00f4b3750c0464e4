"""Pairs of photographs whose strongest features match."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from colmap_affrect.matchers.base import Matches
from colmap_affrect.pairs.base import Pair
from colmap_affrect.pairs.lists import most_similar_pairs
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import Progress

NUM_STRONGEST = 1000  # features of each image that low-resolution matching looks at
IMAGES_AT_ONCE = 256  # pairs are matched in blocks of that many images with that many others


def low_resolution_pairs(
    names: Sequence[str], match: Callable[[Pair], Matches], num_neighbors: int, progress: Progress
) -> list[Pair]:
    """Return the pairs of images of which the strongest features have the most matches.

    ``match`` should keep ``2 * IMAGES_AT_ONCE`` images; neighbours are counted on average.
    """
    counts = np.zeros((len(names), len(names)), np.uint16)

    def count(pair: tuple[int, int]) -> tuple[int, int, int]:
        return *pair, len(match((names[pair[0]], names[pair[1]])).indices)

    num_pairs = len(names) * (len(names) - 1) // 2
    with progress.stage("low resolution", num_pairs, "pairs") as advance:
        for i, j, matches in map_ordered(count, in_blocks(len(names)), available_cores()):
            counts[i, j] = counts[j, i] = matches
            advance(1)
    return most_similar_pairs(names, counts, num_neighbors)


def in_blocks(count: int) -> Iterator[tuple[int, int]]:
    """Yield all pairs of numbers below ``count``, those of the same numbers close together."""
    begins = range(0, count, IMAGES_AT_ONCE)
    for begin1 in begins:
        for begin2 in begins[begin1 // IMAGES_AT_ONCE :]:
            for i in range(begin1, min(begin1 + IMAGES_AT_ONCE, count)):
                for j in range(max(i + 1, begin2), min(begin2 + IMAGES_AT_ONCE, count)):
                    yield i, j
