"""Positions that receivers write, and which of them are on earth."""

from __future__ import annotations

import numpy as np
import pytest

from colmap_affrect.geometry.earth import why_not_on_earth


@pytest.mark.parametrize(
    "position", [(47.5, 8.2, 400.0), (5e-6, 0.0, 0.0), (0.0, -3.0, 99_000.0)]
)
def test_positions_on_earth_are_taken(position: tuple[float, float, float]) -> None:
    assert why_not_on_earth(np.array(position)) == ""


@pytest.mark.parametrize(("position", "why"), [
    ((0.0, 0.0, 300.0), "no position was known"),
    ((5e-7, 0.0, 0.0), "no position was known"),
    ((47.5, 8.2, 150_000.0), "altitude 150000"),
    ((91.0, 8.2, 0.0), "latitude 91"),
    ((47.5, 361.0, 0.0), "longitude 361"),
    ((np.nan, 8.2, 0.0), "not finite"),
])  # fmt: skip
def test_other_positions_are_refused_with_the_reason(
    position: tuple[float, float, float], why: str
) -> None:
    assert why in why_not_on_earth(np.array(position))
