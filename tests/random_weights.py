"""Weights of seeded random numbers, in files as the published ones are."""

from __future__ import annotations

from pathlib import Path

import torch
from kornia import feature
from torch import nn


def randomized(network: nn.Module, seed: int, gain: float = 1.0) -> nn.Module:
    """Give batch normalisations random statistics, so that outputs vary with the patch."""
    generator = torch.Generator().manual_seed(seed)
    for name, buffer in network.named_buffers():
        if name.endswith("running_mean"):
            buffer.copy_(0.1 * torch.rand(buffer.shape, generator=generator))
        if name.endswith("running_var"):
            buffer.copy_(
                (0.1 + 0.2 * torch.rand(buffer.shape, generator=generator)) / gain
            )
    return network.eval()


def write_random_weights(folder: Path) -> dict[str, Path]:
    """Write files for AffNet, OriNet, HardNet, whole extractors, by key."""
    torch.manual_seed(0)
    networks = {
        "affnet": randomized(feature.LAFAffNetShapeEstimator(pretrained=False), 1),
        "orinet": randomized(feature.OriNet(pretrained=False), 2, gain=2.0),
        "hardnet": randomized(feature.HardNet(pretrained=False), 3),
        "aliked-n16": randomized(feature.ALIKED(), 4, gain=3.0),
    }
    for name, network in networks.items():
        torch.save({"state_dict": network.state_dict()}, folder / name)
    return {name: folder / name for name in networks}


def write_comparing_lightglue(path: Path, sharpness: float = 40.0) -> Path:
    """Write a LightGlue whose layers change nothing: it compares the descriptors it is given."""
    conf = feature.LightGlue.features["aliked"]
    network = feature.LightGlue(features=None, **{**conf, "weights": None})
    state = {
        name: torch.zeros_like(value) for name, value in network.state_dict().items()
    }
    for name, value in state.items():
        if name.endswith(("input_proj.weight", "final_proj.weight")):
            factor = sharpness if "final" in name else 1.0
            value[: value.shape[1]] = factor * torch.eye(*value.shape)[: value.shape[1]]
        if name.endswith("matchability.bias"):
            value.fill_(9.0)
    torch.save(state, path)
    return path
