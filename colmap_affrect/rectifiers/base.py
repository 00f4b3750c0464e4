"""The protocol of rectifiers, their common options, and their registry.

A rectifier decides which warps of a photograph features are extracted from. Rectifiers of other
packages are entry points of the group ``colmap_affrect.rectifiers``. Several threads may call one
object.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from pydantic import BeforeValidator, SerializeAsAny

from colmap_affrect.data import Photograph, Rectification, RectificationPlan
from colmap_affrect.features.base import SHAPES, ShapeOptions, ShapeSource
from colmap_affrect.features.second_moment import SecondMomentOptions
from colmap_affrect.geometry.affine import fit_canvas, rectifying_affine
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.tilts import Cover, cover_shapes
from colmap_affrect.images.depth import DepthMaps
from colmap_affrect.options import PartOptions, Registry, within
from colmap_affrect.rectifiers.regions import MARGIN_PX, Region


class Rectifier(Protocol):
    """Plans warps; called with its ``Options`` and :class:`RectifierInputs`."""

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan the warps of one photograph."""


@dataclass(frozen=True)
class RectifierInputs:
    """What a rectifier may read beside the photograph."""

    shapes: ShapeSource | None = None  # the source that its options name, if any
    depth: DepthMaps | None = None  # None if the recipe needs no depth


Warps = Literal["none", "some", "all tilts"]
"""Which views a rectifier adds to a photograph: none; some, such as those that its content or its
depth asks for, or a few that are always the same; all tilts, those of a cover of all directions,
whatever the photograph shows."""


class RectifierOptions(PartOptions):
    """Base of the options of all rectifiers."""

    warps: ClassVar[Warps]
    """Every rectifier declares it: what matching its views again costs and brings hangs on it."""
    uses_depth: ClassVar[bool] = False
    """Whether it reads a depth map of every photograph."""


class AffineWarpOptions(RectifierOptions):
    """How large affine warps are rendered."""

    area_preserving: bool = True
    """Warp by diag(sqrt t, 1 / sqrt t), which keeps the area; False: by diag(1, 1 / t), which
    never magnifies (the paper)."""

    def warp(
        self, region: Region, tilt: float, angle_rad: float, segment_id: int
    ) -> Rectification:
        """Plan the warp of a region by the rectifying map of a tilt class.

        Args:
            region: part of the photograph.
            tilt: of the class.
            angle_rad: of the class.
            segment_id: number of the region, for reports.

        Returns:
            The warp, on a canvas that just holds the region.
        """
        linear = rectifying_affine(
            tilt, angle_rad, area_preserving=self.area_preserving
        )
        matrix, canvas_size = fit_canvas(linear, region.outline(), MARGIN_PX)
        return Rectification(
            rectified_from_image=matrix,
            canvas_size=canvas_size,
            region=region.mask,
            tilt=tilt,
            tilt_angle_rad=angle_rad,
            region_origin=region.origin,
            segment_id=segment_id,
        )


class CoverOptions(AffineWarpOptions):
    """Greedy cover of the affine shapes of a photograph in the space of tilts."""

    shape_source: Annotated[
        SerializeAsAny[ShapeOptions], BeforeValidator(SHAPES.options)
    ] = SecondMomentOptions()
    """Where affine shapes come from: its name, or a section with ``name`` and options."""
    tilt_radius: Annotated[float, within(1.05, 10.0)] = 1.7
    """Radius r of a covering ball as a tilt ratio. Paper: 1.7."""
    max_tilt: Annotated[float, within(1.0, 20.0)] = 5.8
    """Shapes of a larger tilt neither vote nor count. Paper: 5.8."""
    covered_frac: Annotated[float, within(0.0, 1.0)] = 0.95
    """Share of the shapes that the balls must hold. Paper: 0.95."""
    max_num_rectifications: Annotated[int, within(0, 192)] = 8  # resource
    """Upper bound on the covering maps."""

    def cover(self, metrics: Floats, votes: Floats | None = None) -> Cover:
        """Cover shapes, each with one vote by default.

        Args:
            metrics: (N, 3) unit metrics of the shapes.
            votes: (N,) numbers >= 0.

        Returns:
            The centres, and to which of them each shape belongs.
        """
        if votes is None:
            votes = np.ones(len(metrics))
        return cover_shapes(
            metrics,
            votes,
            radius=self.tilt_radius,
            max_tilt=self.max_tilt,
            covered_frac=self.covered_frac,
            max_num_centers=self.max_num_rectifications,
        )


class WithInputs:
    """Base of our rectifiers. ``shapes`` and ``depth`` are there if the options ask for them."""

    def __init__(self, options: Any, inputs: RectifierInputs) -> None:
        self.options = options
        self.shapes: Any = inputs.shapes
        self.depth: Any = inputs.depth


RECTIFIERS: Registry[Rectifier] = Registry(
    kind="rectifier",
    group="colmap_affrect.rectifiers",
    built_in={
        "identity": "colmap_affrect.rectifiers.affine_warps:Identity",
        "asift": "colmap_affrect.rectifiers.affine_warps:Asift",
        "affnet-shapes": "colmap_affrect.rectifiers.affine_warps:AffNetShapes",
        "depth-planes": "colmap_affrect.rectifiers.depth_planes:DepthPlanes",
        "depth-affnet": "colmap_affrect.rectifiers.depth_planes:DepthAffNet",
        "dense-shapes": "colmap_affrect.rectifiers.affine_warps:DenseShapes",
        "lines": "colmap_affrect.rectifiers.line_planes:LinePlanes",
    },
    default="dense-shapes",
    protocol=Rectifier,
    options_base=RectifierOptions,
)
