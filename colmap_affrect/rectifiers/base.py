"""What a rectifier is: it decides which warps of a photograph to look at.

Entry points are in the group ``colmap_affrect.rectifiers``. Several threads may call an object.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

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
    depth: DepthMaps | None = None  # None when the recipe needs no depth


class RectifierOptions(PartOptions):
    """Base of the options of all rectifiers."""

    uses_depth: ClassVar[bool] = False
    """Whether it reads a depth map of every photograph."""


class AffineWarpOptions(RectifierOptions):
    """How large affine warps are rendered."""

    area_preserving: bool = True
    """Warp by diag(sqrt t, 1 / sqrt t), which keeps the area; False: by diag(1, 1 / t), which
    never magnifies (the paper)."""

    def warp(self, region: Region, tilt: float, angle_rad: float, segment_id: int) -> Rectification:
        """Show a region by the affine map of the class (tilt, angle)."""
        linear = rectifying_affine(tilt, angle_rad, area_preserving=self.area_preserving)
        canvas = fit_canvas(linear, region.outline(), MARGIN_PX)
        return Rectification(*canvas, region.mask, tilt, angle_rad, region.origin, segment_id)


class CoverOptions(AffineWarpOptions):
    """Greedy cover of the affine shapes of a photograph in the space of tilts."""

    shape_source: Annotated[SerializeAsAny[ShapeOptions], BeforeValidator(SHAPES.options)] = (
        SecondMomentOptions()
    )
    """Where affine shapes come from: its name, or a section with ``name`` and options."""
    tilt_radius: Annotated[float, within(1.05, 10.0)] = 1.7
    """Radius r of a covering ball as a tilt ratio. Paper: 1.7."""
    max_tilt: Annotated[float, within(1.0, 20.0)] = 5.8
    """Shapes of a larger tilt neither vote nor count. Paper: 5.8."""
    covered_frac: Annotated[float, within(0.0, 1.0)] = 0.95
    """Share of the shapes that the balls must hold. Paper: 0.95."""
    max_num_rectifications: Annotated[int, within(0, 192)] = 8
    """Upper bound on the covering maps."""

    def cover(self, metrics: Floats, votes: Floats | None = None) -> Cover:
        """Cover (N, 3) metrics, each with one vote unless (N,) votes are given."""
        return cover_shapes(
            metrics,
            np.ones(len(metrics)) if votes is None else votes,
            radius=self.tilt_radius,
            max_tilt=self.max_tilt,
            covered_frac=self.covered_frac,
            max_num_centers=self.max_num_rectifications,
        )


class WithInputs:
    """Base of our rectifiers: what their options ask for is there, as ``shapes`` and ``depth``."""

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
    },
    default="dense-shapes",
    protocol=Rectifier,
)
