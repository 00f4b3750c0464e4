"""Changes of files: all or nothing, wherever writing stops."""

from __future__ import annotations

import errno
import io
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from colmap_affrect.errors import WorkspaceError
from colmap_affrect.project import atomic_files as files
from colmap_affrect.project.atomic_files import (
    PAGE_BYTES,
    FileTransaction,
    apply_journal,
    journal_of,
    replace_text,
    require_space,
    uninterrupted,
)

SIZES = st.integers(0, 3 * PAGE_BYTES)
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("write"), SIZES, st.binary(max_size=60)),
        st.tuples(st.just("fill"), SIZES, st.integers(0, 2 * PAGE_BYTES)),
        st.tuples(st.just("truncate"), SIZES, st.none()),
        st.tuples(st.just("read"), SIZES, st.integers(0, 2 * PAGE_BYTES)),
    ),
    max_size=12,
)


def apply_step(file: io.RawIOBase | io.BytesIO, step: tuple) -> bytes:
    """Do one step; return what was read."""
    kind, position, argument = step
    if kind == "truncate":
        if position > file.seek(0, os.SEEK_END):  # BytesIO would not grow
            file.write(bytes(position - file.tell()))
        file.truncate(position)
    else:
        file.seek(position)
        if kind == "read":
            return file.read(argument)
        file.write(argument if kind == "write" else b"\x07" * argument)
    return b""


@example(b"", 0, [("write", 1, b"")])
@given(st.binary(max_size=2 * PAGE_BYTES), st.integers(0, 2 * PAGE_BYTES), STEPS)
def test_transaction_is_a_file_and_commits_all_of_it(
    tmp_path_factory: pytest.TempPathFactory,
    start: bytes,
    filled: int,
    steps: list[tuple],
) -> None:
    path = tmp_path_factory.getbasetemp() / "transaction"
    start += b"\x05" * filled
    path.write_bytes(start)
    expected = io.BytesIO(start)
    with FileTransaction(path) as changes:
        for step in steps:
            apply_step(changes, step)
    assert path.read_bytes() == start, "what is not committed changes nothing"
    with FileTransaction(path) as changes:
        for step in steps:
            assert apply_step(changes, step) == apply_step(expected, step)
        changes.commit()
    assert path.read_bytes() == expected.getvalue()
    assert sorted(path.parent.glob("transaction*")) == [path]


class Killed(BaseException):
    """Stands for SIGKILL: nothing after it is done."""


class FailingFiles:
    """Lets the first changes of files pass and then raises: an OSError once, others for ever."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, passing: int, error: BaseException
    ) -> None:
        self.left = passing
        self.error = error
        for name in ("open", "replace", "unlink"):
            monkeypatch.setattr(Path, name, self._counted(getattr(Path, name)))

    def count(self) -> None:
        self.left -= 1
        if self.left < 0 and not (self.left < -1 and isinstance(self.error, OSError)):
            raise self.error

    def _counted(self, operation: Callable) -> Callable:
        def call(path: Path, *arguments: object, **options: object) -> object:
            if operation.__name__ != "open":
                self.count()
                return operation(path, *arguments, **options)
            mode = arguments[0] if arguments else options["mode"]
            return CountedFile(operation(path, mode, buffering=0), self.count)

        return call


class CountedFile:
    """A file whose changes are counted before they are made."""

    def __init__(self, file: io.FileIO, count: Callable[[], None]) -> None:
        self.file = file
        self.count = count

    def __enter__(self) -> CountedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def __getattr__(self, name: str) -> object:
        if name in ("write", "truncate"):
            self.count()
        return getattr(self.file, name)


def grown_hdf5(path: Path) -> tuple[bytes, bytes]:
    """Content of a HDF5 file before and after a change of it."""
    with h5py.File(path, "w") as file:
        for index in range(40):
            file[f"old {index}"] = np.arange(index)
    before = path.read_bytes()
    with FileTransaction(path) as changes:
        change_hdf5(changes)
        changes.commit()
    after = path.read_bytes()
    path.write_bytes(before)
    return before, after


def change_hdf5(changes: FileTransaction) -> None:
    with h5py.File(changes, "r+") as file:
        del file["old 3"]
        file["new"] = np.arange(3000)


@pytest.mark.parametrize(
    "error", [Killed(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))]
)
def test_commit_that_ends_at_any_write_leaves_all_changes_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    path = tmp_path / "file.h5"
    before, after = grown_hdf5(path)
    old = {f"old {index}" for index in range(40)}
    seen = set()
    for passing in range(1000):
        for left in tmp_path.glob("file.h5*"):
            left.unlink()
        path.write_bytes(before)
        with FileTransaction(path) as changes, monkeypatch.context() as patch:
            change_hdf5(changes)
            failing = FailingFiles(patch, passing, error)
            with suppress(OSError, Killed):
                changes.commit()
        apply_journal(path)
        with h5py.File(path, "r") as file:
            assert set(file) in (old, old ^ {"old 3", "new"})
            assert_array_equal(file["old 39"], np.arange(39))
            if "new" in file:
                assert_array_equal(file["new"], np.arange(3000))
            seen.add("new" in file)
        if failing.left >= 0:
            break
    assert path.read_bytes() == after
    assert seen == {True, False}
    assert passing > 5


def file_beside_its_journal(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write a file whose changes are in its journal only."""
    path = folder / "file"
    path.write_bytes(b"old" * 3000)
    with FileTransaction(path) as changes, monkeypatch.context() as patch:
        changes.write(b"NEW")
        patch.setattr(files, "apply_journal", lambda _: None)
        changes.commit()
    return path


