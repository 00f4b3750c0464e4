"""The same seed gives the same results, also with another number of cores."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from command import CAMERA, start
from results import results

from colmap_affrect.parallel.executor import available_cores

OPTIONS = [*CAMERA, "--random-seed", 7, "-q"]


def run_on_cores(cores: set[int], photos: Path, out: Path) -> dict[str, object]:
    """Run on some of the cores only, in a process of its own."""
    usual = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # which the process inherits
    try:
        process = start("run", "--image-path", photos, "--output-path", out, *OPTIONS)
    finally:
        os.sched_setaffinity(0, usual)
    with process:
        _, stderr = process.communicate(timeout=120)
    assert process.returncode == 0, stderr
    return results(out)


@pytest.mark.long
@pytest.mark.skipif(available_cores() < 2, reason="needs two cores")
def test_results_do_not_depend_on_the_run_nor_on_the_number_of_cores(
    photos: Path, tmp_path: Path
) -> None:
    cores = sorted(os.sched_getaffinity(0))
    one = run_on_cores({cores[0]}, photos, tmp_path / "one")
    assert one["registered"]
    assert run_on_cores(set(cores[:2]), photos, tmp_path / "two") == one
