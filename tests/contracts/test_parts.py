"""Every part that is registered keeps its contract; networks have random weights."""

from __future__ import annotations

from math import ceil
from pathlib import Path

import numpy as np
import pytest
from contracts.depth_contract import DepthContract
from contracts.extractor_contract import ExtractorContract
from contracts.matcher_contract import MatcherContract
from contracts.rectifier_contract import IMAGES, RectifierContract
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from random_weights import write_comparing_lightglue, write_random_weights

from colmap_affrect.data import Photograph
from colmap_affrect.features.base import (
    EXTRACTORS,
    SHAPES,
    FeatureExtractor,
    NetworkContext,
    ShapeSource,
)
from colmap_affrect.features.second_moment import SecondMoment, SecondMomentOptions
from colmap_affrect.geometry.shapes import STEP_PX
from colmap_affrect.images.depth import DepthFiles, DepthFilesOptions, DepthSource
from colmap_affrect.matchers.base import MATCHERS, Matcher, MatcherContext
from colmap_affrect.rectifiers.base import (
    RECTIFIERS,
    Rectifier,
    RectifierInputs,
    RectifierOptions,
)
from colmap_affrect.rectifiers.depth_planes import DepthPlanesOptions
from colmap_affrect.rectifiers.whole_image import AsiftOptions

FEATURES = {
    **{name: {"name": name} for name in EXTRACTORS.names()},
    "affnet-hardnet": {"name": "affnet-hardnet", "max_num_features": 60},
    "xfeat": {"name": "xfeat", "score_threshold": 0.0},  # random scores are far below the default
}


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


LONG = ["aliked", "disk"]
"""They take seconds; the quickest of the learned features stays."""


@pytest.mark.parametrize(
    "case",
    [pytest.param(name, marks=[pytest.mark.long] * (name in LONG)) for name in FEATURES],
)
class TestExtractors(ExtractorContract):
    @pytest.fixture(autouse=True)
    def _case(self, case: str, weights: dict[str, Path]) -> None:
        self.options, self.network = (
            EXTRACTORS.options(FEATURES[case]),
            NetworkContext(weights),
        )

    def make(self) -> FeatureExtractor:
        return EXTRACTORS.make(self.options, self.network)


MATCHER_CHOICES = {"lightglue": {"name": "lightglue", "trained_for": "sift"}}
"""The contract's features are those of RootSIFT."""


@pytest.fixture(scope="module")
def comparing(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    path = tmp_path_factory.mktemp("weights") / "lightglue.pth"
    return {"lightglue-sift": write_comparing_lightglue(path)}


@pytest.mark.parametrize("name", MATCHERS.names(), scope="class")
class TestMatchers(MatcherContract):
    @pytest.fixture(autouse=True)
    def _named(self, name: str, comparing: dict[str, Path]) -> None:
        self.name, self.comparing = name, comparing

    def make(self) -> Matcher:
        options = MATCHERS.options(MATCHER_CHOICES.get(self.name, self.name))
        assert options.name == self.name
        return MATCHERS.make(options, MatcherContext(self.comparing))


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
    **{name: (RECTIFIERS.options(name), RECTIFIER_INPUTS) for name in RECTIFIERS.names()},
    "asift of the paper": (AsiftOptions(covering="asift", area_preserving=False), RECTIFIER_INPUTS),
    "depth-planes of the paper": (DepthPlanesOptions(keep_original="outside"), RECTIFIER_INPUTS),
    "depth-planes without depth": (DepthPlanesOptions(), RectifierInputs(None, NoDepth())),
}


@pytest.mark.parametrize("name", RECTIFIER_CASES)
class TestRectifier(RectifierContract):
    @pytest.fixture(autouse=True)
    def _name(self, name: str) -> None:
        self.options, self.sources = RECTIFIER_CASES[name]

    def make(self) -> Rectifier:
        return RECTIFIERS.make(self.options, self.sources)


UNIT_ERROR = 1e-4


@pytest.fixture
def source(request: pytest.FixtureRequest, weights: dict[str, Path]) -> ShapeSource:
    return SHAPES.make(SHAPES.options(request.param), NetworkContext(weights), None)


every_source = pytest.mark.parametrize("source", SHAPES.names(), indirect=True)


def assert_unit_metrics(metrics: np.ndarray) -> None:
    first, second, mixed = np.moveaxis(metrics, -1, 0)
    assert (first > 0).all()
    assert_allclose(first * second - mixed**2, 1.0, atol=UNIT_ERROR, rtol=UNIT_ERROR)


@every_source
def test_grid_has_a_unit_metric_for_every_block_in_its_middle(source: ShapeSource) -> None:
    image = IMAGES["textured"]
    grid = source.grid(image)
    cells = tuple(ceil(length / STEP_PX) for length in image.shape)
    assert grid.textured.shape == cells
    assert grid.metrics.shape == (*cells, 3)
    assert (grid.step_px, grid.origin_px) == (STEP_PX, (STEP_PX - 1) / 2)
    assert grid.textured.any()
    assert_unit_metrics(grid.metrics)


@every_source
def test_samples_lie_in_the_image_and_have_unit_metrics(source: ShapeSource) -> None:
    image = IMAGES["textured"]
    samples = source.samples(image)
    assert samples.points.shape == (len(samples.metrics), 2)
    assert len(samples.points) > 10
    assert (samples.points >= 0).all()
    blocks = STEP_PX * np.ceil(np.array(image.shape[::-1]) / STEP_PX)  # the last ones may stick out
    assert (samples.points < blocks).all()
    assert_unit_metrics(samples.metrics)


@every_source
def test_flat_images_have_no_texture_and_no_samples(source: ShapeSource) -> None:
    image = IMAGES["flat"]
    grid = source.grid(image)
    assert not grid.textured.any()
    assert_allclose(grid.metrics, np.broadcast_to([1.0, 1.0, 0.0], grid.metrics.shape))
    assert len(source.samples(image).points) == 0


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
class TestDepthFiles(DepthContract):
    @pytest.fixture(autouse=True)
    def _maps(self, tmp_path: Path, kind: str) -> None:
        """One map of half the size of the image, with a hole."""
        height, width = IMAGES["textured"].shape
        depth = np.random.default_rng(3).uniform(0.5, 4.0, (height // 2, width // 2))
        depth[3:9, 5:20] = 0.0
        (tmp_path / "folder").mkdir()
        np.save(tmp_path / "folder" / "name.npy", depth)
        self.folder, self.kind = tmp_path, kind

    def make(self) -> DepthSource:
        return DepthFiles(DepthFilesOptions(path=str(self.folder), kind=self.kind))
