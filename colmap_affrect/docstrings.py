"""Docstrings that say what the fields of options and results mean, for ``help()``."""

import ast
import inspect
import textwrap
from collections.abc import Callable, Mapping
from functools import cache
from itertools import pairwise
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

ATTRIBUTES = "\n\nAttributes:\n"
MAX_WIDTH = 88  # of what is said of a field; display
INDENT = 8  # display


@cache
def below_fields(cls: type) -> dict[str, str]:
    """Return the strings that stand below the fields of a class, where its source is known."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, TypeError):
        return {}
    definition = tree.body[0]
    found: dict[str, str] = {}
    if not isinstance(definition, ast.ClassDef):
        return found
    for node, below in pairwise(definition.body):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)):
            continue
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
            found[node.target.id] = inspect.cleandoc(str(below.value.value))
    return found


class DocstringWithFields:
    """Docstring of a class with what its fields mean, which is looked up when it is asked for.

    Commands, which show no docstrings, would wait for that.
    """

    def __init__(
        self, docstring: str | None, texts: Callable[[], Mapping[str, str]]
    ) -> None:
        """Take what the class says, and what returns the text of each field."""
        self._docstring = docstring
        self._texts = texts
        self._whole: str | None = None

    def __get__(self, instance: object, owner: type) -> str:
        """Return the whole docstring."""
        if self._whole is None:
            self._whole = with_attributes(self._docstring, self._texts())
        return self._whole

    def set_of(self, cls: type) -> None:
        """Become the docstring of a class."""
        type.__setattr__(cls, "__doc__", self)


def with_attributes(docstring: str | None, texts: Mapping[str, str]) -> str:
    """Return a docstring with a section that says what each attribute is."""
    head = inspect.cleandoc(docstring or "")
    if not texts:
        return head
    lines = []
    for name, text in texts.items():
        paragraph = f"{name}: {' '.join(text.split())}"
        filled = textwrap.wrap(paragraph, MAX_WIDTH - INDENT, break_long_words=False)
        lines.append("    " + "\n        ".join(filled))
    return head + ATTRIBUTES + "\n".join(lines)


def field_text(options: type[BaseModel], name: str) -> str:
    """Say what a field of options means, which values it takes, and its default."""
    field = options.model_fields[name]
    text = field_meaning(options, name)
    values = [
        repr(value) for value in get_args(field.annotation) if isinstance(value, str)
    ]
    if len(values) > 1:
        text += f" One of {', '.join(values)}."
    limits = _limits(field)
    if len(limits) == 2:
        text += f" From {limits[0]:g} to {limits[1]:g}."
    if isinstance(field.default, bool | int | float | str | tuple):
        text += f" Default: {field.default!r}."
    return text


def field_meaning(options: type[BaseModel], name: str) -> str:
    """Return what stands below a field in its class, or in a base that has the same field."""
    for base in options.__mro__:
        text = below_fields(base).get(name)
        if text:
            return text
    return ""


def _limits(field: FieldInfo) -> list[float]:
    """Return the smallest and the largest value that a field takes, as far as there are some."""
    limits = []
    for item in field.metadata:
        for end in ("ge", "le"):
            if hasattr(item, end):
                limits.append(getattr(item, end))
    return limits
