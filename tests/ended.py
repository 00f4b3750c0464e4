"""Runs that are ended while they are at work."""

from __future__ import annotations

import random
import shutil
import signal
import time
from collections.abc import Sequence
from pathlib import Path

import h5py
from command import start
from results import run_arguments, wait_until_at_work

from colmap_affrect.colmap.database import open_database
from colmap_affrect.project.atomic_files import journal_of
from colmap_affrect.project.workspace import Workspace


def end_after(delay_s: float, number: signal.Signals, arguments: Sequence[str], out: Path) -> bool:
    """Start a run and send it a signal; tell whether it was still at work then."""
    with start(*arguments) as process:
        wait_until_at_work(process, out)
        time.sleep(delay_s)
        process.send_signal(number)
        _, stderr = process.communicate(timeout=300)
    assert "Traceback" not in stderr, stderr
    ended = -number if number == signal.SIGKILL else 128 + number
    assert process.returncode in (0, ended), stderr
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
) -> list[str]:
    """End runs in one folder at random moments, each while it is at work.

    Returns:
        The stages that were the last to have begun at these moments.
    """
    stages = []
    for index, number in enumerate(signals):
        # What is done stays done: later runs are nearer to their end.
        delay_s = chance.uniform(0.0, worked_s / (index + 1))
        while not end_after(delay_s, number, run_arguments(photos, out, options), out):
            shutil.rmtree(out)
            delay_s /= 2
        assert_readable(out)
        stages.append((Workspace(out).recorded().get("begun") or ["start"])[-1])
    return stages
