"""The commands that BENCHMARKS.md names start."""

from __future__ import annotations

import json
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


@pytest.mark.long
def test_whole_runs_are_timed_in_turn_and_judged(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    result = tmp_path / "whole.json"
    diagram = tmp_path / "whole.png"
    given = ["--scenes-path", "sample_scenes", "--sets", "courtyard:3"]
    given += ["--peers", "sift-colmap", "rectified", "--num-rounds", "1"]
    written = ["--output-path", result, "--diagram-path", diagram]
    text = run_script("tests/benchmarks/whole_run.py", *given, *written)
    runs = json.loads(result.read_text())["runs"]
    assert [run["correct"] for run in runs] == [0, 3]
    for run in runs:
        assert 0.0 < sum(run["stages_s"].values()) < run["wall_s"]
    assert "| courtyard:3 | 3 | rectified | " in text
    assert diagram.read_bytes().startswith(b"\x89PNG")
