"""The tables of what reviews found name tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).parent


def test_every_row_names_tests_that_are_there_or_argues() -> None:
    text = (TESTS / "REVIEWS.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if re.match(r"\| (?!what )", line)]
    assert len(rows) > 50
    for row in rows:
        _, what, now, tests, _ = re.split(r"(?<!\\)\|", row)
        named = re.findall(r"`([\w./]+\.py)::(\w+)`", tests)
        assert named or (tests.strip() == "none" and "argued" in now), what
        for file, name in named:
            assert f"\ndef {name}(" in (TESTS / file).read_text(encoding="utf-8"), name
