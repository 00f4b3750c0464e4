"""That matches show no depth is said only where nothing beyond noise speaks for depth."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import project
from colmap_affrect.report.advice import shows_depth

SIZE_PX = 1000.0
TURN = np.array([[0.98, 0.03, 12.0], [-0.02, 1.01, 5.0], [2e-5, -3e-5, 1.0]])
"""Px of one photograph to those of another one whose camera turned, off its middle."""


def turned(num: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Matches of a camera that turned, with half a pixel of noise."""
    random = np.random.default_rng(1)
    points = random.uniform(0.0, SIZE_PX, (num, 2))
    return points, project(TURN, points) + random.normal(0.0, 0.5, (num, 2))


@pytest.mark.parametrize(
    ("num", "num_near", "is_shown"),
    [(1000, 0, False), (1000, 20, False), (1000, 40, True), (200, 20, True)],
)
def test_depth_is_shown_by_as_many_matches_as_make_a_pair_and_more_than_chance(
    num: int, num_near: int, is_shown: bool
) -> None:
    """Things before a wall are few, and show its depth all the same."""
    first, second = turned(num)
    shifts_px = np.linspace(10.0, 60.0, num_near)
    second[:num_near, 0] += shifts_px
    assert shows_depth(first, second, 3.0) == is_shown


def test_few_wrong_matches_of_a_short_list_show_no_depth() -> None:
    first, second = turned(120)
    second[:10, 0] += 30.0
    assert not shows_depth(first, second, 3.0)
