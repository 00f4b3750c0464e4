"""Records in JSON: what was written comes back, and what was changed is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from colmap_affrect.project.sealed_json import read_sealed, write_sealed

VALUES = {"a č": [1, 2.5, None], "b": {"sure": 0.95}}


@pytest.fixture
def record(tmp_path: Path) -> Path:
    path = tmp_path / "record.json"
    write_sealed(path, json.dumps(VALUES))
    return path


def test_what_was_written_comes_back(record: Path) -> None:
    assert read_sealed(record) == VALUES


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_another_layout_of_the_same_values_is_no_change(
    record: Path, encoding: str
) -> None:
    values = json.loads(record.read_text(encoding="utf-8"))
    turned = dict(reversed(values.items()))
    record.write_text(json.dumps(turned, indent=7), encoding=encoding)
    assert read_sealed(record) == VALUES


def test_record_of_an_older_version_has_no_digest(record: Path) -> None:
    record.write_text(json.dumps(VALUES), encoding="utf-8")
    assert read_sealed(record) == VALUES


@pytest.mark.parametrize(("old", "new", "why"), [
    ("0.95", "0.99", "not as it was written"),
    ("a č", "other.png", "not as it was written"),
    ("2.5", "2.5, 7", "not as it was written"),
    ("0.95", "NaN", "NaN is no number"),
    ("0.95", "-Infinity", "-Infinity is no number"),
    ("0.95", "9" * 5000, "digits"),
    ('"sha256": "', '"sha256": "0', "not as it was written"),
])  # fmt: skip
def test_changed_values_are_refused(record: Path, old: str, new: str, why: str) -> None:
    text = record.read_text(encoding="utf-8")
    assert old in text
    record.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=why):
        read_sealed(record)


@pytest.mark.parametrize("text", ["", "[1]", "3", "null", '"a"', "{", "[" * 10_000])
def test_what_is_no_record_is_refused(record: Path, text: str) -> None:
    record.write_text(text)
    with pytest.raises((ValueError, RecursionError)):
        read_sealed(record)
