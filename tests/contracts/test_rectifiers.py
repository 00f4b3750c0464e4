"""Every registered rectifier keeps the contract, with either shape source where it reads one."""

from __future__ import annotations

import numpy as np
from contracts.rectifier_contract import RectifierContract
from numpy.typing import NDArray

from colmap_affrect.features.second_moment import SecondMoment
from colmap_affrect.interfaces import Rectifier, Sources
from colmap_affrect.options import (
    RECTIFIER_OPTIONS,
    AsiftOptions,
    DepthPlanesOptions,
    SecondMomentOptions,
)
from colmap_affrect.rectifiers.registry import BUILT_IN, make_rectifier
from colmap_affrect.types import Photograph


class Corner:
    """Depth of two walls that meet in the middle, 60 degrees from the image plane each."""

    def depth(self, photograph: Photograph) -> NDArray[np.float32]:
        width, height = photograph.size
        columns = (np.arange(width) - photograph.camera_matrix[0, 2]) / photograph.camera_matrix[
            0, 0
        ]
        row = 4.0 / (1.0 + np.sqrt(3.0) * np.abs(columns))
        return np.tile(row, (height, 1)).astype(np.float32)


class NoDepth:
    """A map without a single known value."""

    def depth(self, photograph: Photograph) -> NDArray[np.float32]:
        return np.full(photograph.gray.shape, np.nan, np.float32)


SOURCES = Sources(SecondMoment(SecondMomentOptions()), Corner())


def test_every_registered_rectifier_is_here() -> None:
    tested = {cls.__name__ for cls in RectifierContract.__subclasses__()}
    for name in BUILT_IN:
        assert "Test" + name.title().replace("-", "") in tested
    assert set(BUILT_IN) == set(RECTIFIER_OPTIONS)


def rectifier(name: str) -> Rectifier:
    return make_rectifier(RECTIFIER_OPTIONS[name](), SOURCES)


class TestIdentity(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("identity")


class TestAsift(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("asift")


class TestAsiftOfThePaper(RectifierContract):
    def make(self) -> Rectifier:
        return make_rectifier(AsiftOptions(covering="asift", area_preserving=False), SOURCES)


class TestAffnetShapes(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("affnet-shapes")


class TestDenseShapes(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("dense-shapes")


class TestDepthPlanes(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("depth-planes")


class TestDepthPlanesOfThePaper(RectifierContract):
    def make(self) -> Rectifier:
        return make_rectifier(DepthPlanesOptions(keep_original="outside"), SOURCES)


class TestDepthPlanesWithoutDepth(RectifierContract):
    def make(self) -> Rectifier:
        return make_rectifier(DepthPlanesOptions(), Sources(None, NoDepth()))


class TestDepthAffnet(RectifierContract):
    def make(self) -> Rectifier:
        return rectifier("depth-affnet")
