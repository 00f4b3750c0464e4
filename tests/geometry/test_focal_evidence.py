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


def test_a_pair_that_fits_no_camera_says_nothing(pair: MatchedPair) -> None:
    rng = np.random.default_rng(7)
    turned = np.array([[0.2, -1.0, 0.3], [0.6, 0.4, -0.9], [-0.25, 0.3, 0.02]])
    left, values, right = np.linalg.svd(turned)
    wrong = left @ np.diag([values[0], values[1], 0.0]) @ right
    points1 = rng.uniform(-0.45, 0.45, (300, 2))
    lines = np.column_stack([points1, np.ones(300)]) @ wrong.T
    x = rng.uniform(-0.45, 0.45, 300)
    points2 = np.column_stack([x, -(lines[:, 0] * x + lines[:, 2]) / lines[:, 1]])
    inside = np.abs(points2[:, 1]) < 0.45
    assert inside.sum() > 60
    points2 += 3e-4 * rng.standard_normal(points2.shape)
    unreal = MatchedPair.of(points1[inside], points2[inside], wrong, 3e-4)
    assert not log_evidence(unreal, *grid()).any()
    assert log_evidence(pair, *grid()).any()
