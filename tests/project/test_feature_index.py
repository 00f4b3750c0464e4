"""What files of features hold is gone through once, and again when they have changed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from colmap_affrect.project import feature_index
from colmap_affrect.project.feature_index import Entries, entries


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(feature_index, "MIN_NUM_KEPT", 2)
    monkeypatch.setattr(feature_index, "_known", {})
    path = tmp_path / "features.h5"
    path.write_bytes(b"1")
    return path


def never() -> Entries:
    raise AssertionError("is not read again")


def found(path: Path, *names: str) -> list[str]:
    """What is found in a file that holds some images; none are given where it is not to be read."""
    return list(
        entries(path, lambda: dict.fromkeys(names, ("ab", 3, (4, 5))) if names else never())
    )


def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_index, "_known", {})


def test_file_is_read_again_when_it_has_changed(path: Path) -> None:
    assert found(path, "b", "a") == ["a", "b"] == found(path)
    path.write_bytes(b"23")
    assert found(path, "c") == ["c"]
    feature_index.forget(path)  # as before a write that may leave size and time alone
    assert found(path, "d") == ["d"]


def test_another_process_reads_the_index_and_none_that_is_stale_or_damaged(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feature_index, "MIN_AGE_NS", -(10**12))
    assert found(path, "b", "a") == ["a", "b"]
    new_process(monkeypatch)
    assert found(path) == ["a", "b"]
    new_process(monkeypatch)
    os.utime(path, ns=(0, 0))
    assert found(path, "c", "d") == ["c", "d"]
    new_process(monkeypatch)
    path.with_name(".features.h5.index").write_text("[[1, 2")
    assert found(path, "e") == ["e"]


def test_file_that_was_just_written_leaves_no_index(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its next change might come within one tick of the clock of the file system."""
    monkeypatch.setattr(feature_index, "MIN_AGE_NS", 10**12)
    assert found(path, "b", "a") == ["a", "b"]
    new_process(monkeypatch)
    assert found(path, "c", "d") == ["c", "d"]
