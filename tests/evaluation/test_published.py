"""The stored numbers of the paper are those of its LaTeX."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from colmap_affrect.evaluation.results import published

PAPER = Path(__file__).parents[3] / "shared" / "paper" / "matching_with_affnet_rectifications.tex"

needs_the_paper = pytest.mark.skipif(not PAPER.is_file(), reason="the paper is not here")


def test_rows_have_the_method_its_values_and_the_table() -> None:
    row = published("evd")[2]
    assert (row.method, row.table) == ("AffNetShapes", "Table 2: EVD, 15 pairs")
    assert list(row.values.items())[3:] == [
        ("< 5 px", 8.0), ("< 10 px", 9.0), ("< 20 px", 10.0), ("seconds", 185.47)
    ]  # fmt: skip
    assert published("pairs") == []


def latex_table(number: int) -> list[list[str]]:
    """Cells of a table, counted from 1, without markup."""
    text = PAPER.read_text(encoding="utf-8")
    tables = re.findall(r"\\begin\{table\*?\}.*?\\end\{table\*?\}", text, re.DOTALL)
    lines = tables[number - 1].split(r"\\")
    plain = [
        re.sub(r"~?\\cite\{\w+\}|\\[a-z]+rule|\\hline|\$\^\{\\circ\}\$|\s*\n\s*", "", line)
        for line in lines
        if "&" in line
    ]
    return [[cell.strip() for cell in line.split("&")] for line in plain]


def method_of(title: str) -> str:
    """Our one name of what the paper calls by several."""
    title = title.replace("DepthffNet", "DepthAffNet").removeprefix("simple ")
    return "unrectified" if title.startswith("unrectified") else title


@pytest.mark.shared
@needs_the_paper
@pytest.mark.parametrize(
    ("protocol", "number", "first_column"),
    [("evd", 2, 1), ("imc", 3, 2), ("imc", 4, 2), ("imc", 5, 2), ("svp", 6, 2), ("svp", 7, 2)],
)
def test_results_are_those_of_the_paper(protocol: str, number: int, first_column: int) -> None:
    heads, *lines = latex_table(number)
    methods = [method_of(head) for head in heads[-5:]]
    assert len(methods) == len(heads) - first_column
    titles = {"evd": "< {} px", "svp": "{}°", "imc": "{}"}
    expected = {
        method: {
            "seconds" if line[0].startswith("time") else titles[protocol].format(line[0]): float(
                line[first_column + column]
            )
            for line in lines
        }
        for column, method in enumerate(methods)
    }
    rows = [row for row in published(protocol) if re.match(rf"Table {number}\b", row.table)]
    assert {row.method: row.values for row in rows} == expected
