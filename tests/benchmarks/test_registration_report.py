"""Tests of the tables of the registration benchmark."""

from __future__ import annotations

from registration_report import Row, detail_table, merge, span, summary_table

SECONDS = {"extraction": 3.0, "matching": 3.0, "verification": 1.0, "mapping": 1.0}


def test_span() -> None:
    assert span([2, 3, 3, 3]) == "2.8 [2-3]"
    assert span([3, 3]) == "3"
    assert span([0.25, 0.75], 2) == "0.500 [0.25-0.75]"
    assert span([None, 1.5], 1) == "1.5"
    assert span([None]) == "-"


def test_tables() -> None:
    runs = [{"registered": 3, "correct": i, "points": 9, "seconds": SECONDS} for i in (2, 3)]
    results: list[Row] = []
    for method in ("ours", "sift", "ours"):
        new = {"subset": "b", "method": method, "num_images": 3, "seconds": SECONDS, "runs": runs}
        results = merge(results, new, ["a", "b"])
    assert [row["method"] for row in results] == ["sift", "ours"]
    assert "| b | 3 | 2.5 [2-3] of 3 | 2.5 [2-3] of 3 |" in summary_table(results)
    assert "| b | 3 | ours | 2.5 [2-3] | 3 | 1 of 2 | - | 9 |" in detail_table(results)
