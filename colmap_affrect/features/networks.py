"""Networks with their weights, ready for inference, and the patches that they take.

kornia builds them without weights. A file must have all parameters of its network and no others.
"""

import re
from collections import OrderedDict
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from kornia import feature
from torch import Tensor, nn
from torch.nn.functional import affine_grid, grid_sample
from torch.nn.utils.fusion import fuse_conv_bn_eval

from colmap_affrect.errors import Option, OptionError
from colmap_affrect.features.base import PATCH_SIZE_PX
from colmap_affrect.features.weights import load_state_dict, unusable
from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Floats, Singles
from colmap_affrect.geometry.conventions import HALF_PIXEL
from colmap_affrect.images.warping import half_size

Network = TypeVar("Network", bound=nn.Module)
State = dict[str, Any]
UNUSED_PREFIX = "SIFT."  # of parameters in the file of HardTFeat that no layer has
# Patches that are sampled at once, which stay in the cache of a CPU; resource
PATCHES_AT_ONCE = 512
# Added to deviations of patches, as in kornia's AffNet and OriNet
DEVIATION_FLOOR = 1e-6
MAX_PROBLEM_LENGTH = 80  # characters of torch's message that are shown; display


def resolve_device(name: str) -> torch.device:
    """Return the device of ``auto`` (CUDA if there is any), ``cpu``, ``cuda:1``, ``mps``.

    OptionError for another name, or when the device is not there.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d+)?|mps", name):
        raise OptionError(
            "not one of auto, cpu, cuda, cuda:0, mps", where=Option("device", name)
        )
    try:
        torch.empty(0, device=name)
    except (AssertionError, RuntimeError) as error:
        why = str(error).splitlines()[0]
        raise OptionError(
            why,
            where=Option("device", name),
            advice=("use ", Option("device"), " cpu or auto"),
        ) from error
    return torch.device(name)


def load_affnet(path: Path, device: str) -> nn.Sequential:
    """Build AffNet (Mishkin, Radenovic, Matas 2018) without its final pooling.

    Standardized patches (B, 1, 32, 32) give (B, 3, 1, 1); an image of H x W px gives (ceil(H / 4) -
    7) x (ceil(W / 4) - 7) cells, where cell (i, j) has the patch whose first pixel is (4 j, 4 i).
    """
    network = _with_state(
        feature.LAFAffNetShapeEstimator(pretrained=False), path, "AffNet"
    )
    return _ready(folded(network.features[:-1]), device)


class OnPatches(nn.Sequential):
    """Layers that map (B, 1, 32, 32) patches, which are standardized first, to (B, D) outputs."""

    def forward(self, patches: Tensor) -> Tensor:
        """Return (B, D) outputs, not of unit length."""
        outputs: Tensor = super().forward(standardized(patches))  # type: ignore[no-untyped-call]
        return outputs.flatten(1)


def load_orinet(path: Path, device: str) -> feature.OriNet:
    """Build OriNet: (B, 1, 32, 32) patches to (B,) angles in radians.

    In kornia an orientation a rotates a LAF by [[cos a, sin a], [-sin a, cos a]], which is R(-a).
    """
    network = _with_state(feature.OriNet(pretrained=False), path, "OriNet")
    network.features = folded(network.features)
    return _ready(network, device)


def load_descriptor(name: str, path: Path, device: str) -> nn.Module:
    """Build a network from (B, 1, 32, 32) patches in [0, 1] to (B, 128) rows of any length.

    Args:
        name: ``hardnet`` or ``hardtfeat``.
        path: its file of weights.
        device: as :func:`resolve_device` takes it.

    Returns:
        The network.

    Raises:
        AffrectError: the file has other weights.
    """
    if name == "hardtfeat":
        return _ready(_with_state(hardtfeat(), path, name), device)
    network = _with_state(feature.HardNet(pretrained=False), path, name)
    network.features = folded(network.features)
    return _ready(network, device)


def load_extractor(
    key: str, score_threshold: float, path: Path, device: str
) -> nn.Module:
    """Build ALIKED.

    Args:
        key: of the file, which names the model.
        score_threshold: maxima of the score map above it are keypoints.
        path: file of weights.
        device: as :func:`resolve_device` takes it.

    Returns:
        The network.

    Raises:
        AffrectError: the file has other weights.
    """
    aliked = feature.ALIKED(key, detection_threshold=score_threshold)
    computed = {"dkd.hw_grid": aliked.dkd.hw_grid}  # is in no file
    return _ready(
        _with_state(network=aliked, path=path, name=key, computed=computed), device
    )


def hardtfeat() -> OnPatches:
    """Build the layers of TFeat (Balntas et al. 2016): two convolutions, one fully connected.

    The published network has tanh before the maximum. Here it comes after it, which gives the same
    for a quarter of the work.
    """
    features = nn.Sequential(
        nn.Conv2d(1, 32, 7), nn.MaxPool2d(2), nn.Tanh(), nn.Conv2d(32, 64, 6), nn.Tanh()
    )
    classifier = nn.Sequential(nn.Dropout(0.1), nn.Conv2d(64, 128, 8), nn.Tanh())
    return OnPatches(OrderedDict(features=features, classifier=classifier))


def standardized(patches: Tensor) -> Tensor:
    """Subtract the mean of each of (B, 1, H, W) patches and divide by its deviation, if any."""
    deviations, means = torch.std_mean(patches, dim=(1, 2, 3), keepdim=True)
    return (patches - means) / (deviations + DEVIATION_FLOOR)


def folded(layers: nn.Module) -> nn.Sequential:
    """Fold batch normalizations into convolutions, for inference; twice as fast on a CPU."""
    kept: list[nn.Module] = []
    for layer in layers.eval().children():
        if isinstance(layer, nn.BatchNorm2d):
            convolution = cast(nn.Conv2d, kept.pop())
            kept.append(fuse_conv_bn_eval(convolution, layer))
        elif isinstance(layer, nn.ReLU):
            kept.append(nn.ReLU(inplace=True))
        elif not isinstance(layer, nn.Dropout):
            kept.append(layer)
    return nn.Sequential(*kept)


def _with_state(
    network: Network, path: Path, name: str, computed: State | None = None
) -> Network:
    """Give a network the parameters of a file.

    Args:
        network: without weights.
        path: file of weights.
        name: of the network, for errors.
        computed: parameters that are in no file.

    Returns:
        The network.

    Raises:
        AffrectError: the file lacks parameters of the network, or has others.
    """
    state = load_state_dict(path) | (computed or {})
    for key in list(state):
        if key.startswith(UNUSED_PREFIX):
            del state[key]
    try:
        network.load_state_dict(state)
    except RuntimeError as error:
        _, problem, *_ = [*str(error).splitlines(), ""]
        shown = problem.strip()[:MAX_PROBLEM_LENGTH]
        raise unusable(path, f"not the weights of {name} ({shown})") from error
    return network


def _ready(network: Network, device: str) -> Network:
    """Switch to inference and move to the device; on CPUs channels last is the faster layout."""
    target = resolve_device(device)
    network = network.eval().requires_grad_(False)
    if target.type == "cpu":
        network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network.to(target)


class PatchSampler:
    """Samples the patches of LAFs from an (H, W) image and its half_size versions.

    They are those of ``kornia.feature.extract_patches_from_pyramid``, up to rounding, in a quarter
    of the time: the pyramid is built once, and few patches are sampled at a time.
    """

    def __init__(self, image: Singles, device: torch.device) -> None:
        levels = [image]
        while min(levels[-1].shape) >= 2 * PATCH_SIZE_PX:
            levels.append(half_size(levels[-1]))
        self.levels = [
            torch.from_numpy(level)[None, None].to(device) for level in levels
        ]

    def sample(self, lafs: Floats) -> Tensor:
        """Return the (N, 1, 32, 32) patches of (N, 2, 3) LAFs in px.

        Pixel (i, j) of a patch is the image at c + A u, u = ((2 j + 1) / 32 - 1, (2 i + 1) / 32 -
        1). It is sampled bilinearly in the pyramid level whose pixels are as large as those of the
        patch or up to half as large. Beyond the border the outermost pixels count. LAFs that are
        not finite give undefined patches.
        """
        image = self.levels[0]
        if image.device.type == "mps":  # which has no sampling beyond the border
            given = torch.from_numpy(lafs.astype(np.float32)).to(image.device)
            return feature.extract_patches_from_pyramid(
                image, given[None], PATCH_SIZE_PX
            )[0]
        finite = np.where(np.isfinite(lafs), lafs, 0.0)
        level_numbers = self._level_numbers(finite[:, :, :2])
        unit_per_px = 2.0 / np.array(image.shape[:1:-1])
        finite[:, :, 2] = (finite[:, :, 2] + HALF_PIXEL) * unit_per_px - 1.0
        finite[:, :, :2] *= unit_per_px[:, None]
        normalized = torch.from_numpy(finite.astype(np.float32)).to(image.device)
        patches = image.new_empty((len(lafs), 1, PATCH_SIZE_PX, PATCH_SIZE_PX))
        for number, level in enumerate(self.levels):
            rows = np.flatnonzero(level_numbers == number)
            for begin in range(0, len(rows), PATCHES_AT_ONCE):
                part = torch.from_numpy(rows[begin : begin + PATCHES_AT_ONCE]).to(
                    image.device
                )
                patches[part] = _sampled(level, normalized[part])
        return patches

    def _level_numbers(self, shapes: Floats) -> Floats:
        """Return the (N,) pyramid levels of the patches of (N, 2, 2) shapes."""
        radii_px = np.sqrt(np.abs(determinants(shapes)))
        patch_pixel_sizes = 2.0 * radii_px / PATCH_SIZE_PX
        numbers = np.floor(np.log2(np.maximum(patch_pixel_sizes, 1.0)))
        return np.asarray(numbers.clip(max=len(self.levels) - 1))


def _sampled(level: Tensor, lafs: Tensor) -> Tensor:
    """Sample (N, 2, 3) LAFs in coordinates of -1...1 from border to border."""
    size = [len(lafs), 1, PATCH_SIZE_PX, PATCH_SIZE_PX]
    positions = affine_grid(lafs, size, align_corners=False).view(
        1, -1, PATCH_SIZE_PX, 2
    )
    sampled = grid_sample(level, positions, padding_mode="border", align_corners=False)
    return sampled.view(size)
