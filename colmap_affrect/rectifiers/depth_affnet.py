"""Rectifier ``depth-affnet``: each planar segment is warped by a cover of the shapes inside it.

The paper's DepthAffNet (Sec. 3): segments as in ``depth-planes``, maps as in ``affnet-shapes``.
"""

from __future__ import annotations

from colmap_affrect.interfaces import Sources
from colmap_affrect.options import DepthAffNetOptions
from colmap_affrect.rectifiers.covers import covering_centers
from colmap_affrect.rectifiers.depth_planes import planar_segments
from colmap_affrect.rectifiers.regions import affine_rectification
from colmap_affrect.types import Photograph, Rectification, RectificationPlan


class DepthAffNet:
    """Planar segments, each warped by the affine maps that cover its shapes."""

    Options = DepthAffNetOptions

    def __init__(self, options: DepthAffNetOptions, sources: Sources) -> None:
        """See :mod:`colmap_affrect.interfaces`."""
        self.options = options
        self.shapes = sources.required_shapes()
        self.source = sources.required_depth()

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan the warps of each segment; one without tilted shapes has none.

        Raises:
            DepthError: when there is no usable depth map.
        """
        options = self.options
        segments = planar_segments(photograph, self.source.depth(photograph), options.planes)
        samples = self.shapes.samples(photograph.gray)
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            inside = segment.region.contains(samples.points)
            centers = covering_centers(samples.metrics[inside], options)
            items += [
                affine_rectification(
                    segment.region, tilt, angle, number, area_preserving=options.area_preserving
                )
                for tilt, angle in centers.tolist()
            ]
        return RectificationPlan(photograph.size, tuple(items))