def test_journal_of_a_file_is_applied_before_it_is_changed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = file_beside_its_journal(tmp_path, monkeypatch)
    assert path.read_bytes()[:6] == b"oldold"
    with FileTransaction(path) as changes:
        assert changes.read(6) == b"NEWold"


def test_journal_that_is_torn_or_damaged_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As after a power loss, where names may reach the disk before what is in the files."""
    path = file_beside_its_journal(tmp_path, monkeypatch)
    whole = journal_of(path).read_bytes()
    before = path.read_bytes()
    flipped = bytearray(whole)
    flipped[100] ^= 1
    lengths = (0, 1, 7, 8, 20, 31, 32, 33, 64, 4096, len(whole) - 1)
    for torn in (
        *(whole[:length] for length in lengths),
        bytes(flipped),
        bytes(len(whole)),
    ):
        journal_of(path).write_bytes(torn)
        apply_journal(path)
        assert path.read_bytes() == before
        assert not journal_of(path).exists()
    assert "does not count; the changes in it are left out" in caplog.text
    journal_of(path).write_bytes(whole)
    apply_journal(path)
    assert path.read_bytes()[:6] == b"NEWold"


def test_content_is_on_the_disk_before_its_name_and_the_name_before_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = []
    monkeypatch.setattr(
        os,
        "fsync",
        lambda fd: steps.append(str(Path(f"/proc/self/fd/{fd}").readlink())),
    )
    rename = Path.replace

    def renamed(old: Path, new: Path) -> Path:
        steps.append(f"-> {new.name}")
        return rename(old, new)

    monkeypatch.setattr(Path, "replace", renamed)
    replace_text(tmp_path / "a.txt", "text")
    assert steps[0].startswith(str(tmp_path / "a.txt."))
    assert steps[1:] == ["-> a.txt", str(tmp_path)]
    steps.clear()
    with FileTransaction(tmp_path / "a.txt") as changes:
        changes.write(b"T")
        changes.commit()
    file, journal, folder = (
        str(tmp_path / name) for name in ("a.txt", "a.txt.journal", "")
    )
    assert steps[0].startswith(journal)
    assert steps[1:] == ["-> a.txt.journal", folder.rstrip("/"), file]


def test_links_that_lie_in_the_way_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    for name in ("a.txt.new", "a.txt.journal.new", "a.txt"):
        (tmp_path / name).symlink_to(tmp_path / "mine")
    replace_text(tmp_path / "a.txt", "text")
    require_space(tmp_path / "a.txt", 4096)
    assert (tmp_path / "mine").read_text() == "mine"
    assert not (tmp_path / "a.txt").is_symlink()


@pytest.mark.parametrize("passing", [0, 1])
def test_replace_text_that_fails_keeps_the_old_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, passing: int
) -> None:
    path = tmp_path / "file.txt"
    replace_text(path, "old č")
    with monkeypatch.context() as patch:
        FailingFiles(patch, passing, OSError(errno.ENOSPC, "No space left on device"))
        with pytest.raises(
            WorkspaceError, match=r"file\.txt: cannot be written \(No space left"
        ):
            replace_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old č"
    assert list(tmp_path.iterdir()) == [path]


def test_file_whose_folder_is_gone_is_not_said_to_be_kept(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with pytest.raises(
        WorkspaceError, match=r"its folder is gone; run the same"
    ) as end:
        replace_text(folder / "file.txt", "new")
    assert "kept" not in str(end.value)
    assert not folder.exists()


def test_require_space_finds_room_or_says_that_there_is_none(tmp_path: Path) -> None:
    require_space(tmp_path / "file", 1 << 20)
    with pytest.raises(WorkspaceError, match=r"file: cannot be written .*; free space"):
        require_space(tmp_path / "file", 1 << 60)
    assert list(tmp_path.iterdir()) == []


def test_interrupt_is_put_off_until_the_block_has_ended() -> None:
    done = []

    def work() -> None:
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("rest of the block")

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
    assert done
