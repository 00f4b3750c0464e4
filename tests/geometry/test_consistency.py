"""Neighbours, matches that support each other, and significance of their numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import Array

from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.neighbors import neighbors_within, num_consistent_matches
from colmap_affrect.geometry.significance import (
    log10_bayes_factor,
    log10_choose,
    log10_false_alarms,
    random_matches,
)

SIZE = np.array([1200.0, 700.0])
MAP = np.array(
    [[2.6, 0.9, 40.0], [-0.4, 1.2, 310.0]]
)  # neither its transpose nor its inverse


def random_lafs(count: int, seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    angles = random.uniform(0, 2 * np.pi, count)
    radii = random.uniform(3, 30, count)
    return lafs_from_keypoints(random.uniform(0, SIZE, (count, 2)), radii, angles)


def mapped(lafs: np.ndarray) -> np.ndarray:
    moved = MAP[:, :2] @ lafs
    moved[:, :, 2] += MAP[:, 2]
    return moved


@pytest.mark.parametrize("num_wrong", [0, 150])
def test_right_matches_are_counted_among_wrong_ones(num_wrong: int) -> None:
    first = random_lafs(40 + num_wrong, 1)
    first[:40, :, 2] /= [6.0, 4.0]  # a part of the image that is seen in both
    second = np.concatenate([mapped(first[:40]), random_lafs(num_wrong, 2)])
    count = num_consistent_matches(first, second)
    assert 34 <= count <= 42
    assert num_consistent_matches(second, first) == count


def test_wrong_matches_do_not_support_each_other() -> None:
    for seed in range(5):
        first = random_lafs(300, seed)
        second = random_lafs(300, seed + 100)
        assert num_consistent_matches(first, second) <= 1


def test_lafs_that_contradict_the_positions_support_nothing() -> None:
    first = random_lafs(40, 3)
    second = mapped(first)
    second[:, :, :2] = second[:, :, :2] @ np.array([[0.0, -1.0], [1.0, 0.0]])
    assert num_consistent_matches(first, second) == 0


def test_matches_that_are_a_tenth_of_their_distance_off_support_each_other() -> None:
    """Surfaces are not plane, and keypoints not exact."""
    first = random_lafs(40, 1)
    first[:, :, 2] /= [6.0, 4.0]
    second = mapped(first)
    second[:, :, 2] += np.random.default_rng(5).normal(0.0, 3.0, (40, 2))
    assert num_consistent_matches(first, second) > 34


def test_matches_ten_pixels_apart_support_each_other() -> None:
    """They are of several points; those at one position are of one."""
    first = random_lafs(25, 6)
    columns, rows = np.meshgrid(np.arange(5), np.arange(5))
    first[:, :, 2] = 300.0 + 9.0 * np.stack([columns.ravel(), rows.ravel()], axis=1)
    assert num_consistent_matches(first, mapped(first)) == 25


def test_matches_at_one_position_are_no_neighbours() -> None:
    first = random_lafs(30, 4)
    first[:, :, 2] = 500.0 + first[:, :, 2] / 1000.0
    assert num_consistent_matches(first, mapped(first)) == 0


@pytest.mark.parametrize("num", [2, 3, 50, 9001])
def test_random_matches_are_no_matches_of_the_pair(num: int) -> None:
    first, second = random_matches(num)
    assert len(first) == len(second) >= min(num * (num - 1), 4000 - num)
    assert (first != second).all()
    assert set(first) == set(second) == set(range(num))
    assert len(set(zip(first.tolist(), second.tolist(), strict=True))) == len(first)


def test_false_alarms_are_those_of_the_formula() -> None:
    assert log10_choose(9, 4) == pytest.approx(math.log10(126))
    expected = math.log10((40 - 7) * math.comb(40, 12) * math.comb(12, 7) * 0.02**5)
    assert log10_false_alarms(40, 12, 7, 0.02) == pytest.approx(expected)
    assert log10_false_alarms(40, 7, 7, 0.02) == math.inf


def test_factor_is_fair_under_chance() -> None:
    # Its mean over what chance brings is 1: it may be multiplied with the false alarms.
    counts = np.arange(13)
    chances = np.array([math.comb(12, n) * 0.3**n * 0.7 ** (12 - n) for n in counts])
    factors = np.array([10 ** log10_bayes_factor(12, n, 0.3) for n in counts])
    assert chances @ factors == pytest.approx(1.0)


def test_fewer_agreeing_lafs_than_half_speak_against_a_pair() -> None:
    assert log10_bayes_factor(40, 10, 0.1) < -1.0
    assert log10_bayes_factor(40, 24, 0.1) > 1.0


# Eighths are exact in binary, so points at exactly the radius are no matter of rounding.
coordinates = st.integers(-400, 400).map(lambda eighths: eighths / 8)
point_sets = st.lists(st.tuples(coordinates, coordinates), max_size=60).map(
    lambda points: np.array(points, dtype=float).reshape(-1, 2)
)
radii = st.sampled_from([0.125, 0.625, 1.25, 5.0, 12.5, 200.0])


def all_neighbors(points: Array, radius: float) -> list[list[int]]:
    """Neighbours by comparing every pair."""
    squares = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return [np.flatnonzero(row <= radius**2).tolist() for row in squares]


@given(point_sets, radii)
def test_neighbors_within_equals_all_distances(points: Array, radius: float) -> None:
    lists = neighbors_within(points, radius)
    assert lists.starts.shape == (len(points) + 1,)
    actual = [
        sorted(lists.indices[begin:end].tolist())
        for begin, end in zip(lists.starts[:-1], lists.starts[1:], strict=True)
    ]
    assert actual == all_neighbors(points, radius)


def test_right_pairs_agree_more_often_than_chance_where_that_agrees_often() -> None:
    """The ratio is anything from that of chance, which is above a half, to all."""
    steps = 0.8 + 0.2 * np.arange(50) / 50.0
    factors = (steps / 0.8) ** 18 * ((1.0 - steps) / 0.2) ** 2
    expected = math.log10(factors.mean())
    assert log10_bayes_factor(20, 18, 0.8) == pytest.approx(expected)
