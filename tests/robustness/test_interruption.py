"""Runs that are killed, ended and interrupted at random moments, and run again."""

from __future__ import annotations

import random
import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import pytest
from command import FAST, run_in_process_of_its_own, start
from results import (
    Undisturbed,
    results,
    run_arguments,
    run_undisturbed,
    wait_until_at_work,
)

from colmap_affrect.colmap.database import open_database
from colmap_affrect.project.atomic_files import journal_of
from colmap_affrect.project.workspace import Workspace

COURTYARD = Path(__file__).parents[2] / "sample_scenes" / "courtyard" / "images"
COURTYARD_OPTIONS = ("--camera-mode", "single", "--set", "max_image_size_px=500")


def finish(photos: Path, out: Path, options: Sequence[str]) -> dict[str, Any]:
    """Run to the end and return the results."""
    ended = run_in_process_of_its_own(*run_arguments(photos, out, options))
    assert ended.code == 0, ended.stderr
    return results(out)


def end_after(delay_s: float, number: signal.Signals, arguments: Sequence[str], out: Path) -> bool:
    """Start a run and send it a signal; tell whether it was still at work then."""
    with start(*arguments) as process:
        wait_until_at_work(process, out)
        time.sleep(delay_s)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=120)
    assert "Traceback" not in stderr
    # Shells show 130 for both: Python ends by the signal itself if that came within an import.
    by_signal = (130, -number) if number == signal.SIGINT else (-number,)
    assert process.returncode in (0, *by_signal)
    return process.returncode != 0


def assert_readable(out: Path) -> None:
    """Every file that is there can be read as it lies there; an HDF5 file with its journal."""
    workspace = Workspace(out)
    workspace.recorded()
    for path in (workspace.features, workspace.matches):
        if path.exists() and not journal_of(path).exists():
            with h5py.File(path, "r") as file:
                file.visititems(lambda *_: None)
    if workspace.database.exists():
        with open_database(workspace.database) as database:
            database.read_all_images()


def end_again_and_again(
    photos: Path,
    out: Path,
    options: Sequence[str],
    worked_s: float,
    signals: Sequence[signal.Signals],
    chance: random.Random,
) -> None:
    """End runs in one folder at random moments, each while it is at work."""
    for index, number in enumerate(signals):
        # What is done stays done: later runs are nearer to their end.
        delay_s = chance.uniform(0.0, worked_s / (index + 1))
        while not end_after(delay_s, number, run_arguments(photos, out, options), out):
            shutil.rmtree(out)
            delay_s /= 2
        assert_readable(out)


@pytest.fixture(scope="module")
def courtyard(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    out = tmp_path_factory.mktemp("courtyard") / "out"
    return run_undisturbed(COURTYARD, out, COURTYARD_OPTIONS)


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


@pytest.mark.long
def test_two_runs_at_once_are_one_that_works_and_one_that_is_refused(
    photos: Path, tmp_path: Path, undisturbed: Undisturbed
) -> None:
    out = tmp_path / "out"
    arguments = run_arguments(photos, out, FAST)
    with start(*arguments) as first, start(*arguments) as second:
        printed = [process.communicate(timeout=120)[1] for process in (first, second)]
    assert sorted([first.returncode, second.returncode]) == [0, 1]
    refused = printed[first.returncode == 0].splitlines()
    assert len(refused) == 1
    assert "another colmap-affrect is working in this folder" in refused[0]
    assert results(out) == undisturbed.results


@pytest.mark.slow
@pytest.mark.parametrize("number", range(10))
def test_thirty_kills_on_a_sample_scene(
    tmp_path: Path, courtyard: Undisturbed, number: int
) -> None:
    expected, worked_s = courtyard.results, courtyard.worked_s
    out, kills, chance = tmp_path / "out", [signal.SIGKILL] * 3, random.Random(number)
    end_again_and_again(COURTYARD, out, COURTYARD_OPTIONS, worked_s, kills, chance)
    assert finish(COURTYARD, out, COURTYARD_OPTIONS) == expected
