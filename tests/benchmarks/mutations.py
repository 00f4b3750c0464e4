"""Which judged numbers the tests pin: each is made ten times larger, and ten times smaller.

    python tests/benchmarks/mutations.py --folders geometry images --output-path mutations.json
    python tests/benchmarks/mutations.py --changes changes.json --output-path mutations.json

For every judged number (tests/deciding_numbers.py) the package is copied with that one number
changed, and the tests that concern it run: the files that name most of its module, or, with
`--wide`, all that import it and all others of its folder. A number *survives* where none of them
fails. What was tried is written after each number, and is not tried again when the command is
repeated.

With `--changes` other changes are tried in their place, those of a file: a JSON list of objects
with `module`, `before` and `after`, a text that the module has once, and what it becomes. Those of
`tests/benchmarks/changes.json` were tried in November 2026: each fails some test. What the code
does not have any more is passed over.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import importlib
import json
import os
import py_compile
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, Protocol

sys.path.insert(0, str(Path(__file__).parents[1]))

import pytest
from deciding_numbers import JUDGED, PACKAGE, ROOT, Number, all_numbers

FACTORS = {"ten times larger": 10.0, "ten times smaller": 0.1}
COPIED = ("colmap_affrect", "tests", "sample_scenes", "docs", "recipes")
MAX_SECONDS = 240.0  # of the tests of one number; what takes longer is undecided
MAX_FILES = 4  # of tests of one number, but with `--wide`
OUTCOMES = {0: "survives", 5: "has no tests"}  # by pytest's exit code; others: caught
LIBRARIES = ("cv2", "h5py", "hypothesis", "networkx", "numpy", "pyceres", "pycolmap")
"""What most tests load: it is loaded once, and the tests run in copies of this process."""
# By content: a changed module may be as long and as old as it was
CHECKED_HASH = py_compile.PycInvalidationMode.CHECKED_HASH


class Mutation(Protocol):
    """A change of one module."""

    @property
    def module(self) -> Path:
        """The file, relative to the project."""

    @property
    def name(self) -> str:
        """For people, and as a key."""

    def text(self) -> str:
        """Return the changed text of the module."""


@dataclass(frozen=True)
class Replacement:
    """A text of a module that becomes another one.

    Attributes:
        file: of the module, relative to the package.
        before: what the module has once.
        after: what takes its place.
    """

    file: str
    before: str
    after: str

    @property
    def module(self) -> Path:
        """The file, relative to the project."""
        return Path(PACKAGE.name) / self.file

    @property
    def name(self) -> str:
        """For people, and as a key."""
        return f"{self.file}: {self.before} -> {self.after}"

    def text(self) -> str:
        """Return the changed text of the module."""
        text = (ROOT / self.module).read_text(encoding="utf-8")
        if text.count(self.before) != 1:
            raise ValueError(f"{self.file} must have this once: {self.before}")
        return text.replace(self.before, self.after)


@dataclass(frozen=True)
class WrongNumber:
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
    defined = names_defined_in(ROOT / module)
    importing = dict[Path, int]()  # how many of the module's names each file has
    others = list[Path]()
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text(encoding="utf-8")
        if path == folder / f"test_{module.stem}.py":
            importing[path] = len(defined) + 1
        elif dotted in text or f"from {parent} import {name}" in text:
            importing[path] = len(defined.intersection(re.findall(r"\w+", text)))
        elif path.parent == folder:
            others.append(path)
    found = sorted(importing, key=lambda path: -importing[path])
    if is_wide or not importing:
        found += others
    else:
        found = found[:MAX_FILES]
    return [str(module)] + [str(path.relative_to(ROOT)) for path in found]


def names_defined_in(path: Path) -> set[str]:
    """Return the names of the functions, classes and constants of a module."""
    names = set[str]()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                names.add(name)
            case ast.Assign(targets=[ast.Name(id=name)]):
                names.add(name)
    return names


def outcome_of(mutation: Mutation, copy: Path, is_wide: bool) -> str:
    """Run the tests of a mutation in a copy of the project, which is left as it was."""
    path = copy / mutation.module
    original = path.read_text(encoding="utf-8")
    path.write_text(mutation.text(), encoding="utf-8")
    try:
        return outcome_of_tests(tests_of(mutation.module, is_wide), copy)
    finally:
        path.write_text(original, encoding="utf-8")


def outcome_of_tests(tests: Iterable[str], copy: Path) -> str:
    """Run tests of a copy of the project, and return what came of that."""
    with tempfile.TemporaryFile("w+") as output:
        process = os.fork()
        if not process:
            run_tests(tests, copy, output.fileno())
        code = exit_code(process)
        if code is None:
            return "undecided: the tests take too long"
        output.seek(0)
        return OUTCOMES.get(code, f"caught: {first_failure(output.read())}")


def run_tests(tests: Iterable[str], copy: Path, output: int) -> NoReturn:
    """Run tests of a copy of the project in this process, and end it."""
    code = 3
    try:
        os.setsid()
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.chdir(copy)
        os.environ["PYTHONPATH"] = str(copy)
        ours = (str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent))
        sys.path[:] = [str(copy), *[path for path in sys.path if path not in ours]]
        del sys.modules["deciding_numbers"]
        arguments = ["-n", "0", "-q", "-x", "-p", "no:cacheprovider"]
        arguments += ["-W", "ignore::pytest.PytestAssertRewriteWarning", *tests]
        code = int(pytest.main(arguments))
        sys.stdout.flush()
    finally:
        os._exit(code)


def exit_code(process: int) -> int | None:
    """Wait for a process, which is ended where it takes too long: None then."""
    end = time.monotonic() + MAX_SECONDS
    while time.monotonic() < end:
        found, status = os.waitpid(process, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(process, signal.SIGKILL)
    os.waitpid(process, 0)
    return None


def first_failure(output: str) -> str:
    """Return the line of pytest's output that names the test that failed."""
    for line in output.splitlines():
        if line.startswith(("FAILED", "ERROR")):
            return line
    return "pytest ended otherwise"


