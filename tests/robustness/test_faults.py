"""Writes that fail: one clear line, nothing lost that was done, and the same results later.

A limit on the size of files stands for a full disk: what goes beyond it fails in the same calls.
An output folder that cannot be made is in test_stages, failing writes one by one in test_files.
"""

from __future__ import annotations

import errno
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
from command import FAST, Call, Ended
from results import Undisturbed, results, run_arguments

from colmap_affrect.files import FileTransaction
from colmap_affrect.store import FeatureStore, MatchStore
from colmap_affrect.workspace import Workspace

pytestmark = pytest.mark.long


@contextmanager
def file_size_limit(num_bytes: int) -> Iterator[None]:
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


LIMITED_COMMAND = """
import resource, sys
import colmap_affrect.pipeline
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
from colmap_affrect.cli import main
sys.exit(main(sys.argv[2:]))
"""


def call_limited(num_bytes: int, *arguments: object) -> Ended:
    """Run a command in a process of its own, which pycolmap may abort."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED_COMMAND, str(num_bytes), *map(str, arguments)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return Ended(done.returncode, done.stdout, done.stderr.splitlines())


def assert_says_what_to_do(ended: Ended, path: Path) -> None:
    """One line that names a file and says to free space."""
    assert (ended.code, ended.stdout) == (1, "")
    (line,) = ended.stderr
    assert line.startswith(f"error: {path}: ")
    assert "free space" in line
    assert "run the same command again" in line


def copy_without(source: Path, target: Path, *names: str) -> Path:
    """Copy a finished run as it was before it made some of its files."""
    shutil.copytree(source, target)
    for name in (*names, "report.json", "sparse"):
        path = target / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    return target


@pytest.mark.parametrize("passing", [2, 4])
def test_hdf5_write_that_fails_loses_nothing_else(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call,
    monkeypatch: pytest.MonkeyPatch, passing: int,
) -> None:  # fmt: skip
    out, calls = tmp_path / "out", []
    commit = FileTransaction.commit

    def full(changes: FileTransaction) -> None:
        calls.append(changes)
        if len(calls) > passing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        commit(changes)

    with monkeypatch.context() as patch:
        patch.setattr(FileTransaction, "commit", full)
        ended = call(*run_arguments(small_photos, out, FAST))
    workspace = Workspace(out)
    failed = workspace.features if passing < 4 else workspace.matches
    assert_says_what_to_do(ended, failed)
    assert "No space left on device" in ended.stderr[0]
    assert len(FeatureStore(workspace.features).names()) == passing
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


def test_features_that_do_not_fit_on_the_disk(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    out = tmp_path / "out"
    with file_size_limit(undisturbed.out.joinpath("features.h5").stat().st_size * 2 // 3):
        ended = call(*run_arguments(small_photos, out, FAST))
        assert_says_what_to_do(ended, Workspace(out).features)
        assert call(*run_arguments(small_photos, out, FAST)).code == 1  # nor does it get worse
    assert 1 <= len(FeatureStore(Workspace(out).features).names()) < 4
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


def test_matches_that_do_not_fit_on_the_disk(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    out = ["--output-path", tmp_path / "out"]
    workspace = Workspace(tmp_path / "out")
    for command in (["extract", "--image-path", small_photos, *FAST], ["pairs"]):
        assert call(*command, *out, "-q").code == 0
    with file_size_limit(10_000):
        assert_says_what_to_do(call("match", *out, "-q"), workspace.matches)
    assert MatchStore(workspace.matches).names() == []
    assert call(*run_arguments(small_photos, workspace.path, FAST)).code == 0
    assert results(workspace.path) == undisturbed.results


def test_record_of_options_that_does_not_fit_on_the_disk(
    small_photos: Path, tmp_path: Path, call: Call
) -> None:
    out = tmp_path / "out"
    with file_size_limit(700):
        ended = call(*run_arguments(small_photos, out, FAST))
    assert_says_what_to_do(ended, Workspace(out).config)
    assert not Workspace(out).config.exists()
    assert not Workspace(out).features.exists()


def test_report_that_cannot_be_written(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    out = copy_without(undisturbed.out, tmp_path / "out")
    (out / "report.json.new").mkdir()
    assert_says_what_to_do(call(*run_arguments(small_photos, out, FAST)), out / "report.json")
    (out / "report.json.new").rmdir()
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


def test_new_database_that_does_not_fit_on_the_disk(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    # COLMAP would end the process in the middle of its images.
    out = copy_without(undisturbed.out, tmp_path / "out", "database.db")
    ended = call_limited(160_000, *run_arguments(small_photos, out, FAST))
    assert_says_what_to_do(ended, out / "database.db.new")
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


@pytest.mark.parametrize("emptied", [("keypoints", "matches"), ("matches",)])
def test_database_that_grows_too_large_for_the_disk(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call,
    emptied: tuple[str, ...],
) -> None:  # fmt: skip
    out = copy_without(undisturbed.out, tmp_path / "out")
    with closing(sqlite3.connect(out / "database.db", isolation_level=None)) as database:
        for table in ("two_view_geometries", *emptied):
            database.execute(f"DELETE FROM {table}")
        database.execute("VACUUM")
    limit = (out / "database.db").stat().st_size + 20_000
    ended = call_limited(limit, *run_arguments(small_photos, out, FAST))
    assert_says_what_to_do(ended, out / "database.db")
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


def test_geometries_that_do_not_fit_on_the_disk(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    out = ["--output-path", tmp_path / "out"]
    workspace = Workspace(tmp_path / "out")
    for command in (["extract", "--image-path", small_photos, *FAST], ["pairs"], ["match"]):
        assert call(*command, *out, "-q").code == 0
    # COLMAP would end the process in the middle of this.
    ended = call_limited(workspace.database.stat().st_size + 10_000, "verify", *out, "-q")
    assert_says_what_to_do(ended, workspace.database)
    assert call(*run_arguments(small_photos, workspace.path, FAST)).code == 0
    assert results(workspace.path) == undisturbed.results


def test_model_that_does_not_fit_on_the_disk_is_not_taken_for_whole(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    # pycolmap writes what fits and says nothing.
    out = copy_without(undisturbed.out, tmp_path / "out")
    with file_size_limit(50_000):
        ended = call(*run_arguments(small_photos, out, FAST))
    assert_says_what_to_do(ended, out / "sparse.partial" / "0")
    assert not Workspace(out).sparse.exists()
    assert not Workspace(out).report.exists()
    assert call(*run_arguments(small_photos, out, FAST)).code == 0
    assert results(out) == undisturbed.results


def test_model_that_was_damaged_later_is_named(
    small_photos: Path, tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    out = Path(shutil.copytree(undisturbed.out, tmp_path / "out"))
    damaged = out / "sparse" / "0" / "points3D.bin"
    os.truncate(damaged, damaged.stat().st_size // 2)
    ended = call(*run_arguments(small_photos, out, FAST))
    assert (ended.code, ended.stdout, len(ended.stderr)) == (1, "", 1)
    assert ended.stderr[0].startswith(f"error: {damaged}: damaged")
    assert ended.stderr[0].endswith("run map again with --overwrite")
    assert call("map", "--output-path", out, "--overwrite").code == 0
    assert results(out) == undisturbed.results


def test_hdf5_file_that_was_damaged_later_is_named(
    tmp_path: Path, undisturbed: Undisturbed, call: Call
) -> None:
    content = (undisturbed.out / "features.h5").read_bytes()
    out = copy_without(undisturbed.out, tmp_path / "out", "database.db")
    for start in range(0, 6000, 200):
        damaged = bytearray(content)
        damaged[start : start + 64] = b"\xa5" * 64
        (out / "features.h5").write_bytes(damaged)
        ended = call("pairs", "--output-path", out, "-q")
        if ended.code:
            (line,) = ended.stderr
            assert line.startswith(f"error: {out / 'features.h5'}: ")
            assert "--overwrite" in line or "another --output-path" in line


def test_log_that_cannot_be_written_stops_nothing(
    small_photos: Path, tmp_path: Path, call: Call
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.log").symlink_to("/dev/full")
    arguments = ["extract", "--image-path", small_photos, "--output-path", tmp_path / "out"]
    ended = call(*arguments, "-q", *FAST)
    assert (ended.code, ended.stderr) == (0, [])
    assert ended.stdout.startswith("extract: 4 done")


@pytest.mark.skipif(os.geteuid() == 0, reason="permissions do not stop root")
def test_output_folder_that_may_not_be_written_is_refused(
    small_photos: Path, tmp_path: Path, call: Call
) -> None:
    out = tmp_path / "out"
    out.mkdir(mode=0o555)
    ended = call(*run_arguments(small_photos, out, FAST))
    assert (ended.code, len(ended.stderr)) == (1, 1)
    assert str(out) in ended.stderr[0]
