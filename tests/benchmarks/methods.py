"""Methods as benchmarks take them on the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass

from colmap_affrect.recipes import Recipe, load_recipe

SIFT_METHODS = ("sift", "sift-affine-dsp")


@dataclass(frozen=True)
class Method:
    """A recipe under the name it has in the tables; None for COLMAP's SIFT."""

    label: str
    recipe: Recipe | None


def parse_method(text: str, *, with_sift: bool = False) -> Method:
    """Read ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``; commas inside of brackets belong to a value.

    With ``with_sift`` also the names of COLMAP's SIFT.
    """
    if with_sift and text in SIFT_METHODS:
        return Method(text, None)
    head, _, settings = text.partition(":")
    label, _, name = head.rpartition("=")
    changes = re.split(r",(?![^\[\]]*\])", settings) if settings else []
    return Method(label or text, load_recipe(name, changes))
