"""Each number that decides says where it is from (tests/deciding_numbers.py)."""

from __future__ import annotations

import ast
import json
from pathlib import Path

import pytest
from deciding_numbers import (
    JUDGED,
    MAX_JUDGED,
    PACKAGE,
    ROOT,
    Module,
    Number,
    all_numbers,
    faults,
)
from mutations import multiplied, mutations

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


def test_all_numbers_of_the_package_say_where_they_are_from_and_no_more_are_judged() -> (
    None
):
    assert faults(all_numbers()) == []


def test_a_number_without_a_source_is_named_with_the_words_for_one(
    example: dict[str, Number],
) -> None:
    texts = faults(list(example.values()))
    assert [text.partition(" = ")[0] for text in texts] == [
        "example.py:4: PLAIN",
        "example.py:21: SomeOptions.unknown",
    ]
    assert "needs one of the words judged, fitted, measured" in texts[0]


def test_one_judged_number_too_many_is_told_with_what_to_do(
    example: dict[str, Number],
) -> None:
    judged = [example["BESIDE"]]
    assert faults(judged * MAX_JUDGED) == []
    assert faults(judged * (MAX_JUDGED + 1)) == [
        f"{MAX_JUDGED + 1} numbers are judged, at most {MAX_JUDGED} may be: give a new one "
        "another source, such as theory or a measurement, or do without it or another one"
    ]


def test_files_of_fitted_numbers_say_when_and_from_what_they_were_made() -> None:
    for path in PACKAGE.rglob("*.json"):
        content = json.loads(path.read_text(encoding="utf-8"))
        assert "tests/benchmarks/" in content["made"], path
        assert content["data"], path


@pytest.mark.parametrize(
    ("value", "larger", "smaller"),
    [
        ("0.5", "0.5 * 10.0", "0.5 * 0.1"),
        ("12", "120", "1"),
        ("(0.5, -3)", "(0.5 * 10.0, -3 * 10.0)", "(0.5 * 0.1, -3 * 0.1)"),
        ("{'a': Pair(x=2)}", "{'a': Pair(x=20)}", "{'a': Pair(x=1)}"),
        ("np.cos(1.5)", "np.cos(1.5) * 10.0", "np.cos(1.5) * 0.1"),
    ],
)
def test_numbers_become_ten_times_larger_and_smaller(
    value: str, larger: str, smaller: str
) -> None:
    for factor, expected in ((10.0, larger), (0.1, smaller)):
        found = multiplied(ast.parse(value, mode="eval").body, factor)
        assert ast.unparse(found) == expected


def test_a_mutation_changes_one_statement_of_a_module_alone() -> None:
    tried = list(mutations(["geometry"]))
    assert len(tried) > 20
    for mutation in tried:
        before = (ROOT / mutation.module).read_text(encoding="utf-8")
        first = ast.parse(before).body
        second = ast.parse(mutation.text()).body
        differing = [
            one
            for one, other in zip(first, second, strict=True)
            if ast.dump(one) != ast.dump(other)
        ]
        assert len(differing) == 1, mutation.name
