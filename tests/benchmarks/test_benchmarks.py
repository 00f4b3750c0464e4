"""The commands that BENCHMARKS.md names start, and the functions whose time they take exist."""

from __future__ import annotations

import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from speed_by_core import STAGES

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(set(re.findall(r"tests/benchmarks/\w+\.py", (ROOT / "BENCHMARKS.md").read_text())))


def test_benchmarks_are_named() -> None:
    assert "tests/benchmarks/speed.py" in SCRIPTS


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS)
def test_benchmark_starts(script: str) -> None:
    command = [sys.executable, script, "--help"]
    assert (
        "usage:"
        in subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    )


def test_functions_whose_time_is_taken_exist() -> None:
    for name in STAGES:
        assert callable(pkgutil.resolve_name(name))
