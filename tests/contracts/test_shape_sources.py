"""Every source of affine shapes that is registered keeps the contract; networks are random."""

from __future__ import annotations

from math import ceil
from pathlib import Path

import numpy as np
import pytest
from contracts.rectifier_contract import IMAGES
from numpy.testing import assert_allclose
from random_weights import write_random_weights

from colmap_affrect.features.base import SHAPES, NetworkContext, ShapeSource
from colmap_affrect.geometry.shapes import STEP_PX

UNIT_ERROR = 1e-4


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_random_weights(tmp_path_factory.mktemp("weights"))


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
