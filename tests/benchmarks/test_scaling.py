"""The simulation of many photographs, by a case that is computed by hand."""

from __future__ import annotations

import pytest
from scaling import report, simulate

SMALLER = {"images": 5, "registered": 5, "map_s": 9.0}
LARGEST = {
    "images": 10, "pairs": 45, "registered": 10, "extract_s": 9.0, "match_s": 4.05, "verify_s": 8.1,
    "map_s": 36.0, "features": 1000, "features_bytes": 50_000_000, "matches_bytes": 900_000,
    "database_bytes": 69_000,
}  # fmt: skip
COSTS = {"cores": 4, "core_gflops": 8.192, "runs": [SMALLER, LARGEST]}
"""3.6 core seconds an image, 0.36 a pair matched, 0.72 verified; mapping grows with the square."""


def test_all_pairs_and_neighbors() -> None:
    everything = simulate(COSTS, 1000, None, 100)
    assert everything.num_pairs == 499_500
    expected_bytes = [5e9, 9.99e9, 2.4e6 + 499_500 * 1000, 0.0]
    assert list(everything.num_bytes.values()) == pytest.approx(expected_bytes)
    hours = [0.0, 1.0, 49.95, 99.9, 10 * 0.01 * 10**2]
    assert list(everything.core_hours.values()) == pytest.approx(hours)
    assert everything.one_map_hours == pytest.approx(0.01 * 100**2)
    few = simulate(COSTS, 1000, 20, 100)
    assert few.num_pairs == 20_000
    # A million comparisons of 256 x 128 elements, 8 microseconds each at 8.192 GFLOP/s.
    hours = [8.0 / 3600.0, 1.0, 2.0, 4.0, 10.0]
    assert list(few.core_hours.values()) == pytest.approx(hours)
    assert few.num_bytes["image vectors in memory"] == 65_536_000
    assert simulate(COSTS, 5, 20, 100).num_pairs == 10
    assert report({"few": few}, 4, 2.0).splitlines()[-1].endswith("| 4.25 h, 9 USD |")
