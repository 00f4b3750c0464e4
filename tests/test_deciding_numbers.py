"""Each number that decides says where it is from (tests/deciding_numbers.py)."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from deciding_numbers import JUDGED, MAX_JUDGED, PACKAGE, Module, Number, all_numbers

EXAMPLE = '''
from typing import Annotated

PLAIN = 1.0
BESIDE = 2.0  # px; judged
# Times as long, of
# the paper
ABOVE = 3.0
# Display, chosen by eye:
FIRST = 4
SECOND = (5, 6)

OTHER = 7
"""Theory of something."""
NO_NUMBER = "8"
name = 9  # is no constant

class SomeOptions:
    off: int = 0
    limit: Annotated[float, within(0.0, 9.0)] = 8.0  # COLMAP's
    unknown: float = 1.0
'''


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Number]:
    monkeypatch.setattr("deciding_numbers.ROOT", tmp_path)
    path = tmp_path / "example.py"
    path.write_text(EXAMPLE)
    return {number.name: number for number in Module(path).numbers()}


def test_sources_are_read_beside_above_and_below_numbers(
    example: dict[str, Number],
) -> None:
    sources = {name: number.source for name, number in example.items()}
    assert sources == {
        "PLAIN": "",
        "BESIDE": JUDGED,
        "ABOVE": "paper",
        "FIRST": "display",
        "SECOND": "display",
        "OTHER": "theory",
        "SomeOptions.limit": "COLMAP",
        "SomeOptions.unknown": "",
    }


def test_all_numbers_of_the_package_say_where_they_are_from() -> None:
    assert [number.where for number in all_numbers() if not number.source] == []


def test_no_more_numbers_are_judged_than_before() -> None:
    judged = [number for number in all_numbers() if number.source == JUDGED]
    assert len(judged) <= MAX_JUDGED


def test_files_of_fitted_numbers_say_when_and_from_what_they_were_made() -> None:
    for path in PACKAGE.rglob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        assert "tests/benchmarks/" in content["made"], path
        assert content["data"], path
