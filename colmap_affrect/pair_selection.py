"""Which images to match where matching all pairs would take too long.

By what features tell (retrieval, low resolution), by position, by name. Everything is the same in
every run, and memory is bounded: of an image only a vector or its strongest features are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.database import nearest_positions
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.matching.nearest import MatchableImage, match_features
from colmap_affrect.matching.pairs import Pair, most_similar_pairs, sequence_pairs
from colmap_affrect.matching.retrieval import (
    NUM_SAMPLES,
    build_vocabulary,
    image_vector,
    similarities,
)
from colmap_affrect.options import MatchingOptions, PairOptions
from colmap_affrect.progress import Progress
from colmap_affrect.types import LocalFeatures

NUM_SAMPLED_IMAGES = 512
"""The vocabulary of larger sets is built from so many of their images."""
NUM_STRONGEST = 1000
"""Features of each image that low-resolution matching looks at."""
IMAGES_AT_ONCE = 256
"""Low-resolution matching goes through the pairs of so many images with so many others in turn."""


def pairs_by_place(names: Sequence[str], database_path: Path, options: PairOptions) -> set[Pair]:
    """Return the pairs of the methods gps and sequence, those of them that are asked for.

    Raises:
        DatabaseError: when gps is asked for and there are no positions.
    """
    pairs: set[Pair] = set()
    if "sequence" in options.methods:
        pairs |= set(sequence_pairs(names, options.num_neighbors))
    if "gps" in options.methods:
        near = nearest_positions(database_path, options.num_neighbors, options.max_distance_m)
        known = set(names)
        pairs |= {pair for pair in near if known.issuperset(pair)}
    return pairs


def retrieved_pairs(
    names: Sequence[str],
    read: Callable[[str], LocalFeatures],
    num_neighbors: int,
    progress: Progress,
) -> list[Pair]:
    """Return the pairs of images whose descriptors are alike as a whole.

    None if all features are those of warps.

    Args:
        names: of images that have features.
        read: returns the features of an image; those of warps are not looked at.
        num_neighbors: on average.
        progress: where to show progress.
    """
    random = np.random.default_rng(0)
    sampled = random.permutation(len(names))[:NUM_SAMPLED_IMAGES]
    num_each = -(-NUM_SAMPLES // max(1, len(sampled)))
    samples = []
    with progress.stage("retrieval", len(sampled) + len(names), "images") as advance:
        for index in sampled:
            descriptors = _original_descriptors(read(names[index]))
            samples.append(random.permutation(descriptors)[:num_each])
            advance(1)
        vocabulary = build_vocabulary(np.concatenate(samples), random)
        if not len(vocabulary):
            return []
        vectors = np.empty((len(names), vocabulary.size), np.float16)
        for vector, name in zip(vectors, names, strict=True):
            vector[:] = image_vector(_original_descriptors(read(name)), vocabulary)
            advance(1)
    return most_similar_pairs(names, similarities(vectors), num_neighbors)


def _original_descriptors(features: LocalFeatures) -> NDArray[np.float32]:
    """Return the (N, D) descriptors of the image itself; with those of warps recall is lower."""
    descriptors = features.descriptors[features.rectification_ids == 0]
    return np.asarray(descriptors, dtype=np.float32)


def low_resolution_pairs(
    names: Sequence[str],
    image: Callable[[str], MatchableImage],
    options: MatchingOptions,
    num_neighbors: int,
    progress: Progress,
) -> list[Pair]:
    """Return the pairs of images of which the strongest features have the most matches.

    Args:
        names: of images that have features.
        image: returns the strongest features of an image; keeps ``2 * IMAGES_AT_ONCE`` at least.
        options: of matching.
        num_neighbors: on average.
        progress: where to show progress.
    """
    counts = np.zeros((len(names), len(names)), np.uint16)

    def count(pair: tuple[int, int]) -> tuple[int, int, int]:
        first, second = (image(names[index]) for index in pair)
        return *pair, len(match_features(first, second, options).indices)

    num_pairs = len(names) * (len(names) - 1) // 2
    with progress.stage("low resolution", num_pairs, "pairs") as advance:
        for i, j, matches in map_ordered(count, in_blocks(len(names)), available_cores()):
            counts[i, j] = counts[j, i] = matches
            advance(1)
    return most_similar_pairs(names, counts, num_neighbors)


def in_blocks(count: int) -> Iterator[tuple[int, int]]:
    """Yield all pairs of numbers below ``count``, such that the same ones come close together."""
    begins = range(0, count, IMAGES_AT_ONCE)
    for begin1 in begins:
        for begin2 in begins[begin1 // IMAGES_AT_ONCE :]:
            for i in range(begin1, min(begin1 + IMAGES_AT_ONCE, count)):
                for j in range(max(i + 1, begin2), min(begin2 + IMAGES_AT_ONCE, count)):
                    yield i, j
