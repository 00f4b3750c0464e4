"""The numbers of the paper's tables, to print beside ours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

DATA = Path(__file__).with_name("published.toml")

COMPLEXITY = "complexity"
"""Stands for a protocol: the paper's table of areas, keypoints, regions and warps per image."""


@dataclass(frozen=True)
class PublishedRow:
    """What a table of the paper says of one method.

    Attributes:
        method: the paper's name of it, the same in all tables.
        values: by column; those that our summaries have too are called the same.
        table: number of the table, and what it is of.
    """

    method: str
    values: Mapping[str, float]
    table: str


def published(protocol: str) -> list[PublishedRow]:
    """Return the published rows of a protocol, table by table; none if there are none."""
    return [
        PublishedRow(
            method, dict(zip(table["columns"], map(float, values), strict=True)), table["label"]
        )
        for table in tomllib.loads(DATA.read_text(encoding="utf-8"))["tables"]
        if table["protocol"] == protocol
        for method, values in table["values"].items()
    ]
