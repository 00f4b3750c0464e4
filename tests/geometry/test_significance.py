"""Significance of inliers and of the agreement of frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from colmap_affrect.geometry.significance import (
    log10_bayes_factor,
    log10_choose,
    log10_false_alarms,
    shuffled,
)


@pytest.mark.parametrize("num", [2, 3, 50, 9001])
def test_matches_paired_anew_are_no_matches(num: int) -> None:
    first, second = shuffled(num)
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
