"""RootSIFT that says of itself that its frames tell nothing, as learned features do."""

from __future__ import annotations

from typing import ClassVar, Literal

from colmap_affrect.features.sift import RootSift, SiftOptions


class ShapelessOptions(SiftOptions):
    name: Literal["shapeless"] = "shapeless"  # type: ignore[assignment]
    has_shapes: ClassVar[bool] = False


class Shapeless(RootSift):
    Options = ShapelessOptions
