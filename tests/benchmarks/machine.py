"""What the benchmarks share: their command lines, the machine they ran on, tables."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean

from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.report import installed_versions


def parser_of(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser that is described by the first line of a module."""
    return argparse.ArgumentParser(description=(doc or "").splitlines()[0])


def describe_machine() -> str:
    """Return processor, cores, memory, load and versions."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith("model name")
    ]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = ", ".join(
        f"{name} {version}" for name, version in installed_versions().items()
    )
    return (
        f"{names[0] if names else platform.machine()}, {available_cores()} cores, "
        f"{memory:.0f} GiB, load {os.getloadavg()[0]:.1f} at the start\n{versions}"
    )


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format a Markdown table, its first column aligned left."""
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def span(values: Iterable[float | None], digits: int = 0) -> str:
    """Format mean [min-max], shortened where all values are the same; - without values.

    >>> [span([2, 3, 3, 3]), span([3, 3]), span([0.25, 0.75], 2), span([None])]
    ['2.8 [2-3]', '3', '0.500 [0.25-0.75]', '-']
    """
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    low = f"{min(known):.{digits}f}"
    high = f"{max(known):.{digits}f}"
    return low if low == high else f"{fmean(known):.{digits + 1}f} [{low}-{high}]"
