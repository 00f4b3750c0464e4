"""Whether chance would find the inliers of a two-view geometry, too, and their frames' agreement.

Two numbers that multiply: how many geometries with so many inliers are expected among random
matches (a contrario: Desolneux, Moisan, Morel; Moisan and Stival), and the Bayes factor of the
share of inliers whose local affine frames agree. What single random matches reach is measured on
the pair itself: features of its matches, paired anew.
"""

import math

import numpy as np

from colmap_affrect.geometry.arrays import Indices

NUM_SHUFFLED = 4000  # about so many random matches measure 1 % to a sixth of itself
MIN_AGREEING = 0.5  # right pairs have at least this share of inliers with agreeing frames
AGREEING_SHARES = np.linspace(0.0, 1.0, 51)[:-1]  # from ``MIN_AGREEING`` (0) to all (1)


def random_matches(num: int) -> tuple[Indices, Indices]:
    """Pair matches anew: two lists of indices below ``num`` that never agree, by cyclic shifts."""
    num_shifts = min(num - 1, max(1, NUM_SHUFFLED // max(num, 1)))
    shifts = np.linspace(1, num - 1, num_shifts).astype(np.int64)
    first = np.tile(np.arange(num), len(shifts))
    return first, (first + np.repeat(shifts, num)) % max(num, 1)


def log10_choose(num: int, chosen: int) -> float:
    """Return the decimal logarithm of a binomial coefficient."""
    values = (math.lgamma(n + 1) for n in (num, chosen, num - chosen))
    return (next(values) - sum(values)) / math.log(10.0)


def log10_false_alarms(
    num_matches: int, num_inliers: int, sample_size: int, chance: float
) -> float:
    """Return how many geometries with so many inliers random matches are expected to have.

    ``sample_size`` matches are inliers in any case; ``chance`` is the probability of another.
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
    """Return how much more probable in a right pair so many agreeing frames are than by chance.

    It is an unknown share in a right pair, at least ``MIN_AGREEING``; where chance reaches as much,
    frames say nothing.
    """
    lowest = max(MIN_AGREEING, chance)
    shares = lowest + (1.0 - lowest) * AGREEING_SHARES
    logs = num_agreeing * np.log10(shares / chance)
    logs += (num - num_agreeing) * np.log10((1.0 - shares) / (1.0 - chance))
    return float(logs.max() + np.log10(np.mean(10.0 ** (logs - logs.max()))))
