"""Recipes: named TOML files that set the options of extraction and matching."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from colmap_affrect.errors import OptionError
from colmap_affrect.options import ExtractionOptions, MatchingOptions, options_class


@dataclass(frozen=True)
class Recipe:
    """What a recipe decides.

    Attributes:
        name: its name, or the path it was read from.
        summary: one line for people.
    """

    name: str
    summary: str
    extraction: ExtractionOptions
    matching: MatchingOptions


def recipe_folder() -> Path:
    """Return the folder of the recipes that come with the package."""
    installed = Path(__file__).parent / "_recipes"
    return installed if installed.is_dir() else Path(__file__).parents[1] / "recipes"


def recipe_names() -> list[str]:
    """Return the names of the recipes that come with the package."""
    return sorted(path.stem for path in recipe_folder().glob("*.toml"))


def load_recipe(name: str, settings: Sequence[str] = ()) -> Recipe:
    """Load a recipe by name or path and change single options.

    Args:
        name: one of :func:`recipe_names`, or the path of a TOML file.
        settings: ``section.option=value`` with a TOML value; strings may go without quotes.

    Raises:
        OptionError: for an unknown recipe or option, or a value out of range.
    """
    values = _read(name)
    for setting in settings:
        _apply(values, setting)
    summary = values.pop("summary", "")
    matching = values.pop("matching", {})
    extraction = ExtractionOptions.from_mapping(values, f"recipe {name}")
    where = f"recipe {name}: matching"
    return Recipe(name, summary, extraction, MatchingOptions.from_mapping(matching, where))


def _read(name: str) -> dict[str, Any]:
    path = Path(name) if name.endswith(".toml") else recipe_folder() / f"{name}.toml"
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        close = difflib.get_close_matches(name, recipe_names(), n=1)
        hint = f"did you mean '{close[0]}'? " if close else ""
        known = ", ".join(recipe_names())
        raise OptionError(f"unknown recipe '{name}': {hint}known are {known}") from error
    except (OSError, ValueError, RecursionError) as error:  # what tomllib raises on odd files
        raise OptionError(f"recipe {path}: cannot be read ({error})") from error


def _apply(values: dict[str, Any], setting: str) -> None:
    key, separator, text = setting.partition("=")
    if not separator or not key.strip():
        raise OptionError(f"--set {setting}: expected section.option=value")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        value = text.strip()
    *sections, option = key.strip().split(".")
    target: Any = values
    for section in sections:
        target = target.setdefault(section, {})
        if not isinstance(target, Mapping):
            raise OptionError(f"--set {setting}: {section} is not a section")
    target[option] = value
    if key.strip() in CHOICES:
        _keep_known(target, key.strip())


CHOICES = {"rectifier.name": "rectifier", "features.profile": "features"}
"""Options that choose the class of their section, which other options there depend on."""


def _keep_known(section: dict[str, Any], key: str) -> None:
    """Drop what the recipe says of another rectifier or profile than the one now chosen."""
    name = CHOICES[key]
    fields = options_class(name, section).__dataclass_fields__
    for option in set(section) - set(fields):
        del section[option]
