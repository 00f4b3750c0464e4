"""Which judged numbers the tests pin: each is made ten times larger, and ten times smaller.

    python tests/benchmarks/mutations.py --folders geometry images --output-path mutations.json

For every judged number (tests/deciding_numbers.py) the package is copied with that one number
changed, and the tests that concern it run: first those that import its module, then, with
`--wide`, all others of its folder. A number *survives* where none of them fails. What was tried is
written after each number, and is not tried again when the command is repeated.
"""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from deciding_numbers import JUDGED, PACKAGE, ROOT, Number, all_numbers
from machine import parser_of

FACTORS = {"ten times larger": 10.0, "ten times smaller": 0.1}
COPIED = ("colmap_affrect", "tests", "sample_scenes", "docs", "recipes")
MAX_SECONDS = 240.0  # of the tests of one number; what takes longer is undecided
OUTCOMES = {0: "survives", 5: "has no tests"}  # by pytest's exit code; others: caught


@dataclass(frozen=True)
class Mutation:
    """A judged number that is ten times off.

    Attributes:
        number: as it is.
        change: key of `FACTORS`.
    """

    number: Number
    change: str

    @property
    def module(self) -> Path:
        """Of the number, relative to the project."""
        return Path(self.number.where.partition(":")[0])

    @property
    def name(self) -> str:
        """For people, and as a key."""
        return f"{self.module}: {self.number.name}, {self.change}"

    def text(self) -> str:
        """Return the module's text with the changed number."""
        text = (ROOT / self.module).read_text(encoding="utf-8")
        line = int(self.number.where.partition(":")[2])
        value = value_at_line(ast.parse(text), line)
        before = offset_of(text, value.lineno, value.col_offset)
        after = offset_of(text, value.end_lineno or 0, value.end_col_offset or 0)
        changed = ast.unparse(multiplied(value, FACTORS[self.change]))
        return text[:before] + changed + text[after:]


def value_at_line(tree: ast.Module, line: int) -> ast.expr:
    """Return the value of the assignment that begins at a line."""
    for node in ast.walk(tree):
        is_assignment = isinstance(node, ast.Assign | ast.AnnAssign)
        if is_assignment and node.lineno == line and node.value is not None:
            return node.value
    raise ValueError(f"no assignment at line {line}")


def offset_of(text: str, line: int, column: int) -> int:
    """Return where in a text a line (from 1) and a column (in bytes of UTF-8) are."""
    lines = text.splitlines(keepends=True)
    in_line = lines[line - 1].encode()[:column].decode()
    return sum(map(len, lines[: line - 1])) + len(in_line)


def multiplied(value: ast.expr, factor: float) -> ast.expr:
    """Return a number times a factor, or whatever is made of numbers with all of these so."""
    match value:
        case ast.Constant(value=int(whole)):
            return ast.Constant(max(1, round(whole * factor)))
        case ast.Tuple(elts=parts) | ast.List(elts=parts):
            return type(value)([multiplied(part, factor) for part in parts], ast.Load())
        case ast.Dict(keys=keys, values=parts):
            return ast.Dict(keys, [multiplied(part, factor) for part in parts])
        case ast.Call(func=ast.Name(), args=args, keywords=keywords):
            return ast.Call(
                value.func,
                [multiplied(part, factor) for part in args],
                [
                    ast.keyword(part.arg, multiplied(part.value, factor))
                    for part in keywords
                ],
            )
    return ast.BinOp(value, ast.Mult(), ast.Constant(factor))


def tests_of(module: Path, is_wide: bool) -> list[str]:
    """Return the files of tests that concern a module, and the module with its doctests."""
    dotted = ".".join(module.with_suffix("").parts)
    parent, _, name = dotted.rpartition(".")
    folder = ROOT / "tests" / module.parent.relative_to(PACKAGE.name)
    named = folder / f"test_{module.stem}.py"
    importing = list[Path]()
    others = list[Path]()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if path == named:
            importing.insert(0, path)
        elif dotted in text or f"from {parent} import {name}" in text:
            importing.append(path)
        elif path.parent == folder:
            others.append(path)
    found = importing
    if is_wide or not importing:
        found = importing + others
    return [str(path.relative_to(ROOT)) for path in found] + [str(module)]


def outcome_of(mutation: Mutation, copy: Path, is_wide: bool) -> str:
    """Run the tests of a mutation in a copy of the project, which is left as it was."""
    path = copy / mutation.module
    original = path.read_text(encoding="utf-8")
    path.write_text(mutation.text(), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-n", "0", "-q", "-x"]
    command += ["-p", "no:cacheprovider", *tests_of(mutation.module, is_wide)]
    environment = {
        **os.environ,
        "PYTHONPATH": str(copy),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    try:
        done = subprocess.run(
            command,
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            timeout=MAX_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "undecided: the tests take too long"
    finally:
        path.write_text(original, encoding="utf-8")
    return OUTCOMES.get(done.returncode, f"caught: {first_failure(done.stdout)}")


def first_failure(output: str) -> str:
    """Return the line of pytest's output that names the test that failed."""
    for line in output.splitlines():
        if line.startswith(("FAILED", "ERROR")):
            return line
    return "pytest ended otherwise"


def mutations(folders: list[str]) -> Iterator[Mutation]:
    """Yield both mutations of each judged number, of some folders or all."""
    for number in all_numbers():
        folder = Path(number.where).parts[1]
        if number.source == JUDGED and (not folders or folder in folders):
            for change in FACTORS:
                yield Mutation(number, change)


def main() -> None:
    """Try the numbers that have not been tried, and print what survives."""
    parser = parser_of(__doc__)
    parser.add_argument("--folders", nargs="*", default=[], help="default: all")
    parser.add_argument(
        "--names", nargs="*", default=[], help="of numbers; default: all"
    )
    parser.add_argument("--wide", action="store_true", help="with tests of the folder")
    parser.add_argument("--output-path", type=Path, default=Path("mutations.json"))
    given = parser.parse_args()
    known = dict[str, str]()
    if given.output_path.exists():
        known = json.loads(given.output_path.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        shutil.copytree(ROOT, copy, dirs_exist_ok=True, ignore=not_copied)
        for mutation in mutations(given.folders):
            is_asked = not given.names or mutation.number.name in given.names
            if mutation.name in known or not is_asked:
                continue
            known[mutation.name] = outcome_of(mutation, copy, given.wide)
            print(f"{mutation.name}: {known[mutation.name]}", flush=True)
            given.output_path.write_text(json.dumps(known, indent=1), encoding="utf-8")
    survivors = [name for name, outcome in known.items() if "caught" not in outcome]
    print(f"{len(known)} tried, {len(known) - len(survivors)} caught, survivors:")
    print("\n".join(survivors))


def not_copied(folder: str, names: list[str]) -> list[str]:
    """Return what no copy needs: all beside the package, its tests and their files."""
    skipped = [name for name in names if name == "__pycache__"]
    if Path(folder) == ROOT:
        files = {name for name in names if (ROOT / name).is_file()}
        skipped += [name for name in names if name not in {*COPIED, *files}]
    return skipped


if __name__ == "__main__":
    main()
