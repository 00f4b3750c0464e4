"""Rectifiers by the options that name them."""

from __future__ import annotations

from collections.abc import Callable

from colmap_affrect.interfaces import Rectifier, Sources
from colmap_affrect.options import RECTIFIERS, RectifierOptions, entry_points
from colmap_affrect.rectifiers.covers import AffNetShapes, Asift, Identity
from colmap_affrect.rectifiers.dense_shapes import DenseShapes
from colmap_affrect.rectifiers.depth_affnet import DepthAffNet
from colmap_affrect.rectifiers.depth_planes import DepthPlanes

BUILT_IN: dict[str, Callable[..., Rectifier]] = {
    "identity": Identity,
    "asift": Asift,
    "affnet-shapes": AffNetShapes,
    "depth-planes": DepthPlanes,
    "depth-affnet": DepthAffNet,
    "dense-shapes": DenseShapes,
}


def make_rectifier(options: RectifierOptions, sources: Sources) -> Rectifier:
    """Build the rectifier that the options belong to."""
    if options.name in BUILT_IN:
        return BUILT_IN[options.name](options, sources)
    rectifier: Rectifier = entry_points(RECTIFIERS)[options.name].load()(options, sources)
    return rectifier
