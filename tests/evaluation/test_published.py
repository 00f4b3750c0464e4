"""The stored numbers of the paper are those of its LaTeX."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from colmap_affrect.evaluation.published import COMPLEXITY, DATA, published
from colmap_affrect.evaluation.registry import PROTOCOLS

PAPER = Path(__file__).parents[3] / "shared" / "paper" / "matching_with_affnet_rectifications.tex"
METHODS = {"DenseAffNet", "DepthAffNet", "AffNetShapes", "depth-map-based", "unrectified"}


def test_rows_have_the_method_its_values_and_the_table() -> None:
    row = published("evd")[2]
    assert (row.method, row.table) == ("AffNetShapes", "Table 2: EVD, 15 pairs")
    assert list(row.values.items())[3:] == [
        ("< 5 px", 8.0), ("< 10 px", 9.0), ("< 20 px", 10.0), ("seconds", 185.47)
    ]  # fmt: skip
    assert published("pairs") == []


@pytest.mark.parametrize("protocol", [COMPLEXITY, "evd", "svp", "imc"])
def test_every_table_has_the_same_methods(protocol: str) -> None:
    tables = {row.table for row in published(protocol)}
    assert tables
    for table in tables:
        methods = {row.method for row in published(protocol) if row.table == table}
        assert methods == METHODS - ({"unrectified"} if protocol == COMPLEXITY else set())


def test_tables_are_of_protocols_that_there_are() -> None:
    stored = {table["protocol"] for table in tomllib.loads(DATA.read_text("utf-8"))["tables"]}
    assert stored - {COMPLEXITY} <= set(PROTOCOLS)


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
@pytest.mark.skipif(not PAPER.is_file(), reason="the paper is not here")
@pytest.mark.parametrize(
    ("protocol", "number", "first_column"),
    [("evd", 2, 1), ("imc", 3, 2), ("imc", 4, 2), ("imc", 5, 2), ("svp", 6, 2), ("svp", 7, 2)],
)
def test_results_are_those_of_the_paper(protocol: str, number: int, first_column: int) -> None:
    heads, *lines = latex_table(number)
    methods = [method_of(head) for head in heads[-5:]]
    assert len(methods) == len(heads) - first_column
    stored = {
        row.method: dict(row.values)
        for row in published(protocol)
        if re.match(r"Table \d+", row.table)[0] == f"Table {number}"
    }
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
    assert stored == expected


@pytest.mark.shared
@pytest.mark.skipif(not PAPER.is_file(), reason="the paper is not here")
def test_complexity_is_that_of_the_paper() -> None:
    _, *lines = latex_table(1)
    expected = {method_of(name): [float(value) for value in values] for name, *values in lines}
    assert {row.method: list(row.values.values()) for row in published(COMPLEXITY)} == expected


@pytest.mark.shared
@pytest.mark.skipif(not PAPER.is_file(), reason="the paper is not here")
def test_every_table_of_the_paper_is_stored() -> None:
    text = PAPER.read_text(encoding="utf-8")
    assert text.count(r"\begin{tabular}") == len(tomllib.loads(DATA.read_text("utf-8"))["tables"])
