"""Rectifier ``depth-affnet``: each planar segment is warped by a cover of the shapes inside it.

The paper's DepthAffNet (Sec. 3): segments as in ``depth-planes``, maps as in ``affnet-shapes``.
"""

from __future__ import annotations

import numpy as np

from colmap_affrect.errors import OptionError
from colmap_affrect.geometry.tilts import cover_shapes
from colmap_affrect.interfaces import Sources
from colmap_affrect.options import DepthAffNetOptions
from colmap_affrect.rectifiers.depth_planes import planar_segments, required_depth
from colmap_affrect.rectifiers.regions import affine_rectification
from colmap_affrect.types import Photograph, Rectification, RectificationPlan


class DepthAffNet:
    """Planar segments, each warped by the affine maps that cover its shapes."""

    Options = DepthAffNetOptions

    def __init__(self, options: DepthAffNetOptions, sources: Sources) -> None:
        """See :mod:`colmap_affrect.interfaces`."""
        if sources.shapes is None:
            raise OptionError(f"rectifier {options.name} needs a source of affine shapes")
        self.options = options
        self.shapes = sources.shapes
        self.source = required_depth(sources)

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
            metrics = samples.metrics[segment.region.contains(samples.points)]
            cover = cover_shapes(
                metrics,
                np.ones(len(metrics)),
                radius=options.tilt_radius,
                max_tilt=options.max_tilt,
                covered_frac=options.covered_frac,
                max_num_centers=options.max_num_rectifications,
            )
            items += [
                affine_rectification(
                    segment.region, tilt, angle, number, area_preserving=options.area_preserving
                )
                for tilt, angle in cover.centers.tolist()
            ]
        return RectificationPlan(photograph.size, tuple(items))