def mutations(folders: list[str]) -> Iterator[WrongNumber]:
    """Yield both mutations of each judged number, of some folders or all."""
    for number in all_numbers():
        folder = Path(number.where).parts[1]
        if number.source == JUDGED and (not folders or folder in folders):
            for change in FACTORS:
                yield WrongNumber(number, change)


def replacements(path: Path) -> Iterator[Replacement]:
    """Yield the changes of a file, but for those of what the code does not have any more."""
    for row in json.loads(path.read_text(encoding="utf-8")):
        change = Replacement(row["module"], row["before"], row["after"])
        try:
            change.text()
        except ValueError as error:
            print(f"passed over: {error}")
            continue
        yield change


def main() -> None:
    """Try what has not been tried, and print what survives."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--folders", nargs="*", default=[], help="default: all")
    parser.add_argument(
        "--names", nargs="*", default=[], help="of numbers; default: all"
    )
    parser.add_argument("--changes", type=Path, help="others, in a JSON file")
    parser.add_argument("--wide", action="store_true", help="with tests of the folder")
    parser.add_argument("--output-path", type=Path, default=Path("mutations.json"))
    given = parser.parse_args()
    asked = list[Mutation]()
    if given.changes:
        asked += replacements(given.changes)
    else:
        for mutation in mutations(given.folders):
            if not given.names or mutation.number.name in given.names:
                asked.append(mutation)
    known = dict[str, str]()
    if given.output_path.exists():
        known = json.loads(given.output_path.read_text(encoding="utf-8"))
    for library in LIBRARIES:
        importlib.import_module(library)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        shutil.copytree(ROOT, copy, dirs_exist_ok=True, ignore=not_copied)
        compileall.compile_dir(
            copy / PACKAGE.name, quiet=1, invalidation_mode=CHECKED_HASH
        )
        unchanged = outcome_of_tests(["tests/test_deciding_numbers.py"], copy)
        if unchanged != OUTCOMES[0]:
            raise RuntimeError(f"without any change {unchanged}")
        for mutation in asked:
            if mutation.name in known:
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
