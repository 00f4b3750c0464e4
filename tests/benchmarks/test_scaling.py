"""Tests of the simulation of many photographs, by cases that are computed by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from scaling import (
    Machine,
    UnitCosts,
    loads_table,
    machines_table,
    memory_table,
    read_machines,
    simulate,
)

COSTS = UnitCosts(
    extract_s=3.6,
    match_s=0.36,
    verify_s=0.72,
    map_s=36.0,
    num_mapped=10,
    map_exponent=2.0,
    features_bytes=5e6,
    matches_bytes=2e4,
    database_image_bytes=1e5,
    database_pair_bytes=1e3,
    core_gflops=8.192,
)


def test_unit_costs_are_those_of_the_largest_run() -> None:
    rows = [
        {
            "images": images,
            "pairs": images * (images - 1) // 2,
            "registered": images,
            "extract_s": 1.5 * images,
            "match_s": 0.25 * images * (images - 1),
            "verify_s": 3.0,
            "map_s": 0.5 * images**3,
            "features_bytes": 7000 * images,
            "matches_bytes": 11 * images * (images - 1) // 2,
            "features": 10 * images,
            "database_bytes": 240 * images + 5 * images * (images - 1) // 2,
        }
        for images in (2, 4, 8)
    ]
    results = {"cores": 4, "peaks": {"gflops_one": 9.0}, "images": {"default": rows}}
    costs = UnitCosts.from_results(results, "default")
    assert costs.extract_s == 6.0  # 1.5 s on 4 cores
    assert costs.match_s == 2.0
    assert costs.verify_s == pytest.approx(12.0 / 28.0)
    assert (costs.map_s, costs.num_mapped) == (256.0, 8)
    assert costs.map_exponent == pytest.approx(3.0)
    assert (costs.features_bytes, costs.matches_bytes) == (7000.0, 11.0)
    assert costs.database_image_bytes == 240.0
    assert costs.database_pair_bytes == 5.0


def test_all_pairs() -> None:
    load = simulate(COSTS, 1000, None, 100)
    assert load.num_pairs == 499_500
    assert load.pairs_hours == 0.0
    assert load.extract_hours == pytest.approx(1.0)
    assert load.match_hours == pytest.approx(49.95)
    assert load.verify_hours == pytest.approx(99.9)
    assert load.map_hours == pytest.approx(0.01 * 100**2)
    assert load.cluster_hours == pytest.approx(10 * 0.01 * 10**2)
    assert load.features_bytes == 5e9
    assert load.matches_bytes == pytest.approx(9.99e9)
    assert load.database_bytes == pytest.approx(1e8 + 4.995e8)


def test_neighbors() -> None:
    load = simulate(COSTS, 1000, 20, 100)
    assert load.num_pairs == 20_000
    assert load.match_hours == pytest.approx(2.0)
    # A million comparisons of 256 x 128 elements, 8 microseconds each at 8.192 GFLOP/s.
    assert load.pairs_hours == pytest.approx(8.0 / 3600.0)
    assert load.vectors_bytes == 65_536_000
    assert simulate(COSTS, 5, 20, 100).num_pairs == 10


def test_tables() -> None:
    load = replace(simulate(COSTS, 1000, 20, 100), pairs_hours=0.0)
    assert load.shared_hours == pytest.approx(1.0 + 2.0 + 4.0 + 10.0)
    rows = loads_table([("near", load)]).splitlines()
    assert "| pairs | 20,000 |" in rows
    assert "| `matches.h5` | 400 MB |" in rows
    assert "| mapping, one incremental model | 4.17 days |" in rows
    machine = Machine("small", 4, 0.5, 2.0)
    assert "| 4.25 h, 8 USD |" in machines_table([machine], [("near", load)])
    assert "| small | 0.22 |" in memory_table([machine], [("near", load)])


def test_machines_of_the_file() -> None:
    machines = read_machines(Path(__file__).with_name("machines.toml"))
    assert all(machine.cores > 0 and machine.usd_per_hour > 0.0 for machine in machines)
