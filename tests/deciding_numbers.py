"""The numbers that decide, and where each is from.

    python tests/deciding_numbers.py

prints every numeric constant of a module and every numeric default of an options class with its
source, and ends with exit code 1 where one has no source, or where more than `MAX_JUDGED` are
judged. (It is not called `numbers`: scripts in this folder would import it in the place of
Python's module.)

The source is one of the words of `SOURCES`, in the comment of the definition (beside it, above
it), or in the text below it. A comment that ends with a colon speaks for all definitions down to
the next empty line. What says nothing in `report/` was chosen by eye, and decides nothing but what
is drawn. Defaults of zero are none: they switch something off, or begin to count.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "colmap_affrect"
DRAWN = "colmap_affrect/report/"
MAX_JUDGED = 119  # numbers that nothing but results on photographs speaks for
JUDGED = "judged"
SOURCES = {
    JUDGED: "chosen by results on photographs whose poses are known, or by eye",
    "fitted": "by a script, on photographs whose poses are known",
    "measured": "a time, an error or a share that was measured",
    "resource": "bounds time or memory: more would do no harm",
    "display": "of what is shown alone",
    "numeric": "guards against rounding or division by zero",
    "damage": "beyond it an input is damaged, or nothing can be computed with it",
    "format": "of a file format, a protocol, an operating system, or a label of our own",
    "paper": "of a publication, or of the code of its authors",
    "theory": "follows from geometry, statistics or the meaning of the number",
    "same as": "another number, which it names",
    "OpenCV": "OpenCV's value",
    "kornia": "kornia's value",
    "COLMAP": "COLMAP's value",
}
"""Words that say a source, the first one that is found counts."""


@dataclass(frozen=True)
class Number:
    """A definition with a number.

    Attributes:
        where: file and line.
        name: of the constant, or of the class and its field.
        value: as it is written.
        text: what comments and docstring say of it.
    """

    where: str
    name: str
    value: str
    text: str

    @property
    def source(self) -> str:
        """The word of its source; empty where none is said."""
        for word in SOURCES:
            if re.search(rf"\b{word}s?\b", self.text, re.IGNORECASE):
                return word
        return "display" if self.where.startswith(DRAWN) else ""


def is_number(node: ast.expr | None) -> bool:
    """Tell whether a value is a number, or made of numbers alone."""
    match node:
        case ast.Constant(value=value):
            return isinstance(value, int | float) and not isinstance(value, bool)
        case ast.UnaryOp(operand=operand):
            return is_number(operand)
        case ast.BinOp(left=left, right=right):
            return is_number(left) or is_number(right)
        case ast.Subscript(value=value):
            return is_number(value)
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts):
            return any(map(is_number, parts))
        case ast.Dict(values=parts):
            return any(map(is_number, parts))
        case ast.Call(args=args, keywords=keywords):
            return is_call_of_numbers([*args, *[one.value for one in keywords]])
    return False


def is_call_of_numbers(arguments: Sequence[ast.expr]) -> bool:
    """Tell whether arguments of a call are numbers, or names beside numbers."""
    others = [one for one in arguments if not is_number(one)]
    has_numbers = len(others) < len(arguments)
    return has_numbers and all(
        isinstance(one, ast.Name | ast.Attribute) for one in others
    )


def is_zero(node: ast.expr) -> bool:
    """Tell whether a value is the number 0."""
    return isinstance(node, ast.Constant) and node.value == 0


class Module:
    """The definitions of a file.

    Attributes:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text = path.read_text(encoding="utf-8")
        self._tree = ast.parse(text)
        self._lines = text.splitlines()

    def numbers(self) -> Iterator[Number]:
        """Yield constants of the module, and defaults of options."""
        for name, node, below in assignments(self._tree.body):
            if name.lstrip("_").isupper() and is_number(node.value):
                yield self._number(name, node, below)
        for found in ast.walk(self._tree):
            if isinstance(found, ast.ClassDef) and is_of_options(found):
                for name, node, below in assignments(found.body):
                    if is_number(node.value) and not is_zero(node.value):
                        yield self._number(f"{found.name}.{name}", node, below)

    def _number(self, name: str, node: Assignment, below: str) -> Number:
        last_line = self._lines[(node.end_lineno or node.lineno) - 1]
        beside = last_line.encode()[node.end_col_offset :].decode()
        field = name.partition(".")[2]  # presets of COLMAP are called so
        texts = [beside, self._above(node.lineno), below, field]
        where = f"{self.path.relative_to(ROOT)}:{node.lineno}"
        return Number(where, name, ast.unparse(node.value), " ".join(texts))

    def _above(self, line: int) -> str:
        """Return the comment above a line, and one that speaks for all of its paragraph."""
        texts = list[str]()
        is_own = True  # until other code is between
        block = list[str]()
        line -= 1
        while line > 0 and self._lines[line - 1].strip():
            if self._lines[line - 1].lstrip().startswith("#"):
                block.insert(0, self._lines[line - 1].lstrip("# "))
            elif block:
                texts += block if is_own or block[-1].endswith(":") else []
                block.clear()
                is_own = False
            else:
                is_own = False
            line -= 1
        if block and (is_own or block[-1].endswith(":")):
            texts += block
        return " ".join(texts)


Assignment = ast.Assign | ast.AnnAssign


def assignments(
    body: Sequence[ast.stmt],
) -> Iterator[tuple[str, Assignment, str]]:
    """Yield name, statement and text below of each assignment to one name."""
    following = [*body[1:], None]
    for node, after in zip(body, following, strict=True):
        if not isinstance(node, Assignment) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        below = ""
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            below = str(after.value.value)
        if isinstance(target, ast.Name | ast.Tuple):
            yield ast.unparse(target).strip("()"), node, below


def is_of_options(node: ast.ClassDef) -> bool:
    """Tell whether a class has options."""
    names = [node.name, *map(ast.unparse, node.bases)]
    return any(name.endswith("Options") for name in names)


@cache
def all_numbers() -> list[Number]:
    """Return the numbers of the package, by file and line."""
    found = list[Number]()
    for path in sorted(PACKAGE.rglob("*.py")):
        found += Module(path).numbers()
    return found


def faults(found: Sequence[Number]) -> list[str]:
    """Return what is wrong with numbers, and what to do."""
    words = ", ".join(SOURCES)
    texts = []
    for number in found:
        if not number.source:
            texts.append(
                f"{number.where}: {number.name} = {number.value} does not say where it is from: "
                f"its comment, or the text below it, needs one of the words {words}"
            )
    judged = sum(number.source == JUDGED for number in found)
    if judged > MAX_JUDGED:
        texts.append(
            f"{judged} numbers are judged, at most {MAX_JUDGED} may be: give a new one another "
            "source, such as theory or a measurement, or do without it or another one"
        )
    return texts


def main() -> int:
    """Print the numbers, and at the end what is wrong with them."""
    found = all_numbers()
    counts = Counter(number.source or "no source" for number in found)
    for number in found:
        print(f"{number.source:9} {number.where:55} {number.name} = {number.value}")
    for source, count in counts.most_common():
        print(f"{count:5}  {source}: {SOURCES.get(source, 'must be said')}")
    without = counts["no source"]
    judged = counts[JUDGED]
    print(f"{judged} judged (at most {MAX_JUDGED}), {without} without a source (none)")
    wrong = faults(found)
    for text in wrong:
        print(text)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
