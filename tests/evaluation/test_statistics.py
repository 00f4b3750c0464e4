"""Intervals and paired tests against known distributions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from colmap_affrect.evaluation.statistics import bootstrap_intervals, paired_test


def interval_of_mean(values: np.ndarray, seed: int) -> tuple[float, float]:
    (interval,) = bootstrap_intervals(len(values), lambda rows: [values[rows].mean()], seed)
    return interval


def test_interval_of_a_mean_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    half_width = 1.96 * values.std() / math.sqrt(400)
    expected = values.mean() - half_width, values.mean() + half_width
    assert interval_of_mean(values, 0) == pytest.approx(expected, abs=0.02)


def test_interval_covers_the_truth_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    intervals = [interval_of_mean(rng.random(80) < 0.3, seed) for seed in range(40)]
    assert 34 <= sum(low <= 0.3 <= high for low, high in intervals) <= 40


def test_intervals_of_several_statistics_do_not_mix() -> None:
    values = np.array([1.0, math.inf, 3.0, 8.0, 2.0, math.inf, 4.0])

    def shares(rows: np.ndarray) -> list[float]:
        return [float((values[rows] < limit).mean()) for limit in (5, math.inf)]

    below, finite = bootstrap_intervals(7, shares, 0)
    assert 0 <= below[0] < 4 / 7 < below[1] <= 1
    assert 0 < finite[0] < 5 / 7 < finite[1] <= 1
    assert finite > below
    assert bootstrap_intervals(7, shares, 0) == [below, finite]
    assert bootstrap_intervals(1, shares, 1) == [(1.0, 1.0)] * 2
    with pytest.raises(ValueError, match="no values"):
        bootstrap_intervals(0, shares, 0)


def test_paired_test_of_ones_and_zeros_is_the_sign_test() -> None:
    # Five pairs that only the first solves, one that only the second does: 14 of 64 ways.
    a = [1, 1, 1, 1, 1, 0, 1, 0]
    b = [0, 0, 0, 0, 0, 1, 1, 0]
    assert paired_test(a, b, 0) == pytest.approx(14 / 64)
    assert paired_test(b, a, 0) == pytest.approx(14 / 64)


def test_paired_test_ranks_differences_and_takes_failures_as_the_largest() -> None:
    # Signed ranks -1, +2, +3 (infinite): the sum 4 or more of either sign in 4 of 8 ways.
    assert paired_test([1.0, 5.0, math.inf, math.inf], [1.5, 2.0, 7.0, math.inf], 0) == 0.5


def test_equal_methods_do_not_differ() -> None:
    assert paired_test([1.0, math.inf], [1.0, math.inf], 0) == 1.0
    assert paired_test([], [], 0) == 1.0


def test_random_signs_agree_with_all_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    a = [3.0, 1.0, 4.0, 1.5, 5.0, 9.0, 2.0, 6.0]
    b = [2.0, 0.5, 1.0, 2.5, 3.0, 4.0, 2.2, 1.0]
    exact = paired_test(a, b, 0)
    monkeypatch.setattr("colmap_affrect.evaluation.statistics.MAX_ENUMERATED", 0)
    assert paired_test(a, b, 0) == pytest.approx(exact, abs=0.01)


def test_different_numbers_of_values_are_refused() -> None:
    with pytest.raises(ValueError, match="2 values against 1"):
        paired_test([1.0, 2.0], [1.0], 0)
