"""Methods by name: COLMAP's SIFT, and recipes with or without changed options."""

import re
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from colmap_affrect.errors import OptionError
from colmap_affrect.options import suggestion
from colmap_affrect.recipes import Recipe, load_recipe, recipe_names

SIFT_COLMAP = "sift-colmap"  # COLMAP's SIFT, verification and mapping
SIFT = "sift"  # COLMAP's SIFT, with our verification and mapping
SIFT_SUMMARIES = {
    SIFT_COLMAP: "SIFT, verification and mapping as COLMAP does them by default",
    SIFT: "COLMAP's SIFT with its default options",
}


@dataclass(frozen=True)
class Method:
    """What is compared: features and raw matches, by a recipe or by COLMAP's SIFT."""

    label: str  # its name in the results
    recipe: Recipe | None  # None for COLMAP's SIFT

    @property
    def summary(self) -> str:
        """One line for people."""
        return self.recipe.summary if self.recipe else SIFT_SUMMARIES[self.label]

    @property
    def options(self) -> dict[str, Any]:
        """Options of features and matching."""
        return self.recipe.to_mapping() if self.recipe else {}

    @property
    def escalates(self) -> bool:
        """Whether pairs that fail verification are matched again."""
        return bool(self.recipe and self.recipe.extraction.escalation)

    @property
    def folder_name(self) -> str:
        """Name of the folder of its results, different for every label."""
        name = re.sub(r"[^\w-]+", "_", self.label)
        if name == self.label:
            return name
        return f"{name}-{zlib.crc32(self.label.encode()):08x}"


def _as_tuple(given: Any) -> Any:
    return (given,) if isinstance(given, str) else given


GivenMethods = Annotated[
    tuple[str | Method, ...], BeforeValidator(_as_tuple), Field(strict=False)
]
"""Field of options that takes what :func:`parse_methods` takes, a single text too."""


def parse_methods(
    given: Iterable[str | Method], depth_settings: Sequence[str] = ()
) -> tuple[Method, ...]:
    """Read methods.

    Args:
        given: methods, or texts with one or several of them, separated by commas, as
            :func:`parse_method` takes them. What follows a colon belongs to the last of a text.
        depth_settings: ``KEY=VALUE`` for recipes that use depth.

    Returns:
        The methods in the order given.

    Raises:
        OptionError: none is given, two have the same name, or one is not known.
    """
    methods: list[Method] = []
    for method in given:
        if isinstance(method, Method):
            methods.append(method)
        else:
            methods += _parse_list(method, depth_settings)
    if not methods:
        raise OptionError("no method given")
    for label, count in Counter(method.label for method in methods).items():
        if count > 1:
            other = "give one another name, as in NAME=RECIPE"
            raise OptionError(f"two methods are called '{label}'", advice=other)
    return tuple(methods)


def _parse_list(text: str, depth_settings: Sequence[str]) -> list[Method]:
    """Read methods separated by commas; what follows a colon belongs to the last one."""
    head, colon, settings = text.partition(":")
    *names, last = (name.strip() for name in head.split(","))
    methods = [parse_method(name, depth_settings) for name in names if name]
    if last:
        methods.append(parse_method(last + colon + settings, depth_settings))
    return methods


def parse_method(text: str, depth_settings: Sequence[str] = ()) -> Method:
    """Read ``sift-colmap``, ``sift`` or ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``.

    Commas inside of brackets belong to a value. The recipe is a name or the path of a TOML file.

    Args:
        text: the method.
        depth_settings: ``KEY=VALUE`` for a recipe that uses depth.

    Returns:
        The method, with its recipe loaded.

    Raises:
        OptionError: something is not known.
    """
    if text in SIFT_SUMMARIES:
        return Method(text, None)
    head, _, settings = text.partition(":")
    label, _, name = head.rpartition("=")
    if label in SIFT_SUMMARIES:
        raise OptionError(
            f"'{label}' is COLMAP's", where=text, advice="choose another name"
        )
    if not name.endswith(".toml") and name not in recipe_names():
        known = [*SIFT_SUMMARIES, *recipe_names()]
        raise OptionError(f"unknown method '{name}'{suggestion(name, known)}")
    changes = re.split(r",(?![^\[\]]*\])", settings) if settings else []
    recipe = load_recipe(name, changes)
    if recipe.extraction.uses_depth:
        recipe = load_recipe(name, [*changes, *depth_settings])
    if not label:
        is_file = name.endswith(".toml")
        label = text.replace(name, PurePath(name).stem) if is_file else text
    return Method(label, recipe)
