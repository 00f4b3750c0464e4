"""Rectifier ``depth-affnet``: each planar segment is warped by a cover of the shapes inside it.

The paper's DepthAffNet (Sec. 3): segments as in ``depth-planes``, maps as in ``affnet-shapes``.
"""

from __future__ import annotations

from typing import ClassVar, Literal

from colmap_affrect.data import Photograph, Rectification, RectificationPlan
from colmap_affrect.rectifiers.base import CoverOptions, WithInputs
from colmap_affrect.rectifiers.depth_planes import PlaneOptions, planar_segments
from colmap_affrect.rectifiers.regions import affine_rectification


class DepthAffNetOptions(CoverOptions):
    """Planar regions from depth, each warped by a cover of the shapes inside it."""

    name: Literal["depth-affnet"] = "depth-affnet"
    planes: PlaneOptions = PlaneOptions()
    uses_depth: ClassVar[bool] = True


class DepthAffNet(WithInputs):
    """Planar segments, each warped by the affine maps that cover its shapes."""

    Options = DepthAffNetOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan the warps of each segment; one without tilted shapes has none.

        Raises:
            DepthError: when there is no usable depth map.
        """
        options = self.options
        segments = planar_segments(photograph, self.depth.depth(photograph), options.planes)
        samples = self.shapes.samples(photograph.gray)
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            inside = segment.region.contains(samples.points)
            centers = options.cover(samples.metrics[inside]).centers
            items += [
                affine_rectification(
                    segment.region, tilt, angle, number, area_preserving=options.area_preserving
                )
                for tilt, angle in centers.tolist()
            ]
        return RectificationPlan(photograph.size, tuple(items))
