"""The fit of how sure a model is: weights of made-up photographs come out as they went in."""

from __future__ import annotations

import numpy as np
import pytest
from reliability import fitted, fitted_constant

WEIGHTS = np.array([2.0, 0.7])
CONSTANT = -0.5
NUM_PHOTOGRAPHS = 20_000


@pytest.mark.parametrize("least_factor", [1.0, 0.2])
def test_weights_are_found_also_where_something_else_makes_photographs_wrong(
    least_factor: float,
) -> None:
    random = np.random.default_rng(3)
    values = random.normal(size=(NUM_PHOTOGRAPHS, 2))
    factors = random.uniform(least_factor, 1.0, NUM_PHOTOGRAPHS)
    chances = factors / (1.0 + np.exp(-values @ WEIGHTS - CONSTANT))
    right = (random.uniform(size=NUM_PHOTOGRAPHS) < chances).astype(float)
    slopes, constant = fitted(values, right, factors)
    assert slopes == pytest.approx(WEIGHTS, rel=0.1)
    assert constant == pytest.approx(CONSTANT, abs=0.1)


def test_terms_that_speak_against_right_photographs_count_nothing() -> None:
    random = np.random.default_rng(4)
    values = random.normal(size=(2_000, 2))
    chances = 1.0 / (1.0 + np.exp(-values @ np.array([2.0, -1.0])))
    right = (random.uniform(size=2_000) < chances).astype(float)
    slopes, _ = fitted(values, right, np.ones(2_000))
    assert slopes[0] > 1.0
    assert slopes[1] == 0.0


def test_a_constant_comes_out_as_it_went_in() -> None:
    rng = np.random.default_rng(2)
    log_odds = rng.normal(0.0, 2.0, 20_000)
    factors = rng.uniform(0.5, 1.0, 20_000)
    chances = factors / (1.0 + np.exp(-log_odds - 0.6))
    right = (rng.uniform(size=20_000) < chances).astype(float)
    assert fitted_constant(log_odds, right, factors) == pytest.approx(0.6, abs=0.1)
