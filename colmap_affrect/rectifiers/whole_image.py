"""Rectifiers whose warps show the whole photograph: none, a fixed cover, a cover of its shapes."""

from typing import Literal

from colmap_affrect.data import Photograph, Rectification, RectificationPlan
from colmap_affrect.geometry.affine import fit_canvas, image_corners, rectifying_affine
from colmap_affrect.geometry.arrays import Floats
from colmap_affrect.geometry.tilts import asift_covering, near_optimal_covering
from colmap_affrect.rectifiers.base import (
    AffineWarpOptions,
    CoverOptions,
    RectifierOptions,
    WithInputs,
)

COVERINGS = {"near-optimal": near_optimal_covering, "asift": asift_covering}


class IdentityOptions(RectifierOptions):
    """No warps."""

    name: Literal["identity"] = "identity"


class Identity(WithInputs):
    """The photograph as it is."""

    Options = IdentityOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan no warps."""
        return RectificationPlan(photograph.size)


class AsiftOptions(AffineWarpOptions):
    """The same warps of the whole image for every photograph."""

    name: Literal["asift"] = "asift"
    covering: Literal["near-optimal", "asift"] = "near-optimal"
    """``near-optimal``: 24 maps that with the identity cover all tilts to 5.8 (Rodriguez et al.
    2018); ``asift``: the 60 of ASIFT with tilts to 8 (Morel & Yu 2009, the paper)."""


class Asift(WithInputs):
    """The same maps for every photograph (Morel & Yu 2009)."""

    Options = AsiftOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Warp the whole photograph by every map of the covering."""
        return plan_whole_image(photograph.size, COVERINGS[self.options.covering](), self.options)


class AffNetShapesOptions(CoverOptions):
    """The whole photograph is warped by every covering map of its shapes."""

    name: Literal["affnet-shapes"] = "affnet-shapes"


class AffNetShapes(WithInputs):
    """A greedy cover of the photograph's own affine shapes (Rodriguez et al. 2018; Sec. 2.4)."""

    Options = AffNetShapesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Warp the whole photograph by every covering map of its shapes."""
        centers = self.options.cover(self.shapes.samples(photograph.gray).metrics).centers
        return plan_whole_image(photograph.size, centers, self.options)


def plan_whole_image(
    image_size: tuple[int, int], centers: Floats, options: AffineWarpOptions
) -> RectificationPlan:
    """Warp an image of (width, height) as a whole by (K, 2) classes (tilt, angle_rad)."""
    items = []
    for tilt, angle in centers.tolist():
        linear = rectifying_affine(tilt, angle, area_preserving=options.area_preserving)
        matrix, canvas_size = fit_canvas(linear, image_corners(image_size), margin_px=0.0)
        items.append(Rectification(matrix, canvas_size, None, tilt, angle))
    return RectificationPlan(image_size, tuple(items))
