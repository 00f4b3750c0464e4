"""Dense AffNet is the patch network on the window round every block; direction, borders, scales."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
from kornia.feature import LAFAffNetShapeEstimator
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_allclose, assert_array_equal
from strategies import Array
from synthetic import circles, texture
from torch import nn

from colmap_affrect.data import GrayImage, LocalFeatures
from colmap_affrect.features import affnet_shapes as affnet
from colmap_affrect.features.affnet_shapes import AffNet, AffNetOptions
from colmap_affrect.features.base import NetworkContext
from colmap_affrect.geometry.tilts import (
    log_metrics,
    metrics_from_log,
    tilts_from_metrics,
    unit_metrics,
)
from colmap_affrect.images.reading import shrink_to

SINGLE = 2e-4
"""Metrics of tilts up to about 20 through a network in single precision, with the folded batch
normalisation and other orders of summation."""

ODD_SIZE = (117, 83)
"""(width, height): both leave another remainder when divided by 4."""


def no_keypoints(image: GrayImage) -> LocalFeatures:
    """Detector for tests of dense shapes."""
    raise AssertionError(
        f"dense shapes need no keypoints of an image of {image.shape=}"
    )


def random_network(seed: int = 0) -> LAFAffNetShapeEstimator:
    """AffNet with random weights and statistics, and shapes of moderate tilts."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = LAFAffNetShapeEstimator(pretrained=False, preserve_orientation=False)
        for layer in network.features:
            if isinstance(layer, nn.BatchNorm2d):
                layer.running_mean.normal_(0.0, 0.1)
                layer.running_var.uniform_(0.05, 0.2)
    return calibrated(network.eval())


def calibrated(network: LAFAffNetShapeEstimator) -> LAFAffNetShapeEstimator:
    """Scale the last convolution so that outputs on texture deviate by about 0.4."""
    windows = sliding_window_view(texture((160, 160), seed=1), (32, 32))[::16, ::16]
    patches = torch.from_numpy(
        standardised(windows.reshape(-1, 1, 32, 32)).astype(np.float32)
    )
    with torch.inference_mode():
        deviation = network.features[:-2](patches).std()
    network.features[-3].weight.data *= 0.4 / deviation
    return network


def centered_network(seed: int = 0) -> LAFAffNetShapeEstimator:
    """A network that sees nothing beyond its patch: only the last kernel has an extent.

    The others keep their middle, so that zeros round a patch and pixels round a window of an
    image make no difference.
    """
    network = random_network(seed)
    for layer in network.features:
        if isinstance(layer, nn.Conv2d) and layer.padding == (1, 1):
            middle = layer.weight.data[:, :, 1:2, 1:2].clone()
            layer.weight.data.zero_()
            layer.weight.data[:, :, 1:2, 1:2] = middle
    return calibrated(network)


def source(
    network: LAFAffNetShapeEstimator,
    detect: Callable[[GrayImage], LocalFeatures] = no_keypoints,
    **options: object,
) -> AffNet:
    """The shape source with these weights, through a file, and another detector."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "AffNet.pth"
        torch.save(network.state_dict(), path)
        made = AffNet(AffNetOptions(**options), NetworkContext({"affnet": path}))
    made.detect = detect
    return made


def metrics_of_outputs(outputs: torch.Tensor) -> Array:
    """Unit metrics of L^-1 with L = [[1 + o0, 0], [o1, 1 + o2]] for (..., 3) outputs."""
    o0, o1, o2 = np.moveaxis(outputs.detach().numpy().astype(float), -1, 0)
    frames = np.stack([np.stack([1 + o0, 0 * o0], -1), np.stack([o1, 1 + o2], -1)], -2)
    return unit_metrics(np.linalg.inv(frames))


def patch_metrics(network: LAFAffNetShapeEstimator, patches: Array) -> Array:
    """Metrics by kornia's layers of (..., 32, 32) patches as they are."""
    inputs = torch.from_numpy(patches.reshape(-1, 1, 32, 32).astype(np.float32))
    with torch.inference_mode():
        outputs = torch.cat(
            [network.features(batch)[:, :, 0, 0] for batch in inputs.split(512)]
        )
    return metrics_of_outputs(outputs).reshape(*patches.shape[:-2], 3)


def standardised(patches: Array) -> Array:
    """(..., 32, 32) patches of mean 0 and deviation 1, as AffNet was trained on."""
    patches = patches.astype(float)
    mean = patches.mean(axis=(-1, -2), keepdims=True)
    return (patches - mean) / (patches.std(axis=(-1, -2), ddof=1, keepdims=True) + 1e-6)


def locally_normalised(image: GrayImage) -> Array:
    """Pixels by mean and deviation of the 33 x 33 px around them, border reflected."""
    windows = sliding_window_view(
        np.pad(image.astype(float), 16, mode="reflect"), (33, 33)
    )
    mean = windows.mean(axis=(2, 3))
    deviation = windows.std(axis=(2, 3))
    return np.clip((image - mean) / (deviation + 2.55), -6.0, 6.0)


def reflected(values: Array) -> Array:
    """Add 14 px, and at the end what is missing to whole blocks."""
    height, width = values.shape
    return np.pad(
        values, ((14, 14 + -height % 4), (14, 14 + -width % 4)), mode="reflect"
    )


@pytest.fixture(scope="module")
def image() -> GrayImage:
    """An image whose brightness and contrast vary, of odd size."""
    width, height = ODD_SIZE
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    values = texture(ODD_SIZE, seed=3).astype(float)
    return (
        np.rint((values - 128) * (0.3 + 0.6 * x) + 90 + 60 * y)
        .clip(0, 255)
        .astype(np.uint8)
    )


