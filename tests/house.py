"""How the code reads, in figures, and the limits that keep it readable.

    python tests/house.py

prints a table for the package and for the tests, and ends with exit code 1 where a limit is passed.
`.ci/run` calls it. A code line is one with a token that is neither a comment nor a docstring. The
limits are what the code keeps today: they may only go down.
"""

from __future__ import annotations

import ast
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path

ROOT = Path(__file__).parents[1]
NOT_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)
# Of a public function, from which on its docstring has a section for them
MANY_ARGUMENTS = 3
MAX_COMPLEXITY = 10  # as ruff's C901, but also of conditions and comprehensions
BRANCHES = (
    ast.If,
    ast.IfExp,
    ast.For,
    ast.AsyncFor,
    ast.While,
    ast.ExceptHandler,
    ast.Assert,
    ast.match_case,
)


@dataclass(frozen=True)
class Figures:
    """How a folder reads."""

    characters: float  # of a code line, without indentation
    statements: float  # in 100 code lines
    comprehensions: float  # in 1,000 code lines
    packed_assignments: float  # a, b = x, y in 1,000 code lines
    walruses: float  # in 1,000 code lines
    # Public functions of many arguments without a section for them, per cent
    undocumented: float
    complex_functions: float  # with more than ``MAX_COMPLEXITY`` ways


LIMITS = {
    "colmap_affrect": Figures(
        characters=37.5,
        statements=75.2,
        comprehensions=24.5,
        packed_assignments=0.2,
        walruses=0.1,
        undocumented=5.0,
        complex_functions=10,
    ),
    "tests": Figures(
        characters=40.0,
        statements=70.5,
        comprehensions=30.0,
        packed_assignments=0.3,
        walruses=0.3,
        undocumented=100.0,
        complex_functions=70,
    ),
}


@dataclass
class Counts:
    """What is counted in files."""

    code_lines: int = 0
    characters: int = 0
    statements: int = 0
    comprehensions: int = 0
    packed_assignments: int = 0
    walruses: int = 0
    public_functions: int = 0  # of many arguments
    undocumented: int = 0
    complex_functions: list[str] = field(default_factory=list)  # file, line and name

    def add_file(self, path: Path) -> None:
        """Count what a file has."""
        tree = ast.parse(path.read_text(encoding="utf-8"))
        lines = path.read_text(encoding="utf-8").splitlines()
        for number in code_lines(path, tree):
            self.code_lines += 1
            self.characters += len(lines[number - 1].strip())
        for node in ast.walk(tree):
            self.add_node(node)
            is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            if is_function and complexity(node) > MAX_COMPLEXITY:
                self.complex_functions.append(f"{path}:{node.lineno} {node.name}")

    def add_node(self, node: ast.AST) -> None:
        """Count one node of a syntax tree."""
        if isinstance(node, ast.stmt) and not is_docstring(node):
            self.statements += 1
        if isinstance(node, COMPREHENSIONS):
            self.comprehensions += 1
        elif isinstance(node, ast.NamedExpr):
            self.walruses += 1
        elif isinstance(node, ast.Assign) and is_packed(node):
            self.packed_assignments += 1
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            self.add_function(node)

    def add_function(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        """Count a function that is public and not documented."""
        if has_many_arguments(node):
            self.public_functions += 1
            if "Args:" not in (ast.get_docstring(node) or ""):
                self.undocumented += 1

    def figures(self) -> Figures:
        """Return the shares."""
        thousand = 1000.0 / self.code_lines
        return Figures(
            characters=self.characters / self.code_lines,
            statements=100.0 * self.statements / self.code_lines,
            comprehensions=self.comprehensions * thousand,
            packed_assignments=self.packed_assignments * thousand,
            walruses=self.walruses * thousand,
            undocumented=100.0 * self.undocumented / max(1, self.public_functions),
            complex_functions=len(self.complex_functions),
        )


def code_lines(path: Path, tree: ast.Module) -> Iterator[int]:
    """Yield the numbers of the lines that have code."""
    docstrings = set[int]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and is_docstring(node):
            docstrings.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    used = set[int]()
    with tokenize.open(path) as file:
        for token in tokenize.generate_tokens(file.readline):
            if token.type not in NOT_CODE:
                used.update(range(token.start[0], token.end[0] + 1))
    yield from sorted(used - docstrings)


def is_docstring(node: ast.stmt) -> bool:
    """Tell whether a statement is a text on its own."""
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_text and isinstance(node.value.value, str)


def is_packed(node: ast.Assign) -> bool:
    """Tell whether an assignment gives several values to several names."""
    return isinstance(node.targets[0], ast.Tuple) and isinstance(node.value, ast.Tuple)


def complexity(function: ast.AST) -> int:
    """Return the number of ways through a function: each branch and each part of a condition."""
    num_ways = 1
    for node in ast.walk(function):
        if isinstance(node, BRANCHES):
            num_ways += 1
        elif isinstance(node, ast.BoolOp):
            num_ways += len(node.values) - 1
        elif isinstance(node, ast.comprehension):
            num_ways += 1 + len(node.ifs)
    return num_ways


def has_many_arguments(node: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Tell whether a function is public and has so many arguments that they need a section."""
    arguments = [*node.args.args, *node.args.kwonlyargs]
    return not node.name.startswith("_") and len(arguments) >= MANY_ARGUMENTS


def main() -> int:
    """Print the tables and what is above its limit."""
    num_failures = 0
    for folder, limits in LIMITS.items():
        counts = Counts()
        for path in sorted((ROOT / folder).rglob("*.py")):
            counts.add_file(path)
        found = counts.figures()
        print(f"{folder}: {counts.code_lines:,} code lines")
        for figure in fields(Figures):
            value = getattr(found, figure.name)
            limit = getattr(limits, figure.name)
            mark = ""
            if value > limit:
                mark = " <- too many"
                num_failures += 1
            print(f"{value:7.2f}  {figure.name} (at most {limit:.2f}){mark}")
        if found.complex_functions > limits.complex_functions:
            print(
                "one of these has to be split:", *counts.complex_functions, sep="\n  "
            )
    return min(1, num_failures)


if __name__ == "__main__":
    sys.exit(main())
