"""Evidence of matched pairs about focal lengths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matched_scenes import in_a_box, looking, matched_pair

from colmap_affrect.geometry.focal_evidence import MatchedPair, log_evidence

FOCALS1, FOCALS2 = 0.9, 1.6
FACTORS = np.array([0.6, 0.75, 1.0, 1.33, 1.7])


@pytest.fixture(scope="module")
def pair() -> MatchedPair:
    """Two cameras with different lenses, their axes far from crossing."""
    rng = np.random.default_rng(4)
    near = looking(FOCALS1, np.array([-1.0, 0.5, -2.6]), np.array([0.3, 0.2, 0.0]), 0.2)
    far = looking(FOCALS2, np.array([2.4, -0.9, -4.4]), np.array([-0.2, -0.3, 0.1]), -0.1)
    return matched_pair(near, far, in_a_box(2000, rng), rng)


def swapped(pair: MatchedPair) -> MatchedPair:
    return replace(pair, points1=pair.points2, points2=pair.points1, fundamental=pair.fundamental.T)


def grid(power: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    factors = FACTORS**power
    first, second = np.meshgrid(FOCALS1 * factors, FOCALS2 * factors, indexing="ij")
    return first.ravel(), second.ravel()


def test_evidence_is_largest_at_the_focal_lengths_of_both_images(pair: MatchedPair) -> None:
    found = log_evidence(pair, *grid())
    assert grid()[0][found.argmax()] == pytest.approx(FOCALS1)
    assert grid()[1][found.argmax()] == pytest.approx(FOCALS2)
    assert found.max() == 0.0
    assert found.min() < -30.0


def test_swapping_the_images_swaps_the_focal_lengths(pair: MatchedPair) -> None:
    first, second = grid(0.3)
    found = log_evidence(pair, first, second)
    other = log_evidence(swapped(pair), second, first)
    likely = found > -20.0
    assert likely.sum() >= 3
    assert np.allclose(found[likely], other[likely], atol=0.05)
    both = np.array([FOCALS1, FOCALS2])
    assert log_evidence(pair, both, both[::-1]).argmax() == 0
    assert log_evidence(swapped(pair), both, both[::-1]).argmax() == 1
