"""Methods by name: COLMAP's SIFT, and recipes with or without changed options."""

import re
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from colmap_affrect.errors import OptionError
from colmap_affrect.options import suggestion
from colmap_affrect.recipes import Recipe, load_recipe, recipe_names

SIFT_COLMAP, SIFT = "sift-colmap", "sift"
SIFT_SUMMARIES = {
    SIFT_COLMAP: "SIFT, verification and mapping as COLMAP does them by default",
    SIFT: "COLMAP's SIFT with its default options",
}


@dataclass(frozen=True)
class Method:
    """A recipe under the name it has in the results; None for COLMAP's SIFT."""

    label: str
    recipe: Recipe | None

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
        plain = re.sub(r"[^\w-]+", "_", self.label)
        return plain if plain == self.label else f"{plain}-{zlib.crc32(self.label.encode()):08x}"


def _as_tuple(given: Any) -> Any:
    return (given,) if isinstance(given, str) else given


GivenMethods = Annotated[tuple[str | Method, ...], BeforeValidator(_as_tuple), Field(strict=False)]
"""Field of options that takes what :func:`parse_methods` takes, a single text too."""


def parse_methods(
    given: Iterable[str | Method], depth_settings: Sequence[str] = ()
) -> tuple[Method, ...]:
    """Read methods as :func:`parse_method` takes them, several separated by commas.

    What follows a colon belongs to the last of a text. OptionError for none, or two of one name.
    """
    methods: list[Method] = []
    for text in given:
        if isinstance(text, Method):
            methods.append(text)
            continue
        head, colon, settings = text.partition(":")
        *names, last = (name.strip() for name in head.split(","))
        texts = [*names, last and last + colon + settings]
        methods += [parse_method(each, depth_settings) for each in texts if each]
    if not methods:
        raise OptionError("no method given")
    labels = [method.label for method in methods]
    if twice := [label for label in labels if labels.count(label) > 1]:
        other = "give one another name, as in NAME=RECIPE"
        raise OptionError(f"two methods are called '{twice[0]}'; {other}")
    return tuple(methods)


def parse_method(text: str, depth_settings: Sequence[str] = ()) -> Method:
    """Read ``sift-colmap``, ``sift`` or ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``.

    Commas inside of brackets belong to a value. The recipe is a name or the path of a TOML file;
    one that uses depth gets the ``depth_settings`` too. OptionError for what is not known.
    """
    if text in SIFT_SUMMARIES:
        return Method(text, None)
    head, _, settings = text.partition(":")
    label, _, name = head.rpartition("=")
    if label in SIFT_SUMMARIES:
        raise OptionError(f"{text}: '{label}' is COLMAP's; choose another name")
    if not name.endswith(".toml") and name not in recipe_names():
        known = [*SIFT_SUMMARIES, *recipe_names()]
        raise OptionError(f"unknown method '{name}'{suggestion(name, known)}")
    changes = re.split(r",(?![^\[\]]*\])", settings) if settings else []
    recipe = load_recipe(name, changes)
    if recipe.extraction.uses_depth:
        recipe = load_recipe(name, [*changes, *depth_settings])
    default_label = text.replace(name, PurePath(name).stem) if name.endswith(".toml") else text
    return Method(label or default_label, recipe)
