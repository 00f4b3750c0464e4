"""Features ``affnet-hardnet``: DoG, AffNet, OriNet and a learned descriptor.

The chain of the paper (Sec. 3): an upright patch round each keypoint gives its affine shape (of the
same area), the patch of that shape its orientation, the patch of both its descriptor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from colmap_affrect.data import GrayImage, LocalFeatures, View, union
from colmap_affrect.features.base import NetworkContext
from colmap_affrect.features.sift import DogOptions, detect_dog
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.geometry.arrays import Array, Singles
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.geometry.tilts import frames_from_affnet

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

MAX_TILT = 20.0  # more is degenerate; AffNet's shapes on photographs stay under 6 (Graffiti).
PATCH_SIGMAS = 12.0  # half width of a patch in units of the feature's sigma, as in the paper
BATCH_SIZE = 256  # patches that go through a network at once
BATCH_MULTIPLE = 64
"""Batches are padded to multiples of this many patches: other sizes change the last bits of the
results on a CPU, so that an image alone would differ from one among others."""


class AffNetHardNetOptions(DogOptions):
    """Features ``affnet-hardnet``: DoG, AffNet, OriNet and a learned descriptor."""

    name: Literal["affnet-hardnet"] = "affnet-hardnet"
    descriptor: Literal["hardnet", "hardtfeat"] = "hardnet"
    """Network that describes patches."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights that the networks read."""
        return ("affnet", "orinet", self.descriptor)


class AffNetHardNet:
    """Learned features; the networks are loaded here, from files found beforehand."""

    Options = AffNetHardNetOptions
    descriptor_size = 128

    def __init__(self, options: AffNetHardNetOptions, network: NetworkContext) -> None:
        """Load the networks; AffrectError as :mod:`.networks` raises them."""
        from colmap_affrect.features import networks

        weights, device = network.weights, network.device
        self.options, self.device = options, networks.resolve_device(device)
        self.affnet = networks.OnPatches(networks.load_affnet(weights["affnet"], device))
        self.orinet = networks.load_orinet(weights["orinet"], device)
        name = options.descriptor
        self.descriptor = networks.load_descriptor(name, weights[name], device)

    def detect(self, view: View) -> LocalFeatures:
        """Detect keypoints, by falling response: upright circles of 6 sigma, descriptors (N, 0)."""
        image, mask = view
        return detect_dog(image, self.options, mask)

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        """Estimate shape, orientation and descriptor of features, a list element for each image.

        Of the frames given, in px, centre and scale count. Features whose shape is degenerate or
        whose descriptor is not finite are left out; the others keep their order.
        """
        counts = [len(features) for features in detected]
        if not sum(counts):
            return [LocalFeatures.empty(self.descriptor_size) for _ in detected]
        import torch

        found = union(list(detected))
        with torch.inference_mode():
            shapes, descriptors = self._describe(_sampler(images, counts, self.device), found)
        lengths = np.linalg.norm(descriptors, axis=1)
        # The squared Frobenius norm of a shape of tilt t is t + 1 / t.
        is_sound = (shapes**2).sum(axis=(1, 2)) <= MAX_TILT + 1.0 / MAX_TILT
        valid = is_sound & np.isfinite(lengths) & (lengths > 0.0)
        found, shapes = found.select(valid), shapes[valid]
        frames = _frames(shapes, found.scales, found.keypoints)
        unit_rows = descriptors[valid] / lengths[valid, None]
        described = replace(found, lafs=frames, descriptors=unit_rows)
        numbers = np.repeat(np.arange(len(detected)), counts)[valid]  # of the images
        return [described.select(numbers == number) for number in range(len(detected))]

    def _describe(
        self, sample: Callable[[Array], Tensor], found: LocalFeatures
    ) -> tuple[Array, Singles]:
        """Return (N, 2, 2) shapes of determinant 1 or NaN, (N, 128) descriptors of any length."""
        half_widths_px = PATCH_SIGMAS / MEASUREMENT_SIGMAS * found.scales
        shapes = np.tile(np.eye(2), (len(found), 1, 1))
        upright = sample(_frames(shapes, half_widths_px, found.keypoints))
        shapes = frames_from_affnet(self._run(self.affnet, upright))
        areas = shapes[:, 0, 0] * shapes[:, 1, 1]
        shapes /= np.sqrt(np.where(areas > 0.0, areas, np.nan))[:, None, None]
        unturned = sample(_frames(shapes, half_widths_px, found.keypoints))
        # kornia's angles are of the opposite sense to those of our rotation().
        shapes = shapes @ rotation(-self._run(self.orinet, unturned).astype(np.float64))
        turned = sample(_frames(shapes, half_widths_px, found.keypoints))
        return shapes, self._run(self.descriptor, turned)

    def _run(self, network: nn.Module, patches: Tensor) -> Singles:
        import torch
        from torch.nn.functional import pad

        outputs = []
        for batch in torch.split(patches, BATCH_SIZE):
            filled = pad(batch, (0, 0, 0, 0, 0, 0, 0, -len(batch) % BATCH_MULTIPLE))
            outputs.append(network(filled)[: len(batch)].float())
        return np.asarray(torch.cat(outputs).cpu().numpy())


def _sampler(
    images: Sequence[GrayImage], counts: Sequence[int], device: torch.device
) -> Callable[[Array], Tensor]:
    """Return what samples (N, 1, 32, 32) patches of (N, 2, 3) frames, so many of each image."""
    import torch

    from colmap_affrect.features.networks import PatchSampler

    grays = (image.astype(np.float32) / np.float32(255) for image in images)
    samplers = [PatchSampler(gray, device) for gray in grays]

    def sample(lafs: Array) -> Tensor:
        parts = np.split(lafs, np.cumsum(counts)[:-1])
        return torch.cat([s.sample(part) for s, part in zip(samplers, parts, strict=True)])

    return sample


def _frames(shapes: Array, radii_px: Array, centers: Array) -> Array:
    """Return (N, 2, 3) frames of shapes of determinant 1, geometric mean radii and centres."""
    return np.concatenate([radii_px[:, None, None] * shapes, centers[:, :, None]], axis=2)
