"""Runs that are killed, ended and interrupted at random moments, and run again.

Many more: tests/benchmarks/campaign.py; of other commands: test_campaign.py.
"""

from __future__ import annotations

import random
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from command import FAST, run_in_process_of_its_own
from results import Undisturbed, end_again_and_again, results, run_arguments


def finish(photos: Path, out: Path, options: Sequence[str]) -> dict[str, Any]:
    """Run to the end and return the results."""
    ended = run_in_process_of_its_own(*run_arguments(photos, out, options))
    assert ended.code == 0, ended.stderr
    return results(out)


@pytest.mark.long
def test_run_ended_again_and_again_has_the_results_of_an_undisturbed_one(
    photos: Path, tmp_path: Path, undisturbed: Undisturbed
) -> None:
    expected, worked_s = undisturbed.results, undisturbed.worked_s
    signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
    chance = random.Random(4)
    out = tmp_path / "out"
    end_again_and_again(photos, out, FAST, worked_s, signals, chance)
    assert finish(photos, out, FAST) == expected
