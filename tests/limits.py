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
    "lines of the longest file": 555,
    "lines of the longest function": 70,
    "imports between folders": 220,
    "words of ARCHITECTURE.md": 3_100,
    "words of BENCHMARKS.md": 3_000,
}
"""What a stranger can still read in one go. How many lines there are in all has no limit."""


def imported_rooms(tree: ast.Module) -> Iterator[str]:
    """Yield the folders and files right below the package that a file imports from."""
    for node in ast.walk(tree):
        modules: list[str] = []
        if isinstance(node, ast.Import):
            modules = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            modules = [f"{node.module}.{alias.name}" for alias in node.names]
        for module in modules:
            package, *rest = module.split(".")
            if package == PACKAGE.name and rest and list(PACKAGE.glob(f"{rest[0]}*")):
                yield rest[0]


def main() -> int:
    """Print the table and the limits."""
    rooms = Counter[str]()
    arrows = set()
    files = []
    functions = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        where = path.relative_to(PACKAGE)
        tree = ast.parse(text)
        room = where.parts[0].removesuffix(".py")
        rooms[room] += text.count("\n")
        arrows |= {(room, other) for other in imported_rooms(tree) if other != room}
        files.append((text.count("\n"), str(where)))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or 0) - node.lineno + 1
                functions.append((length, f"{node.name} in {where}"))
    for room, count in sorted(rooms.items()):
        print(f"{count:7,}  {room}")
    print(f"{sum(rooms.values()):7,}  in all")
    sizes = {
        "lines of the longest file": max(files),
        "lines of the longest function": max(functions),
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