@pytest.mark.parametrize("size", [ODD_SIZE, (34, 33)])
def test_grid_is_the_network_on_the_window_in_the_middle_of_which_a_block_lies(
    image: GrayImage, size: tuple[int, int]
) -> None:
    image = image[: size[1], : size[0]]
    network = centered_network()
    grid = source(network, scales=(1.0,), min_deviation=0.0).grid(image)
    windows = sliding_window_view(reflected(locally_normalised(image)), (32, 32))[
        ::4, ::4
    ]
    expected = patch_metrics(network, windows)
    rows = ceil(size[1] / 4)
    columns = ceil(size[0] / 4)
    assert expected.shape == (rows, columns, 3)
    assert grid.textured.shape == (rows, columns)
    # Window (0, 0) holds the rows -14...17: its middle is that of the block 0...3.
    assert (grid.origin_px, grid.step_px) == (1.5, 4)
    assert np.median(tilts_from_metrics(expected)[0]) > 1.1
    assert_allclose(grid.metrics, expected, atol=SINGLE, rtol=SINGLE)


@pytest.mark.parametrize("size", [ODD_SIZE, (32, 33)])
def test_paper_grid_has_global_normalisation_and_replicated_borders(
    image: GrayImage, size: tuple[int, int]
) -> None:
    image = image[: size[1], : size[0]]
    network = centered_network()
    grid = source(network, paper=True).grid(image)
    normalised = (image - image.mean()) / image.std()
    windows = sliding_window_view(normalised, (32, 32))[2::4, 2::4]
    expected = patch_metrics(network, windows)
    # Window (0, 0) from pixel 2 has its middle in that of block 4, which begins at pixel 16.
    rows, columns = expected.shape[:2]
    inside = grid.metrics[4 : 4 + rows, 4 : 4 + columns]
    assert_allclose(inside, expected, atol=SINGLE, rtol=SINGLE)
    assert grid.textured.shape == (ceil(size[1] / 4), ceil(size[0] / 4))
    assert grid.textured.all()
    assert (grid.origin_px, grid.step_px) == (1.5, 4)
    assert_array_equal(
        grid.metrics[:4], np.broadcast_to(grid.metrics[4], grid.metrics[:4].shape)
    )
    last = grid.metrics[:, -4:]
    assert_array_equal(last[:, 1:], np.broadcast_to(last[:, :1], last[:, 1:].shape))


def test_strips_equal_the_whole(
    image: GrayImage, monkeypatch: pytest.MonkeyPatch
) -> None:
    affnet_source = source(random_network(), scales=(1.0,), min_deviation=0.0)
    whole = affnet_source.grid(image)
    monkeypatch.setattr(affnet, "STRIP_CELLS", 5)
    assert_allclose(
        affnet_source.grid(image).metrics, whole.metrics, atol=SINGLE, rtol=SINGLE
    )


def test_shapes_of_a_smaller_size_are_interpolated_between_the_centers_of_its_blocks(
    image: GrayImage,
) -> None:
    network = random_network()
    full = source(network, scales=(0.5,), min_deviation=0.0).grid(image)
    small = shrink_to(image, 58)
    assert small.shape == (41, 58)
    logs = log_metrics(
        source(network, scales=(1.0,), min_deviation=0.0).grid(small).metrics
    )
    for axis, (length, small_length) in enumerate(
        zip(image.shape, small.shape, strict=True)
    ):
        cells = np.arange(ceil(length / 4))
        small_cells = np.arange(ceil(small_length / 4))
        # Distances from the edge of the image scale: the middle of cell k is at 4 k + 2.
        at = (4 * cells + 2) * small_length / length
        logs = np.apply_along_axis(
            lambda values, at=at, known=4 * small_cells + 2: np.interp(
                at, known, values
            ),
            axis,
            logs,
        )
    assert_allclose(full.metrics, metrics_from_log(logs), atol=SINGLE, rtol=SINGLE)


def test_textured_blocks_are_those_whose_surroundings_deviate() -> None:
    image = np.full((161, 318), 128, np.uint8)
    image[:, :160] = texture((160, 161), seed=5)
    grid = source(random_network()).grid(image)
    # The surroundings of a block reach 16 px from its middle.
    assert grid.textured[:, :40].all()
    assert not grid.textured[:, 44:].any()
    assert np.isfinite(grid.metrics).all()


WINDOW_SIGMA = 16.0 / 12.0
"""Sigma of a keypoint whose patch of half width 12 sigma has the pixels of the image."""


def test_samples_are_the_network_on_patches_of_12_sigma(image: GrayImage) -> None:
    corners = [(3, 11), (40, 50), (71, 8), (85, 51), (0, 0)]
    keypoints = circles([(x + 15.5, y + 15.5) for x, y in corners], [WINDOW_SIGMA] * 5)
    network = random_network()
    samples = source(network, lambda _: keypoints).samples(image)
    patches = np.stack([image[y : y + 32, x : x + 32] for x, y in corners])
    expected = patch_metrics(network, standardised(patches))
    assert tilts_from_metrics(expected)[0].max() > 1.1
    assert_array_equal(samples.points, keypoints.keypoints)
    # The patches are sampled at pixels, up to rounding.
    assert_allclose(samples.metrics, expected, atol=1e-3, rtol=1e-3)


def test_default_shapes_are_those_of_the_whole_image_its_half_and_its_quarter() -> None:
    image = texture((120, 160), seed=4)
    network = random_network()
    default = source(network).grid(image).metrics
    expected = source(network, scales=(1.0, 0.5, 0.25)).grid(image).metrics
    assert_array_equal(default, expected)
    whole = source(network, scales=(1.0,)).grid(image).metrics
    assert not np.allclose(default, whole, atol=0.01)
