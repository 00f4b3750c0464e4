"""Networks are built without downloads, from files that have exactly their parameters."""

from __future__ import annotations

import socket
from pathlib import Path

import numpy as np
import pytest
import torch
from kornia import feature
from kornia.feature import extract_patches_from_pyramid
from numpy.testing import assert_allclose
from random_weights import randomized
from synthetic import texture
from torch.nn import functional

from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.features import networks
from colmap_affrect.features.networks import (
    OnPatches,
    PatchSampler,
    hardtfeat,
    load_affnet,
    load_descriptor,
    load_orinet,
    resolve_device,
)
from colmap_affrect.geometry.affine import rotation

ROUNDING = 1e-5
"""Sums of up to 4096 float32 products of order one, added in another order."""


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args, **_kwargs):
        raise AssertionError("a network was opened")

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr(socket, "create_connection", refuse)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file ``<key>.pth`` for each network, of seeded random numbers; not to be changed."""
    tmp_path = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    networks = {
        "hardnet": feature.HardNet(pretrained=False),
        "hardtfeat": hardtfeat(),
        "affnet": feature.LAFAffNetShapeEstimator(pretrained=False),
        "orinet": feature.OriNet(pretrained=False),
    }
    for seed, (name, network) in enumerate(networks.items()):
        state = randomized(network, seed).state_dict()
        if name == "hardtfeat":
            state["SIFT.gx.0.weight"] = torch.zeros(1, 1, 1, 3)
        torch.save({"epoch": 7, "state_dict": state}, tmp_path / f"{name}.pth")
    return tmp_path


@pytest.fixture
def patches() -> torch.Tensor:
    """Patches in [0, 1], each of another contrast."""
    generator = torch.Generator().manual_seed(5)
    smooth = functional.avg_pool2d(
        torch.rand(7, 1, 36, 36, generator=generator), 5, stride=1
    )
    return smooth * torch.linspace(0.1, 1.0, 7)[:, None, None, None]


# Devices.


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_resolve_device_that_is_not_there_says_what_to_use_instead() -> None:
    assert resolve_device("auto") == torch.device("cpu")
    for name in ("cuda", "cuda:1", "mps"):
        with pytest.raises(
            AffrectError, match=rf"^--device {name}: .*use --device cpu or auto$"
        ):
            resolve_device(name)


@pytest.mark.parametrize(
    "name", ["gpu", "cuda:", "cuda:x", "CPU", "", "cpu:1", "cuda:-1"]
)
def test_resolve_device_of_an_unknown_name_lists_the_known_ones(name: str) -> None:
    with pytest.raises(OptionError, match="not one of auto, cpu, cuda, cuda:0, mps"):
        resolve_device(name)


# Files.


def test_load_hardnet_computes_what_kornia_does(
    folder: Path, patches: torch.Tensor
) -> None:
    reference = feature.HardNet(pretrained=False).eval()
    path = folder / "hardnet.pth"
    reference.load_state_dict(torch.load(path, weights_only=True)["state_dict"])
    with torch.inference_mode():
        rows = load_descriptor("hardnet", path, "cpu")(patches)
        torch.testing.assert_close(rows, reference(patches), rtol=0, atol=ROUNDING)


def test_loaders_refuse_the_file_of_another_network(folder: Path) -> None:
    with pytest.raises(
        AffrectError, match=r"orinet\.pth: not the weights of AffNet \("
    ):
        load_affnet(folder / "orinet.pth", "cpu")
    with pytest.raises(AffrectError, match=r"affnet\.pth: not the weights of OriNet"):
        load_orinet(folder / "affnet.pth", "cpu")
    with pytest.raises(
        AffrectError, match=r"hardtfeat\.pth: not the weights of hardnet \("
    ):
        load_descriptor("hardnet", folder / "hardtfeat.pth", "cpu")


@pytest.mark.parametrize(("change", "message"), [
    ({"features.0.weight": None}, r"Missing key.* \"features\.0\.weight\""),
    ({"surplus": torch.zeros(2)}, r"Unexpected key.* \"surplus\""),
    ({"features.0.weight": torch.zeros(16, 1, 3, 4)}, r"size mismatch for features\.0\.weight"),
])  # fmt: skip
def test_load_affnet_refuses_a_file_that_differs_in_one_place(
    folder: Path, tmp_path: Path, change: dict[str, object], message: str
) -> None:
    path = tmp_path / "changed.pth"
    state = torch.load(folder / "affnet.pth", weights_only=True)["state_dict"] | change
    torch.save({key: value for key, value in state.items() if value is not None}, path)
    with pytest.raises(AffrectError, match=message):
        load_affnet(path, "cpu")


# Architectures.


def test_affnet_and_orinet_compute_what_kornia_does(
    folder: Path, patches: torch.Tensor
) -> None:
    affnet = feature.LAFAffNetShapeEstimator(pretrained=False).eval()
    orinet = feature.OriNet(pretrained=False).eval()
    for name, network in (("affnet", affnet), ("orinet", orinet)):
        path = folder / f"{name}.pth"
        network.load_state_dict(torch.load(path, weights_only=True)["state_dict"])
    deviations, means = torch.std_mean(patches, dim=(1, 2, 3), keepdim=True)
    with torch.inference_mode():
        outputs = affnet.features((patches - means) / (deviations + 1e-6)).flatten(1)
        found = OnPatches(load_affnet(folder / "affnet.pth", "cpu"))(patches)
        torch.testing.assert_close(found, outputs, rtol=0, atol=ROUNDING)
        angles = load_orinet(folder / "orinet.pth", "cpu")(patches)
        torch.testing.assert_close(angles, orinet(patches), rtol=0, atol=ROUNDING)
    assert outputs.std() > 1e-3
    assert angles.std() > 1e-3


def test_hardtfeat_is_the_published_chain(folder: Path, patches: torch.Tensor) -> None:
    state = torch.load(folder / "hardtfeat.pth", weights_only=True)["state_dict"]
    deviations = patches.std((1, 2, 3), keepdim=True)
    values = (patches - patches.mean((1, 2, 3), keepdim=True)) / (deviations + 1e-7)
    # Here tanh comes before the maximum, as its authors wrote it.
    values = functional.conv2d(
        values, state["features.0.weight"], state["features.0.bias"]
    )
    values = functional.max_pool2d(torch.tanh(values), 2)
    values = functional.conv2d(
        values, state["features.3.weight"], state["features.3.bias"]
    )
    values = torch.tanh(values).flatten(1)
    weight = state["classifier.1.weight"].flatten(1)
    expected = torch.tanh(values @ weight.T + state["classifier.1.bias"])
    network = load_descriptor("hardtfeat", folder / "hardtfeat.pth", "cpu")
    torch.testing.assert_close(network(patches), expected, rtol=0, atol=10 * ROUNDING)


def some_frames(count: int, size: tuple[int, int], largest_px: float) -> np.ndarray:
    """Turned and sheared frames of all sizes, some of them reaching beyond the image."""
    random = np.random.default_rng(2)
    shapes = np.tile(np.eye(2), (count, 1, 1))
    shapes[:, 1, 0] = random.uniform(-0.8, 0.8, count)
    shapes[:, 0, 0] = random.uniform(0.5, 2.0, count)
    radii = np.exp(random.uniform(np.log(3.0), np.log(largest_px), count))
    centers = (
        random.uniform(-5, 5, (count, 2)) + random.uniform(0, 1, (count, 2)) * size
    )
    matrices = (
        radii[:, None, None] * shapes @ rotation(random.uniform(-np.pi, np.pi, count))
    )
    return np.concatenate([matrices, centers[:, :, None]], axis=2)


CPU = torch.device("cpu")


def unit_texture(size: tuple[int, int]) -> np.ndarray:
    return texture(size, seed=1).astype(np.float32) / 255


@pytest.mark.parametrize("size", [(301, 257), (640, 130), (64, 63), (40, 20)])
@pytest.mark.parametrize("patches_at_once", [7, 128])
def test_patches_are_those_of_kornia(
    size: tuple[int, int], patches_at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(networks, "PATCHES_AT_ONCE", patches_at_once)
    image = unit_texture(size)
    frames = some_frames(150, size, largest_px=max(size))
    found = PatchSampler(image, CPU).sample(frames)
    expected = extract_patches_from_pyramid(
        torch.from_numpy(image)[None, None],
        torch.from_numpy(frames.astype(np.float32))[None],
        32,
    )[0]
    assert found.dtype == torch.float32
    assert_allclose(found, expected, atol=1e-4)


def test_columns_of_a_patch_follow_the_first_axis_of_the_frame() -> None:
    x, y = np.meshgrid(np.arange(90.0), np.arange(70.0))
    frame = np.array([[[3.0, 8.0, 41.0], [0.5, 5.0, 33.0]]])
    u, v = np.meshgrid(*2 * [(2 * np.arange(32) + 1) / 32 - 1])
    for image, row in ((x, frame[0, 0]), (y, frame[0, 1])):
        sampler = PatchSampler(image.astype(np.float32), CPU)
        assert len(sampler.levels) == 2
        expected = row[0] * u + row[1] * v + row[2]
        assert_allclose(sampler.sample(frame)[0, 0], expected, atol=1e-4)


def test_no_frames_give_no_patches_and_bad_ones_harm_no_others() -> None:
    sampler = PatchSampler(unit_texture((90, 70)), CPU)
    assert sampler.sample(np.zeros((0, 2, 3))).shape == (0, 1, 32, 32)
    frames = some_frames(4, (90, 70), 20.0)
    expected = sampler.sample(frames)
    frames[1, 0, 0] = np.nan
    frames[2, 1, 2] = np.inf
    found = sampler.sample(frames)
    assert torch.equal(found[[0, 3]], expected[[0, 3]])
