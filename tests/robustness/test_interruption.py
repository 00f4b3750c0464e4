"""Runs that are killed, whose disk is full, or that have fewer cores leave the same results.

Many more kills: tests/benchmarks/campaign.py. A limit on the size of files stands for a full disk:
what goes beyond it fails in the same calls.
"""

from __future__ import annotations

import errno
import os
import random
import resource
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from command import CAMERA, FAST, Call, Ended, start
from results import Undisturbed, end_again_and_again, results, run_arguments, run_undisturbed

from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.atomic_files import FileTransaction
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace

pytestmark = pytest.mark.long

Run = Callable[[], Ended]


@pytest.fixture(scope="module")
def undisturbed(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """A finished run of the small scene; nothing may be changed in it."""
    return run_undisturbed(photos, tmp_path_factory.mktemp("undisturbed") / "out", FAST)


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace(tmp_path / "out")


@pytest.fixture
def run(photos: Path, workspace: Workspace, call: Call) -> Run:
    """Run in the folder of the test."""
    return lambda: call(*run_arguments(photos, workspace.path, FAST))


def test_run_ended_again_and_again_has_the_results_of_an_undisturbed_one(
    photos: Path, workspace: Workspace, run: Run, undisturbed: Undisturbed
) -> None:
    signals = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGKILL)
    chance, worked_s = random.Random(4), undisturbed.worked_s
    end_again_and_again(photos, workspace.path, FAST, worked_s, signals, chance)
    assert run().code == 0
    assert results(workspace.path) == undisturbed.results


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


def assert_says_what_to_do(ended: Ended, path: Path) -> None:
    """One line that names a file and says to free space."""
    assert (ended.code, ended.stdout) == (1, "")
    (line,) = ended.stderr
    assert line.startswith(f"error: {path}: ")
    assert "free space" in line
    assert "run the same command again" in line


@pytest.mark.parametrize("passing", [2, 4])
def test_hdf5_write_that_fails_loses_nothing_else(
    workspace: Workspace,
    run: Run,
    undisturbed: Undisturbed,
    monkeypatch: pytest.MonkeyPatch,
    passing: int,
) -> None:
    calls, commit = [], FileTransaction.commit

    def full(changes: FileTransaction) -> None:
        calls.append(changes)
        if len(calls) > passing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        commit(changes)

    with monkeypatch.context() as patch:
        patch.setattr(FileTransaction, "commit", full)
        ended = run()
    assert_says_what_to_do(ended, workspace.features if passing < 4 else workspace.matches)
    assert len(FeatureStore(workspace.features).names()) == passing
    assert run().code == 0
    assert results(workspace.path) == undisturbed.results


def test_record_of_options_that_does_not_fit_on_the_disk(workspace: Workspace, run: Run) -> None:
    with file_size_limit(700):
        assert_says_what_to_do(run(), workspace.config)
    assert not workspace.config.exists()
    assert not workspace.features.exists()


def test_model_that_does_not_fit_on_the_disk_is_not_taken_for_whole(
    workspace: Workspace, run: Run, undisturbed: Undisturbed
) -> None:
    # pycolmap writes what fits and says nothing.
    shutil.copytree(undisturbed.out, workspace.path)
    shutil.rmtree(workspace.sparse)
    workspace.report.unlink()
    (workspace.path / "database.db.seal").unlink()  # as after a kill
    with file_size_limit(50_000):
        assert_says_what_to_do(run(), workspace.path / "sparse.partial" / "0")
    assert not workspace.sparse.exists()
    assert not workspace.report.exists()
    assert run().code == 0
    assert results(workspace.path) == undisturbed.results


def run_on_cores(cores: set[int], photos: Path, out: Path) -> dict[str, object]:
    """Run on some of the cores only, in a process of its own."""
    usual = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)  # which the process inherits
    try:
        process = start(*run_arguments(photos, out, [*CAMERA, "--random-seed", 7]))
    finally:
        os.sched_setaffinity(0, usual)
    with process:
        _, stderr = process.communicate(timeout=120)
    assert process.returncode == 0, stderr
    return results(out)


@pytest.mark.skipif(available_cores() < 2, reason="needs two cores")
def test_results_do_not_depend_on_the_number_of_cores(photos: Path, tmp_path: Path) -> None:
    cores = sorted(os.sched_getaffinity(0))
    one = run_on_cores({cores[0]}, photos, tmp_path / "one")
    assert one["registered"]
    assert run_on_cores(set(cores[:2]), photos, tmp_path / "two") == one
