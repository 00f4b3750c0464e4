"""Features ``affnet-hardnet``: DoG, AffNet, OriNet and a learned descriptor.

The chain of the paper (Sec. 3): AffNet reads the affine shape of a keypoint, of the same area, from
the upright patch around it. OriNet reads its orientation from the patch of that shape. The
descriptor is of the patch of that shape and orientation.
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
from colmap_affrect.geometry.tilts import shapes_from_affnet

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

MAX_TILT = 20.0
"""Largest tilt of a shape; more is degenerate. AffNet's shapes on photographs stay below 6
(measured on Graffiti)."""
PATCH_SIGMAS = 12.0  # half width of a patch in units of the feature's sigma (the paper)
BATCH_SIZE = 256  # patches that go through a network at once; resource
BATCH_MULTIPLE = 64
"""Batches are padded to multiples of this many patches: other sizes change the last bits of the
results on a CPU, so that an image alone would differ from one among others; numeric."""


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
    """Learned features; the networks are loaded from files that were found beforehand."""

    Options = AffNetHardNetOptions
    descriptor_size = 128

    def __init__(self, options: AffNetHardNetOptions, network: NetworkContext) -> None:
        """Load the networks; AffrectError as :mod:`.networks` raises them."""
        from colmap_affrect.features import networks

        weights = network.weights
        device = network.device
        self.options = options
        self.device = networks.resolve_device(device)
        self.affnet = networks.OnPatches(
            networks.load_affnet(weights["affnet"], device)
        )
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
        """Estimate shape, orientation and descriptor of features.

        Only centre and scale of the given LAFs count. Features whose shape is degenerate or whose
        descriptor is not finite are left out; the others keep their order.

        Args:
            images: (H, W) uint8 images.
            detected: features of each image, LAFs in its px.

        Returns:
            Described features of each image.
        """
        counts = [len(features) for features in detected]
        if not sum(counts):
            return [LocalFeatures.empty(self.descriptor_size) for _ in detected]
        import torch

        features = union(list(detected))
        with torch.inference_mode():
            sampler = _sampler(images, counts, self.device)
            shapes, descriptors = self._shapes_and_descriptors(sampler, features)
        # The squared Frobenius norm of a shape of determinant 1 and tilt t is t + 1 / t.
        square_norms = (shapes**2).sum(axis=(1, 2))
        is_sound = square_norms <= MAX_TILT + 1.0 / MAX_TILT
        lengths = np.linalg.norm(descriptors, axis=1)
        is_valid = is_sound & np.isfinite(lengths) & (lengths > 0.0)
        features = features.select(is_valid)
        lafs = _lafs(shapes[is_valid], features.scales, features.keypoints)
        unit_rows = descriptors[is_valid] / lengths[is_valid, None]
        described = replace(features, lafs=lafs, descriptors=unit_rows)
        image_numbers = np.repeat(np.arange(len(detected)), counts)[is_valid]
        return [
            described.select(image_numbers == number) for number in range(len(detected))
        ]

    def _shapes_and_descriptors(
        self, sample: Callable[[Array], Tensor], features: LocalFeatures
    ) -> tuple[Array, Singles]:
        """Return (N, 2, 2) shapes of determinant 1 or NaN, (N, 128) descriptors of any length."""
        half_widths_px = PATCH_SIGMAS / MEASUREMENT_SIGMAS * features.scales
        centers = features.keypoints
        circles = np.tile(np.eye(2), (len(features), 1, 1))
        upright_patches = sample(_lafs(circles, half_widths_px, centers))
        shapes = shapes_from_affnet(self._run(self.affnet, upright_patches))
        areas = shapes[:, 0, 0] * shapes[:, 1, 1]
        valid_areas = np.where(areas > 0.0, areas, np.nan)
        shapes /= np.sqrt(valid_areas)[:, None, None]
        shape_patches = sample(_lafs(shapes, half_widths_px, centers))
        angles = self._run(self.orinet, shape_patches).astype(np.float64)
        # kornia's angles are of the opposite sense to those of our rotation().
        shapes = shapes @ rotation(-angles)
        oriented_patches = sample(_lafs(shapes, half_widths_px, centers))
        return shapes, self._run(self.descriptor, oriented_patches)

    def _run(self, network: nn.Module, patches: Tensor) -> Singles:
        """Return the outputs of a network on (N, 1, 32, 32) patches."""
        import torch
        from torch.nn.functional import pad

        outputs = []
        for batch in torch.split(patches, BATCH_SIZE):
            num_missing = -len(batch) % BATCH_MULTIPLE
            padded = pad(batch, (0, 0, 0, 0, 0, 0, 0, num_missing))
            outputs.append(network(padded)[: len(batch)].float())
        return np.asarray(torch.cat(outputs).cpu().numpy())


def _sampler(
    images: Sequence[GrayImage], counts: Sequence[int], device: torch.device
) -> Callable[[Array], Tensor]:
    """Return a function that samples the patches of LAFs of several images.

    Args:
        images: (H, W) uint8 images.
        counts: LAFs of each image.
        device: where patches are sampled.

    Returns:
        Function of (N, 2, 3) LAFs, image by image, to (N, 1, 32, 32) patches.
    """
    import torch

    from colmap_affrect.features.networks import PatchSampler

    samplers = []
    for image in images:
        gray = image.astype(np.float32) / np.float32(255)
        samplers.append(PatchSampler(gray, device))
    starts = np.cumsum(counts)[:-1]

    def sample(lafs: Array) -> Tensor:
        parts = np.split(lafs, starts)
        patches = [
            sampler.sample(part) for sampler, part in zip(samplers, parts, strict=True)
        ]
        return torch.cat(patches)

    return sample


def _lafs(shapes: Array, radii_px: Array, centers: Array) -> Array:
    """Return (N, 2, 3) LAFs of shapes of determinant 1, geometric mean radii and centres."""
    return np.concatenate(
        [radii_px[:, None, None] * shapes, centers[:, :, None]], axis=2
    )
