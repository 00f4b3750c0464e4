"""Writes that fail: one clear line, nothing lost that was done, and the same results later.

A limit on the size of files stands for a full disk: what goes beyond it fails in the same calls.
"""

from __future__ import annotations

import errno
import os
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from command import FAST, Call, Ended
from results import Undisturbed, results, run_arguments

from colmap_affrect.project.atomic_files import FileTransaction
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace

pytestmark = pytest.mark.long


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@dataclass(frozen=True)
class Disturbed:
    """A run whose writes are to fail, and one that nothing disturbed."""

    photos: Path
    workspace: Workspace
    undisturbed: Undisturbed
    call: Call

    @property
    def out(self) -> Path:
        return self.workspace.path

    @property
    def arguments(self) -> list[str]:
        return run_arguments(self.photos, self.out, FAST)

    def run(self) -> Ended:
        return self.call(*self.arguments)

    def begin_without(self, *names: str) -> None:
        """Begin with the undisturbed run as it was before it made some of its files."""
        shutil.copytree(self.undisturbed.out, self.out)
        for name in (*names, "report.json", "sparse"):
            path = self.out / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    def assert_finishes(self) -> None:
        """Run again and have the same results."""
        assert self.run().code == 0
        assert results(self.out) == self.undisturbed.results


@pytest.fixture
def disturbed(photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call) -> Disturbed:
    return Disturbed(photos, Workspace(tmp_path / "out"), undisturbed, call)


def assert_says_what_to_do(ended: Ended, path: Path) -> None:
    """One line that names a file and says to free space."""
    assert (ended.code, ended.stdout) == (1, "")
    (line,) = ended.stderr
    assert line.startswith(f"error: {path}: ")
    assert "free space" in line
    assert "run the same command again" in line


@pytest.mark.parametrize("passing", [2, 4])
def test_hdf5_write_that_fails_loses_nothing_else(
    disturbed: Disturbed, monkeypatch: pytest.MonkeyPatch, passing: int
) -> None:
    workspace, calls = disturbed.workspace, []
    commit = FileTransaction.commit

    def full(changes: FileTransaction) -> None:
        calls.append(changes)
        if len(calls) > passing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        commit(changes)

    with monkeypatch.context() as patch:
        patch.setattr(FileTransaction, "commit", full)
        ended = disturbed.run()
    assert_says_what_to_do(ended, workspace.features if passing < 4 else workspace.matches)
    assert "No space left on device" in ended.stderr[0]
    assert len(FeatureStore(workspace.features).names()) == passing
    disturbed.assert_finishes()


def test_record_of_options_that_does_not_fit_on_the_disk(disturbed: Disturbed) -> None:
    with file_size_limit(700):
        ended = disturbed.run()
    assert_says_what_to_do(ended, disturbed.workspace.config)
    assert not disturbed.workspace.config.exists()
    assert not disturbed.workspace.features.exists()


def test_model_that_does_not_fit_on_the_disk_is_not_taken_for_whole(disturbed: Disturbed) -> None:
    # pycolmap writes what fits and says nothing.
    disturbed.begin_without("database.db.seal")  # as after a kill
    with file_size_limit(50_000):
        ended = disturbed.run()
    assert_says_what_to_do(ended, disturbed.out / "sparse.partial" / "0")
    assert not disturbed.workspace.sparse.exists()
    assert not disturbed.workspace.report.exists()
    disturbed.assert_finishes()
