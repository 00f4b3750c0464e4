"""The commands that BENCHMARKS.md names start."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.long
def test_speed_is_measured(tmp_path: Path) -> None:
    result = tmp_path / "speed.json"
    command = [sys.executable, "tests/benchmarks/speed.py"]
    command += ["--image-path", "sample_scenes/courtyard/images", "--num-images", "2"]
    command += ["--num-rounds", "1", "--methods", "sift", "unrectified-rootsift"]
    subprocess.run([*command, "--output-path", result], check=True, capture_output=True, cwd=ROOT)
    assert '"extract_s"' in result.read_text()
