"""How far results could differ by chance: intervals and a paired test over pairs of images."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

NUM_RESAMPLES = 2000
CONFIDENCE = 0.95

MAX_ENUMERATED = 14
"""Up to so many differences all signs are tried, above that random ones."""

NUM_RANDOM_SIGNS = 9999

Statistic = Callable[[NDArray[np.float64]], float]


def bootstrap_interval(
    values: Sequence[float], statistic: Statistic, seed: int
) -> tuple[float, float]:
    """Compute the percentile bootstrap interval of a statistic of one value per pair.

    Args:
        values: one or more; infinite ones are fine if the statistic takes them.
        statistic: of a (N,) array, such as a mean.
        seed: of the resamples.

    Returns:
        Limits of the interval that holds ``CONFIDENCE`` of the statistics of resampled values.

    Raises:
        ValueError: without values.
    """
    if not len(values):
        raise ValueError("no values to resample")
    array = np.asarray(values, dtype=np.float64)
    picks = np.random.default_rng(seed).integers(len(array), size=(NUM_RESAMPLES, len(array)))
    found = np.sort([statistic(array[pick]) for pick in picks])
    tail = int((1 - CONFIDENCE) / 2 * NUM_RESAMPLES)
    return float(found[tail]), float(found[-1 - tail])


def paired_test(a: Sequence[float], b: Sequence[float], seed: int) -> float:
    """Test whether two methods differ, by their values of the same pairs.

    Sign-flip permutation test on signed ranks (Wilcoxon's statistic): if the methods did not
    differ, each difference would have either sign with equal chance. Ranks let infinite errors
    take part as the largest of all. Of zeros and ones it is the exact sign test of the pairs that
    only one method solved.

    Args:
        a: values of one method, may be infinite.
        b: those of the other, pair by pair.
        seed: of the random signs, where there are too many differences to try all.

    Returns:
        The two-sided p-value: the chance of a difference at least as large if there were none.

    Raises:
        ValueError: when the numbers of values differ.
    """
    if len(a) != len(b):
        raise ValueError(f"{len(a)} values against {len(b)}: pairs must be the same")
    first, second = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    differing = first != second
    differences = first[differing] - second[differing]
    count = len(differences)
    if not count:
        return 1.0
    ranks = _mean_ranks(np.abs(differences))
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


def _mean_ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rank (N,) values from 1; equal ones share the mean of their ranks."""
    _, group, sizes = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(sizes) - (sizes - 1) / 2)[group])
