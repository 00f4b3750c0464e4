"""Feature profile ``affnet-hardnet``: geometry of frames and patches, batches, odd images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from kornia import feature
from numpy.testing import assert_allclose
from random_weights import write_random_weights
from synthetic import circles, texture
from torch import nn

from colmap_affrect.data import GrayImage
from colmap_affrect.features.affnet_hardnet import AffNetHardNet, AffNetHardNetOptions
from colmap_affrect.features.base import NetworkContext
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.geometry.tilts import tilts_from_metrics, unit_metrics

PATCH_SIGMAS = 12.0  # half width of a patch (the paper)
MAX_TILT = 20.0  # of shapes that are kept

CHAIN = 1e-3
"""Three networks in a row, each on patches sampled through what the one before it said; their
layers are folded here and not in kornia, which rounds differently."""

ANGLE_DEG = 4.0
"""The histogram of gradients has bins of 10 degrees and a parabola through three."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Files of seeded random numbers for AffNet, OriNet and HardNet."""
    return write_random_weights(tmp_path_factory.mktemp("weights"))


def make(weights: dict[str, Path], **options: object) -> AffNetHardNet:
    return AffNetHardNet(AffNetHardNetOptions(**options), NetworkContext(weights))


@pytest.fixture(scope="module")
def image() -> GrayImage:
    """A textured image that is not square."""
    return texture((210, 140), seed=7)


# Frames and patches.


def test_describe_computes_what_kornia_does(
    weights: dict[str, Path], image: GrayImage
) -> None:
    detected = circles([[60.2, 50.9], [151.3, 77.0], [90.0, 90.0]], [1.5, 2.2, 4.0])
    profile = make(weights)
    (described,) = profile.describe([image], [detected])

    def reference(network: nn.Module, name: str) -> nn.Module:
        network.load_state_dict(
            torch.load(weights[name], weights_only=True)["state_dict"]
        )
        return network.eval()

    affnet = reference(
        feature.LAFAffNetShapeEstimator(pretrained=False, preserve_orientation=False),
        "affnet",
    )
    orienter = feature.LAFOrienter(
        32, angle_detector=reference(feature.OriNet(pretrained=False), "orinet")
    )
    hardnet = reference(feature.HardNet(pretrained=False), "hardnet")
    pixels = torch.from_numpy(image.astype(np.float32) / 255)[None, None]
    lafs = torch.from_numpy(detected.lafs.astype(np.float32))[None]
    lafs[..., :2] *= PATCH_SIGMAS / MEASUREMENT_SIGMAS
    with torch.inference_mode():
        lafs = orienter(affnet(lafs, pixels), pixels)
        patches = feature.extract_patches_from_pyramid(pixels, lafs, 32)[0]
        descriptors = hardnet(patches).numpy()
    shapes = lafs[0, :, :, :2].numpy() * (MEASUREMENT_SIGMAS / PATCH_SIGMAS)
    assert_allclose(described.lafs[:, :, :2], shapes, atol=CHAIN * shapes.max())
    assert_allclose(described.keypoints, detected.keypoints)
    assert_allclose(described.descriptors, descriptors, atol=CHAIN)
    tilts = tilts_from_metrics(unit_metrics(described.lafs[:, :, :2]))[0]
    assert tilts.min() > 1.02, "random weights still make ellipses"
    upright = np.abs(described.lafs[:, 0, 1]) < 0.01 * described.scales
    assert not upright.any(), "and turn them"


@pytest.mark.parametrize("direction_deg", [0.0, 30.0, 135.0, -80.0])
def test_orientation_points_along_the_gradient_of_a_turned_pattern(
    weights: dict[str, Path], direction_deg: float
) -> None:
    # kornia's gradient histogram has OriNet's convention. The pattern gets brighter in one
    # direction, x towards y; the first column of the frame must point there.
    columns, rows = np.meshgrid(np.arange(121), np.arange(101))
    direction = np.array(
        [np.cos(np.deg2rad(direction_deg)), np.sin(np.deg2rad(direction_deg))]
    )
    distance = (columns - 62.0) * direction[0] + (rows - 48.0) * direction[1]
    edge = (128 + 100 * np.tanh(distance / 8.0)).astype(np.uint8)
    profile = make(weights)
    profile.affnet = lambda patches: torch.zeros(len(patches), 3)
    profile.orinet = feature.PatchDominantGradientOrientation(32)
    (described,) = profile.describe([edge], [circles([[62.0, 48.0]], [2.5])])
    first = described.lafs[0, :, 0] / described.scales[0]
    assert_allclose(first @ direction, 1.0, atol=1.0 - np.cos(np.deg2rad(ANGLE_DEG)))
    # A rotation: the second column is a quarter turn on, x towards y.
    assert_allclose(
        described.lafs[0, :, 1], rotation(np.pi / 2) @ described.lafs[0, :, 0]
    )


@pytest.mark.parametrize(("outputs", "kept"), [
    ([-1.0, 0.2, 0.1], False),
    ([0.1, 0.2, -1.0], False),
    ([np.nan, 0.0, 0.0], False),
    ([1.0, 0.0, 2.0 / (MAX_TILT + 1.0) - 1.0], False),
    ([1.0, 0.0, 2.0 / (MAX_TILT - 1.0) - 1.0], True),
])  # fmt: skip
def test_describe_leaves_out_degenerate_shapes(
    weights: dict[str, Path], image: GrayImage, outputs: list[float], kept: bool
) -> None:
    profile = make(weights)
    good = torch.tensor([0.1, 0.2, -0.3])
    bad = torch.tensor(outputs)

    def every_second_is_bad(patches: torch.Tensor) -> torch.Tensor:
        return torch.stack(
            [bad if number % 2 else good for number in range(len(patches))]
        )

    profile.affnet = every_second_is_bad
    detected = circles([[60.0, 50.0], [70.0, 60.0], [80.0, 70.0]], [2.0, 2.0, 2.0])
    (described,) = profile.describe([image], [detected])
    assert described.rectification_ids.tolist() == ([0, 1, 2] if kept else [0, 2])
    assert_allclose(
        described.keypoints, detected.keypoints[described.rectification_ids]
    )
