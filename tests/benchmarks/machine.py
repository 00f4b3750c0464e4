"""What the benchmarks share: the machine they ran on, one core, tables."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from pathlib import Path

from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.project.report import installed_versions


def describe_machine() -> str:
    """Return processor, cores, memory, load and versions."""
    path = Path("/proc/cpuinfo")
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    return (
        f"{names[0] if names else platform.machine()}, {available_cores()} cores, "
        f"{memory:.0f} GiB, load {os.getloadavg()[0]:.1f} at the start\n{versions}"
    )


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table, its first column aligned left."""
    lines = [header, ["---", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
