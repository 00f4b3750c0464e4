"""Probabilities that random matches have the inliers of a two-view geometry, and their LAFs.

Two numbers that multiply: the expected number of geometries with so many inliers among random
matches (a contrario: Desolneux, Moisan, Morel; Moisan and Stival), and the Bayes factor of the
ratio of inliers whose LAFs agree with the geometry. What single random matches reach is measured
on the pair itself, with the features of its matches in other combinations.
"""

import math

import numpy as np

from colmap_affrect.geometry.arrays import Indices

NUM_RANDOM_MATCHES = 4000
"""Random matches of a pair, about: they measure a probability of 1 % to a sixth of itself
(theory)."""
MIN_AGREEING_RATIO = 0.5
"""Inliers of right pairs whose LAFs agree, at least, as a share of all; judged."""
RATIO_STEPS = np.linspace(0.0, 1.0, 51)[:-1]
"""Ratios of agreeing LAFs that are averaged over, from the smallest one (0) to below all (1);
a numeric integral."""


def random_matches(num: int) -> tuple[Indices, Indices]:
    """Combine the features of matches anew: two lists of indices below ``num``, by cyclic shifts.

    No feature keeps its partner, and no combination comes twice.
    """
    num_shifts = min(num - 1, max(1, NUM_RANDOM_MATCHES // max(num, 1)))
    shifts = np.linspace(1, num - 1, num_shifts).astype(np.int64)
    first = np.tile(np.arange(num), len(shifts))
    second = (first + np.repeat(shifts, num)) % max(num, 1)
    return first, second


def log10_choose(num: int, chosen: int) -> float:
    """Return the decimal logarithm of a binomial coefficient."""
    log_permutations = math.lgamma(chosen + 1) + math.lgamma(num - chosen + 1)
    return (math.lgamma(num + 1) - log_permutations) / math.log(10.0)


def log10_false_alarms(
    num_matches: int, num_inliers: int, sample_size: int, chance: float
) -> float:
    """Return the expected number of geometries with as many inliers among random matches.

    Args:
        num_matches: matches of the pair.
        num_inliers: inliers of its geometry.
        sample_size: matches that determine a geometry, and are inliers in any case.
        chance: probability that a random match is an inlier.

    Returns:
        Decimal logarithm; infinite where inliers prove nothing.
    """
    if num_inliers <= sample_size:
        return math.inf
    return (
        math.log10(max(num_matches - sample_size, 1))
        + log10_choose(num_matches, num_inliers)
        + log10_choose(num_inliers, sample_size)
        + (num_inliers - sample_size) * math.log10(chance)
    )


def log10_bayes_factor(num: int, num_agreeing: int, chance: float) -> float:
    """Return how much more probable the number of agreeing LAFs is in a right pair than by chance.

    In a right pair the ratio of agreeing LAFs is unknown, at least ``MIN_AGREEING_RATIO``, and all
    values are equally probable. Where chance reaches as much, LAFs prove nothing.

    Args:
        num: inliers.
        num_agreeing: inliers whose LAFs agree with the geometry.
        chance: probability that the LAFs of a random match agree.

    Returns:
        Decimal logarithm of the Bayes factor.
    """
    lowest = max(MIN_AGREEING_RATIO, chance)
    ratios = lowest + (1.0 - lowest) * RATIO_STEPS
    logs = num_agreeing * np.log10(ratios / chance)
    logs += (num - num_agreeing) * np.log10((1.0 - ratios) / (1.0 - chance))
    highest = logs.max()
    return float(highest + np.log10(np.mean(10.0 ** (logs - highest))))
