"""Tests of the tables of the speed benchmark and of the counted work."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from machine import PeakMemory, Peaks
from speed_growth import growth_exponent
from speed_report import commands_table, growth_table, images_table, stages_tables, with_ratio
from speed_stages import (
    convolution_multiply_adds,
    cover_work,
    gaussian_taps,
    matching_work,
    scale_space_work,
    timed_functions,
    warp_work,
)
from stage_clock import StageClock, Work

from colmap_affrect.geometry.tilts import cover_shapes, metrics_from_tilts
from colmap_affrect.options import DogOptions, ExtractionOptions
from colmap_affrect.types import Rectification

ROW = {
    "images": 2, "pairs": 1, "extract_s": 4.0, "match_s": 0.5, "verify_s": 0.25, "map_s": 3.0,
    "features": 600, "inliers": 90, "registered": 2, "peak_mib": 100.0, "features_bytes": 2**20,
    "matches_bytes": 0, "database_bytes": 2**21,
}  # fmt: skip


def test_ratios_are_by_round() -> None:
    assert with_ratio([3.0, 8.0, 2.0], [1.0, 4.0, 4.0]) == "3 s, 2.00 [0.50-3.00]"


def test_commands() -> None:
    slower = {**ROW, "extract_s": 6.0, "peak_mib": 250.0}
    lines = commands_table({"sift": [ROW, ROW], "ours": [slower, ROW]}).splitlines()
    assert lines[-1].startswith("| ours | 2.5 s, 1.25 [1.00-1.50] | 0.5 s, 1.00 [1.00-1.00] |")
    assert lines[-1].endswith("| 3 s | 300 | 125 | 90 | 250 MiB |")


def test_stages_against_the_limit() -> None:
    peaks = Peaks(gflops_one=20.0, gflops_all=40.0, gbytes_one=5.0, gbytes_all=5.0)
    assert peaks.limit_s(Work(1e9, 0.0)) == pytest.approx(0.1)
    assert peaks.limit_s(Work(1e9, 1e9)) == pytest.approx(0.2)
    seconds = [{"warp": 1.0, "detect": 2.0, "match": 9.0}, {"warp": 1.0, "detect": 4.0, "match": 9}]
    result = {"seconds": seconds, "work": {"detect": [1e9, 0.0]}}
    lines = stages_tables({"ours": result}, peaks).splitlines()
    assert "| warp | 1.000 [1.000-1.000] | 25 % |  |  |  |" in lines
    assert "| detect | 3.000 [2.000-4.000] | 75 % | 1.000 | 0.1000 | 30.0 |" in lines
    assert lines.index("| **an image** | **4** | 100 % |  |  |  |") == len(lines) - 2


def test_growth() -> None:
    curve = [(size, 0.5 * size**1.5) for size in (1.0, 3.0, 10.0)]
    assert growth_exponent(curve) == pytest.approx(1.5)
    text = growth_table({"a": curve, "b": [(s, s) for s, _ in curve]}, "n", "{:.0f}".format, "T")
    assert text.splitlines()[-2:] == ["| 10 | 15.8 s | 10 s |", "| exponent | 1.50 | 1.00 |"]
    rows = [{**ROW, "images": count, "map_s": count**2.0} for count in (2, 4)]
    assert images_table({"ours": rows}).splitlines()[-1].endswith("power of: ours 2.00.")


def test_every_function_of_a_stage_is_there() -> None:
    with StageClock().watching(timed_functions(ExtractionOptions())):
        pass


def test_work_of_filters() -> None:
    assert gaussian_taps(1.5) == 13
    options = DogOptions(num_octave_layers=3, sigma_px=1.6)
    work = scale_space_work(900, options)
    # Steps of 1.23, 1.55, 1.95, 2.45, 3.09 px: 11, 13, 17, 21, 27 taps along both axes;
    # 5 differences, 3 layers of 26 comparisons; the octaves have 16/3 of the pixels.
    assert work.multiply_adds == 4800 * (2 * 89 + 5 + 78)
    assert work.num_bytes == 4800 * 11 * 8


def test_work_of_a_warp() -> None:
    tilt = 2.5
    matrix = np.diag([math.sqrt(tilt), 1.0 / math.sqrt(tilt), 1.0])
    rectification = Rectification(matrix, (20, 10), None, tilt, 0.0)
    work = warp_work(np.zeros((10, 20), np.uint8), np.zeros((9, 9), np.uint8), rectification)
    # Three rows for each; sigma = 0.8 sqrt(5.25) 3 / 2.5 = 2.2 rows, 15 taps.
    assert work == Work(200 * (3 * 4 + 15), pytest.approx(400.0))


def test_work_of_a_cover() -> None:
    metrics = metrics_from_tilts([1.0, 3.0, 3.0, 9.0], [0.0, 0.5, 0.5, 0.0])
    weights = np.ones(4)
    options: dict[str, Any] = {
        "radius": 1.7,
        "max_tilt": 5.8,
        "covered_frac": 1.0,
        "max_num_centers": 5,
    }
    cover = cover_shapes(metrics, weights, **options)
    work = cover_work(cover, metrics, weights, **options)
    assert len(cover.centers) == 1
    assert work.multiply_adds == 2 * 192 * (3 + 1) + 4 * 3 * 2


def test_work_of_matching() -> None:
    assert matching_work(10, 20, 128) == Work(25600.0, 30 * 512)


@pytest.mark.slow  # loads torch
def test_work_of_a_network() -> None:
    from torch import nn

    network = nn.Sequential(
        nn.Conv2d(1, 4, 3, padding=1), nn.MaxPool2d(2, 2), nn.Conv2d(4, 6, 3, padding=1, stride=2)
    )
    assert convolution_multiply_adds(network, 8) == 4 * 9 * 64 + 4 * 6 * 9 * 4


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not tell")
def test_peak_memory_is_of_the_block() -> None:
    np.ones(1 << 27, np.uint8)
    with PeakMemory() as memory:
        np.ones(1 << 26, np.uint8)
    assert memory.mib is not None
    assert 60.0 < memory.mib < 90.0
