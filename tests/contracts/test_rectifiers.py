"""Every registered rectifier keeps the contract, also with options of the paper and no depth."""

from __future__ import annotations

import numpy as np
import pytest
from contracts.rectifier_contract import RectifierContract
from numpy.typing import NDArray

from colmap_affrect.data import Photograph
from colmap_affrect.features.second_moment import SecondMoment, SecondMomentOptions
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    Rectifier,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.rectifiers.depth_planes import DepthPlanesOptions
from colmap_affrect.rectifiers.whole_image import AsiftOptions


class Corner:
    """Depth of two walls that meet in the middle, 60 degrees from the image plane each."""

    def depth(self, photograph: Photograph) -> NDArray[np.float32]:
        width, height = photograph.size
        camera = photograph.camera_matrix
        columns = (np.arange(width) - camera[0, 2]) / camera[0, 0]
        row = 4.0 / (1.0 + np.sqrt(3.0) * np.abs(columns))
        return np.tile(row, (height, 1)).astype(np.float32)


class NoDepth:
    """A map without a single known value."""

    def depth(self, photograph: Photograph) -> NDArray[np.float32]:
        return np.full(photograph.gray.shape, np.nan, np.float32)


SOURCES = RectifierInputs(SecondMoment(SecondMomentOptions()), Corner())

CASES: dict[str, tuple[RectifierOptions, RectifierInputs]] = {
    **{name: (RECTIFIERS.options(name), SOURCES) for name in RECTIFIERS.names()},
    "asift of the paper": (AsiftOptions(covering="asift", area_preserving=False), SOURCES),
    "depth-planes of the paper": (DepthPlanesOptions(keep_original="outside"), SOURCES),
    "depth-planes without depth": (DepthPlanesOptions(), RectifierInputs(None, NoDepth())),
}


@pytest.mark.parametrize("name", CASES)
class TestRectifier(RectifierContract):
    @pytest.fixture(autouse=True)
    def _name(self, name: str) -> None:
        self.options, self.sources = CASES[name]

    def make(self) -> Rectifier:
        return RECTIFIERS.make(self.options, self.sources)
