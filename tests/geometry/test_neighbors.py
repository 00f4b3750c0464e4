"""Which matches support each other, and which are duplicates of better ones."""

from __future__ import annotations

import numpy as np
from strategies import Array

from colmap_affrect.geometry.neighbors import _num_supporting, without_duplicates


def row_of(num: int, step_px: float) -> Array:
    """(N, 2) points in a row."""
    return np.stack([step_px * np.arange(num), np.zeros(num)], axis=1)


def maps(factor: float, num: int) -> Array:
    """(N, 2, 2) maps that magnify."""
    return np.tile(factor * np.eye(2), (num, 1, 1))


def test_neighbours_support_a_match_up_to_half_of_their_mapped_distance() -> None:
    """The points of image 2 are 40 px apart and 15 px, or 30 px, up and down."""
    points1 = row_of(9, 10.0)
    up_and_down = np.stack([np.zeros(9), np.arange(9) % 2], axis=1)
    points2 = 4.0 * points1 + 15.0 * up_and_down
    assert _num_supporting(points1, points2, maps(4.0, 9)).tolist() == [8] * 9
    points2 += 15.0 * up_and_down  # too far off of the next ones on both sides
    found = _num_supporting(points1, points2, maps(4.0, 9))
    assert found.tolist() == [7, *[6] * 7, 7]


def test_matches_that_are_at_one_place_in_either_image_do_not_support_each_other() -> (
    None
):
    apart = row_of(5, 30.0)
    together = row_of(5, 0.5)
    assert not _num_supporting(apart, together, maps(1.0 / 60.0, 5)).any()
    assert not _num_supporting(together, apart, maps(60.0, 5)).any()
    assert _num_supporting(apart, 0.2 * apart, maps(0.2, 5)).tolist() == [4] * 5


def test_matches_are_duplicates_of_better_ones_that_stay() -> None:
    """The second one is beside the first one; the third one only beside the second one."""
    points = row_of(4, 1.9)
    far = row_of(4, 50.0)
    assert without_duplicates(points, points, 2.0).tolist() == [True, False] * 2
    assert without_duplicates(points, far, 2.0).all()
    assert without_duplicates(far, points, 2.0).all()
