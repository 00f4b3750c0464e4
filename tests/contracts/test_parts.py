"""Every part that is registered keeps its contract; networks have random weights."""

from __future__ import annotations

from math import ceil
from pathlib import Path

import numpy as np
import pytest
from contracts.contracts import (
    IMAGES,
    ExtractorContract,
    MatcherContract,
    RectifierContract,
)
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from random_weights import write_comparing_lightglue, write_random_weights

from colmap_affrect.data import Photograph
from colmap_affrect.features.base import (
    EXTRACTORS,
    SHAPES,
    FeatureExtractor,
    NetworkContext,
)
from colmap_affrect.features.second_moment import SecondMoment, SecondMomentOptions
from colmap_affrect.geometry.tilts import STEP_PX
from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext
from colmap_affrect.rectifiers.affine_warps import AsiftOptions
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    Rectifier,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.rectifiers.depth_planes import DepthPlanesOptions

FEATURES = {
    **{name: {"name": name} for name in EXTRACTORS.names()},
    "affnet-hardnet": {"name": "affnet-hardnet", "max_num_features": 60},
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


LONG = ["aliked"]  # takes seconds


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(name, marks=[pytest.mark.long] * (name in LONG))
        for name in FEATURES
    ],
)
class TestExtractors(ExtractorContract):
    @pytest.fixture(autouse=True)
    def _case(self, case: str, weights: dict[str, Path]) -> None:
        options = EXTRACTORS.options(FEATURES[case])
        self.frames_turn = not options.uses_network
        self.extractor = EXTRACTORS.make(options, NetworkContext(weights))

    def make(self) -> FeatureExtractor:
        return self.extractor


@pytest.fixture(scope="module")
def comparing(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    path = tmp_path_factory.mktemp("weights") / "lightglue.pth"
    return {"lightglue-aliked": write_comparing_lightglue(path)}


@pytest.mark.parametrize("name", MATCHERS.names(), scope="class")
class TestMatchers(MatcherContract):
    @pytest.fixture(autouse=True)
    def _named(self, name: str, comparing: dict[str, Path]) -> None:
        self.name = name
        self.comparing = comparing

    def make(self) -> Matcher:
        return MATCHERS.make(
            MATCHERS.options(self.name), MatcherContext(self.comparing)
        )


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


RECTIFIER_INPUTS = RectifierInputs(SecondMoment(SecondMomentOptions()), Corner())

RECTIFIER_CASES: dict[str, tuple[RectifierOptions, RectifierInputs]] = {
    **{
        name: (RECTIFIERS.options(name), RECTIFIER_INPUTS)
        for name in RECTIFIERS.names()
    },
    "asift of the paper": (
        AsiftOptions(covering="asift", area_preserving=False),
        RECTIFIER_INPUTS,
    ),
    "depth-planes of the paper": (
        DepthPlanesOptions(keep_original="outside"),
        RECTIFIER_INPUTS,
    ),
    "depth-planes without depth": (
        DepthPlanesOptions(),
        RectifierInputs(None, NoDepth()),
    ),
}


@pytest.mark.parametrize("name", RECTIFIER_CASES)
class TestRectifier(RectifierContract):
    @pytest.fixture(autouse=True)
    def _name(self, name: str) -> None:
        self.options_of_case, self.sources = RECTIFIER_CASES[name]
        self.finds_warps = name != "depth-planes without depth"

    def options(self) -> RectifierOptions:
        return self.options_of_case

    def make(self) -> Rectifier:
        return RECTIFIERS.make(self.options(), self.sources)


UNIT_ERROR = 1e-4


def assert_unit_metrics(metrics: np.ndarray) -> None:
    first, second, mixed = np.moveaxis(metrics, -1, 0)
    assert (first > 0).all()
    assert_allclose(first * second - mixed**2, 1.0, atol=UNIT_ERROR, rtol=UNIT_ERROR)


@pytest.mark.parametrize("name", SHAPES.names())
def test_shapes_are_unit_metrics_by_block_and_by_sample(
    name: str, weights: dict[str, Path]
) -> None:
    source = SHAPES.make(SHAPES.options(name), NetworkContext(weights), None)
    image = IMAGES["textured"]
    grid = source.grid(image)
    samples = source.samples(image)
    cells = tuple(ceil(length / STEP_PX) for length in image.shape)
    assert grid.textured.shape == cells
    assert grid.metrics.shape == (*cells, 3)
    assert (grid.step_px, grid.origin_px) == (STEP_PX, (STEP_PX - 1) / 2)
    assert grid.textured.any()
    assert_unit_metrics(grid.metrics)
    assert samples.points.shape == (len(samples.metrics), 2)
    assert len(samples.points) > 10
    assert (samples.points >= 0).all()
    assert (
        samples.points < STEP_PX * np.array(cells[::-1])
    ).all()  # the last ones may stick out
    assert_unit_metrics(samples.metrics)
    flat = source.grid(IMAGES["flat"])
    assert not flat.textured.any()
    assert_allclose(flat.metrics, np.broadcast_to([1.0, 1.0, 0.0], flat.metrics.shape))
    assert len(source.samples(IMAGES["flat"]).points) == 0
