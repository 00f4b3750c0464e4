"""Errors are data: what, where and advice; options are named by who shows them."""

from __future__ import annotations

import ast
import logging
import re
from functools import cache
from pathlib import Path

import colmap_affrect
from colmap_affrect import errors
from colmap_affrect.cli import _OneLine
from colmap_affrect.cli.flags import FLAGS
from colmap_affrect.errors import (
    AffrectError,
    Logged,
    Option,
    OptionError,
    Row,
    with_arguments,
    with_flags,
)

PACKAGE = Path(colmap_affrect.__file__).parent
OURS = {
    name
    for name, value in vars(errors).items()
    if isinstance(value, type) and issubclass(value, AffrectError)
}
LOGGING = ("warning", "error")  # methods of a logger
# In front of a command flags keep their dashes; so do messages of the command line itself
FLAG = re.compile(r"(?<!\w)--[a-z]")
COMMAND = re.compile(r"(?:colmap-affrect|colmap|pip|see) [^';)]*")


@cache
def calls() -> list[tuple[str, str, ast.Call]]:
    """Return all calls that make an error or an option, or that log, with name and place."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if not any(f"{name}(" in source for name in ("Error", "Option", *LOGGING)):
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                if name in {*OURS, *LOGGING, "Option"}:
                    found.append((name, f"{path}:{node.lineno}", node))
    return found


def texts_of(node: ast.AST) -> list[str]:
    """Return all texts that a part of a call holds, with a dot for each value in them."""
    if isinstance(node, ast.Constant):
        return [node.value] if isinstance(node.value, str) else []
    if isinstance(node, ast.JoinedStr):
        parts = [texts_of(value) or ["."] for value in node.values]
        return ["".join(text for part in parts for text in part)]
    if isinstance(node, ast.FormattedValue):
        return []
    texts = []
    for child in ast.iter_child_nodes(node):
        texts += texts_of(child)
    return texts


def test_errors_are_raised_in_parts_and_options_are_data() -> None:
    raised = [(place, call) for name, place, call in calls() if name in OURS]
    assert len(raised) > 300
    for place, call in raised:
        texts = [COMMAND.sub("", text) for text in texts_of(call)]
        assert not any(FLAG.search(text) for text in texts), place
        if call.args and isinstance(call.args[0], ast.Constant | ast.JoinedStr):
            (what,) = texts_of(call.args[0])
            has_example = "; the first: " in what or "; known are " in what
            assert "; " not in what or has_example, place


def test_what_is_logged_holds_options_as_data() -> None:
    logged = [item for item in calls() if item[0] in LOGGING]
    assert len(logged) > 20
    for _, place, call in logged:
        texts = [COMMAND.sub("", text) for text in texts_of(call)]
        assert not any(FLAG.search(text) for text in texts), place


def test_log_of_the_command_line_names_flags_and_that_of_programs_arguments() -> None:
    said = ("raise ", Option("max-distance-m"))
    arguments = ("gps", Logged(said), OptionError("no", where=Option("gps", "a.db")))
    record = logging.LogRecord(
        "x", logging.WARNING, "x.py", 1, "%s: %s; %s", arguments, None
    )
    flags = "gps: raise --max-distance-m; --gps a.db: no"
    assert _OneLine("%(message)s").format(record) == flags
    assert record.getMessage().startswith("gps: raise pairs.max_distance_m; ")


def test_want_of_memory_is_known_by_its_cause() -> None:
    cause = ImportError("_core.so: failed to map segment from shared object")
    error = RuntimeError("Cannot import the C++ backend")
    assert not errors.lacks_memory(error)
    error.__cause__ = cause
    assert errors.lacks_memory(error)


def test_options_in_errors_are_flags_of_the_command_line() -> None:
    flags = set()
    for names in FLAGS:
        flags.update(re.findall(r"--([a-z-]+)", names))
    named = set()
    for name, _, call in calls():
        first = call.args[0] if name == "Option" else None
        if isinstance(first, ast.Constant):
            named.add(first.value)
    assert len(named) > 30
    assert named <= flags | {"set", "overwrite"}


def test_who_shows_an_error_says_how_options_are_called() -> None:
    row = Row(Option("cameras-path", "c.csv"), "line 3")
    error = AffrectError(
        "says nothing", where=row, advice=("leave ", Option("camera-mode"), " out")
    )
    wrapped = AffrectError(error, where="run")
    assert with_arguments(wrapped.words) == (
        "run: cameras.cameras_path c.csv, line 3: says nothing; leave cameras.mode out"
    )
    assert with_flags(wrapped.words) == (
        "run: --cameras-path c.csv, line 3: says nothing; leave --camera-mode out"
    )
    assert with_arguments(Row("", "the options")) == "the options"
