"""How large the project is: lines by folder, and the limits that keep it readable.

    python tests/limits.py

prints a table and ends with exit code 1 where a limit is passed. `.ci/run` calls it.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "colmap_affrect"
LIMITS = {
    "lines of the package": 29_500,
    "lines of the tests": 24_700,
    "lines of the longest file": 435,
    "lines of the longest function": 60,
    "imports between folders": 168,
    "words of ARCHITECTURE.md": 2_500,
    "words of BENCHMARKS.md": 2_500,
}
"""As it is now, rounded up: these numbers only go down. The goal is 22,000 lines each, files of 400
lines, functions of 60, and 180 imports."""


def lines_of(path: Path) -> int:
    return len(path.read_text(encoding="utf-8").splitlines())


def room_of(path: Path) -> str:
    """Name the folder of the package that a file is in, or the file itself if it is in none."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported_rooms(path: Path) -> Iterator[str]:
    """Yield the folders and files right below the package that a file imports from."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        for module in modules:
            package, *rest = module.split(".")
            if package == PACKAGE.name and rest and list(PACKAGE.glob(f"{rest[0]}*")):
                yield rest[0]


def longest_function(path: Path) -> tuple[int, str]:
    functions = [
        (node.end_lineno - node.lineno + 1, f"{node.name} in {path.relative_to(ROOT)}")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno
    ]
    return max(functions, default=(0, ""))


def main() -> int:
    """Print the table and the limits."""
    package = sorted(PACKAGE.rglob("*.py"))
    tests = sorted((ROOT / "tests").rglob("*.py"))
    rooms = Counter[str]()
    arrows = set()
    for path in package:
        rooms[room_of(path)] += lines_of(path)
        arrows |= {(room_of(path), room) for room in imported_rooms(path)} - {
            (room_of(path), room_of(path))
        }
    for room, count in sorted(rooms.items()):
        print(f"{count:7,}  {room}")
    longest_file = max((lines_of(path), str(path.relative_to(ROOT))) for path in package)
    longest = max(map(longest_function, package))
    sizes = {
        "lines of the package": (sum(rooms.values()), ""),
        "lines of the tests": (sum(map(lines_of, tests)), ""),
        "lines of the longest file": longest_file,
        "lines of the longest function": longest,
        "imports between folders": (len(arrows), ""),
    }
    for name in ("ARCHITECTURE.md", "BENCHMARKS.md"):
        sizes[f"words of {name}"] = len((ROOT / name).read_text("utf-8").split()), ""
    for what, (size, where) in sizes.items():
        mark = " <- too many" if size > LIMITS[what] else ""
        print(f"{size:7,}  {what} (at most {LIMITS[what]:,}) {where}{mark}")
    return int(any(size > LIMITS[what] for what, (size, _) in sizes.items()))


if __name__ == "__main__":
    sys.exit(main())
