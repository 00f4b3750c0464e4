"""Docstrings that say what the fields of options and results mean, for ``help()``."""

import ast
import inspect
import textwrap
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from typing import get_args

from pydantic import BaseModel
from pydantic.fields import FieldInfo

ATTRIBUTES = "\n\nAttributes:\n"
MAX_WIDTH = 88  # of what is said of a field
INDENT = 8


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
    text = _description(options, name)
    values = [repr(value) for value in get_args(field.annotation) if isinstance(value, str)]
    if len(values) > 1:
        text += f" One of {', '.join(values)}."
    limits = _limits(field)
    if len(limits) == 2:
        text += f" From {limits[0]:g} to {limits[1]:g}."
    if isinstance(field.default, bool | int | float | str | tuple):
        text += f" Default: {field.default!r}."
    return text


def _description(options: type[BaseModel], name: str) -> str:
    """Return what stands below a field in its class, or in a base that has the same field."""
    for base in options.__mro__:
        if issubclass(base, BaseModel) and name in base.model_fields:
            description = base.model_fields[name].description
            if description:
                return description
    return ""


def _limits(field: FieldInfo) -> list[float]:
    """Return the smallest and the largest value that a field takes, as far as there are some."""
    limits = []
    for item in field.metadata:
        for end in ("ge", "le"):
            if hasattr(item, end):
                limits.append(getattr(item, end))
    return limits
