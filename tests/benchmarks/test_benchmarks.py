"""The commands that BENCHMARKS.md names start."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted(
    set(re.findall(r"tests/benchmarks/\w+\.py", (ROOT / "BENCHMARKS.md").read_text()))
)


def run_script(script: str, *arguments: object) -> str:
    command = [sys.executable, script, *map(str, arguments)]
    return subprocess.run(
        command, check=True, capture_output=True, text=True, cwd=ROOT
    ).stdout


@pytest.mark.long
@pytest.mark.parametrize("script", SCRIPTS)
def test_benchmark_starts(script: str) -> None:
    assert "usage:" in run_script(script, "--help")


@pytest.mark.long
def test_speed_and_complexity_are_measured(tmp_path: Path) -> None:
    photos = ["--image-path", "sample_scenes/courtyard/images", "--num-rounds", 1]
    result = tmp_path / "speed.json"
    given = [*photos, "--num-images", 2, "--methods", "sift", "unrectified-rootsift"]
    text = run_script("tests/benchmarks/speed.py", *given, "--output-path", result)
    assert '"extract_s"' in result.read_text()
    assert "| unrectified-rootsift | " in text
    given = [*photos, "--num-images", 1, "--methods", "rectified"]
    assert "| rectified | " in run_script("tests/benchmarks/complexity.py", *given)
