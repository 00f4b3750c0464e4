"""Intervals and paired tests against known distributions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from colmap_affrect.evaluation.evaluate import bootstrap_interval, paired_test


def test_interval_of_a_mean_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(3).normal(5.0, 2.0, 400)
    half_width = 1.96 * values.std() / math.sqrt(400)
    expected = values.mean() - half_width, values.mean() + half_width
    assert bootstrap_interval(values, 0) == pytest.approx(expected, abs=0.02)


def test_paired_test_of_ones_and_zeros_is_the_sign_test() -> None:
    # Five pairs that only the first solves, one that only the second does: 14 of 64 ways.
    a = np.array([1.0, 1, 1, 1, 1, 0, 1, 0])
    b = np.array([0.0, 0, 0, 0, 0, 1, 1, 0])
    assert paired_test(a, b, 0) == paired_test(b, a, 0) == pytest.approx(14 / 64)
