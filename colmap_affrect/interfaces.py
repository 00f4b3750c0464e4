"""What the exchangeable parts are: feature profiles, shape sources, depth sources, rectifiers.

A class of another package becomes known by an entry point of the group
``colmap_affrect.rectifiers`` or ``colmap_affrect.features``. Its attribute ``Options`` is a
subclass of :class:`colmap_affrect.options.RectifierOptions` or ``FeatureOptions``; it is
called with an instance of that and with :class:`Sources` or :class:`Computing`. Several threads
may call the same object at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.errors import OptionError
from colmap_affrect.types import (
    GrayImage,
    LocalFeatures,
    Photograph,
    RectificationPlan,
    ShapeGrid,
    ShapeSamples,
    View,
)


@dataclass(frozen=True)
class Computing:
    """What networks run with.

    Attributes:
        weights: files by key, found beforehand (:mod:`colmap_affrect.features.weights`).
        device: ``cpu``, ``cuda``, ``cuda:1``, ``mps``.
    """

    weights: Mapping[str, Path] = field(default_factory=dict)
    device: str = "cpu"


class FeatureProfile(Protocol):
    """Detection and description of local features.

    Attributes:
        descriptor_size: D, also of an image without features.
    """

    descriptor_size: int

    def detect(self, view: View) -> LocalFeatures:
        """Return features of one view, frames in its px; descriptors may be (N, 0) still."""

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        """Describe features that :meth:`detect` found, a list element for each image.

        The result is the same for images that are given together or one by one.
        """


class ShapeSource(Protocol):
    """Affine shapes of an image."""

    def grid(self, image: GrayImage) -> ShapeGrid:
        """Return one shape per 4 x 4 block of a (H, W) uint8 image."""

    def samples(self, image: GrayImage) -> ShapeSamples:
        """Return shapes at points of a (H, W) uint8 image."""


class DepthSource(Protocol):
    """Depth maps of photographs."""

    def depth(self, photograph: Photograph) -> NDArray[np.float32]:
        """Return (h, w) z-depth > 0, NaN where unknown, of any resolution over the whole image.

        Raises:
            DepthError: when there is no usable map.
        """

    def require_some(self, names: Sequence[str]) -> None:
        """Raise DepthError when there cannot be a map for any of the images named."""


@dataclass(frozen=True)
class Sources:
    """What a rectifier may read beside the photograph.

    Attributes:
        shapes: the source that its options name; None if they name none.
        depth: None when the recipe needs no depth.
    """

    shapes: ShapeSource | None = None
    depth: DepthSource | None = None

    def required_shapes(self) -> ShapeSource:
        """Return the shape source.

        Raises:
            OptionError: when there is none.
        """
        if self.shapes is None:
            raise OptionError("the rectifier needs affine shapes: name a shape_source")
        return self.shapes

    def required_depth(self) -> DepthSource:
        """Return the depth source.

        Raises:
            OptionError: when there is none.
        """
        if self.depth is None:
            raise OptionError("the rectifier needs depth maps: give a folder or a depth network")
        return self.depth


class Rectifier(Protocol):
    """Decides which warps of a photograph to look at."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan the warps of one photograph."""
