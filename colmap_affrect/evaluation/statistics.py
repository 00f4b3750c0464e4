"""How far results could differ by chance: intervals and a paired test over pairs of images."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from colmap_affrect.geometry.arrays import Array, Indices

NUM_RESAMPLES = 2000
CONFIDENCE = 0.95

MAX_ENUMERATED = 14  # up to so many differences all signs are tried, above that random ones
NUM_RANDOM_SIGNS = 9999


def bootstrap_intervals(
    count: int, statistics: Callable[[Indices], Sequence[float]], seed: int
) -> list[tuple[float, float]]:
    """Compute percentile bootstrap intervals of statistics of ``count`` items, at least one.

    ``statistics`` is given (count,) indices of items, which may repeat. Of each one the limits are
    returned that hold ``CONFIDENCE`` of its values.
    """
    if not count:
        raise ValueError("no values to resample")
    picks = np.random.default_rng(seed).integers(count, size=(NUM_RESAMPLES, count))
    found = np.sort([statistics(pick) for pick in picks], axis=0)
    tail = int((1 - CONFIDENCE) / 2 * NUM_RESAMPLES)
    return list(zip(found[tail].tolist(), found[-1 - tail].tolist(), strict=True))


def paired_test(a: Sequence[float] | Array, b: Sequence[float] | Array, seed: int) -> float:
    """Return the two-sided p-value of a difference of two methods, by their values pair by pair.

    Sign-flip permutation test on signed ranks (Wilcoxon's statistic): if the methods did not
    differ, each difference would have either sign with equal chance. Ranks let infinite errors take
    part as the largest of all. Of zeros and ones it is the exact sign test. The seed is that of the
    random signs, where there are too many differences to try all.
    """
    if len(a) != len(b):
        raise ValueError(f"{len(a)} values against {len(b)}: pairs must be the same")
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    differing = first != second
    differences = first[differing] - second[differing]
    count = len(differences)
    # From 1; equal ones share the mean of their ranks.
    _, group, sizes = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    ranks = (np.cumsum(sizes) - (sizes - 1) / 2)[group]
    observed = abs(float(np.sign(differences) @ ranks))
    if count <= MAX_ENUMERATED:
        signs = np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
        return float((np.abs(signs @ ranks) >= observed).mean())
    rng = np.random.default_rng(seed)
    at_least = sum(
        abs(float(rng.choice((-1.0, 1.0), count) @ ranks)) >= observed
        for _ in range(NUM_RANDOM_SIGNS)
    )
    return (at_least + 1) / (NUM_RANDOM_SIGNS + 1)
