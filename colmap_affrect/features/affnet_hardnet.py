"""Features ``affnet-hardnet``: a detector, AffNet, OriNet and a learned descriptor.

The chain of the paper (Sec. 3): an upright patch round each keypoint gives its affine shape (of the
same area), the patch of that shape its orientation, the patch of both its descriptor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from colmap_affrect.data import GrayImage, LocalFeatures, View, in_mask, union
from colmap_affrect.features.base import NetworkContext
from colmap_affrect.features.sift import DogOptions, detect_dog, is_searchable
from colmap_affrect.geometry.affine import determinants, lafs_from_keypoints, rotation
from colmap_affrect.geometry.arrays import Array, Bools, Floats, Singles
from colmap_affrect.geometry.conventions import HALF_PIXEL, MEASUREMENT_SIGMAS
from colmap_affrect.geometry.shapes import frames_from_affnet
from colmap_affrect.options import within

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

MIN_DETECTABLE_PX = 32  # kornia finds nothing within 15 px of a border; Key.Net fails on less
KEYNET_RADIUS_PX = 22.0  # of kornia's frames of Key.Net on the image itself

MAX_TILT = 20.0  # more is degenerate; AffNet's shapes on photographs stay under 6 (Graffiti).
MIN_RESPONSE = 1e-10
"""kornia fills up to the number asked for with frames of response 0 at the origin. Its Hessian
finds rounding errors of 1e-13 in flat images; a blob of one gray level has 1e-6."""
BATCH_MULTIPLE = 64
"""Batches are padded to multiples of this many patches: other sizes change the last bits of the
results on a CPU, so that an image alone would differ from one among others."""


class AffNetHardNetOptions(DogOptions):
    """Features ``affnet-hardnet``: detector, AffNet, OriNet and a learned descriptor."""

    name: Literal["affnet-hardnet"] = "affnet-hardnet"
    detector: Literal["dog", "keynet", "hessian"] = "dog"
    """``dog`` (OpenCV, as in the paper), ``keynet`` or ``hessian``."""
    descriptor: Literal["hardnet", "hardnet8", "hynet", "sosnet", "tfeat", "mkd", "hardtfeat"] = (
        "hardnet"
    )
    affine_shape: bool = True
    """Estimate affine shapes by AffNet; otherwise measurement regions are circles."""
    patch_sigmas: Annotated[float, within(1.0, 100.0)] = 12.0
    """Half width of a patch in units of the feature's sigma (12 as in the paper, for DoG)."""
    batch_size: Annotated[int, within(1, 1_000_000)] = 256
    """Patches that go through a network at once."""
    dtype: Literal["float32", "float16", "bfloat16"] = "float32"
    """Arithmetic of the networks: ``float32``, or ``float16`` and ``bfloat16`` where the device
    is faster with them."""

    @property
    def kind(self) -> str:
        """Detector and descriptor; where shapes are circles descriptors are of the same kind."""
        return f"{self.detector}-affnet-{self.descriptor}"

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights that the networks read."""
        shape = ("affnet",) if self.affine_shape else ()
        detector = ("keynet",) if self.detector == "keynet" else ()
        return (*shape, "orinet", self.descriptor, *detector)


class AffNetHardNet:
    """Learned features; the networks are loaded here, from files found beforehand."""

    Options = AffNetHardNetOptions
    descriptor_size = 128

    def __init__(self, options: AffNetHardNetOptions, network: NetworkContext) -> None:
        """Load the networks; WeightsError and DeviceError as :mod:`.networks` raises them."""
        from colmap_affrect.features import networks

        weights, device = network.weights, network.device
        self.options, self.device = options, networks.resolve_device(device)
        self.affine_shapes = None
        if options.affine_shape:
            affnet = networks.load_affnet(weights["affnet"], device)
            self.affine_shapes = networks.OnPatches(affnet)
        self.orinet = networks.load_orinet(weights["orinet"], device)
        name = options.descriptor
        self.descriptor = networks.load_descriptor(name, weights[name], device)
        self.detector = None  # OpenCV's
        if options.detector != "dog":
            self.detector = networks.load_detector(
                options.detector, options.max_num_features, weights, device
            )

    def detect(self, view: View) -> LocalFeatures:
        """Detect keypoints, by falling response: upright circles of 6 sigma, descriptors (N, 0).

        For ``keynet`` and ``hessian`` kornia's frames count as those of 6 sigma.
        """
        image, mask = view
        if self.detector is None:
            return detect_dog(image, self.options, mask)
        if min(image.shape) < MIN_DETECTABLE_PX or not is_searchable(image, mask):
            return LocalFeatures.empty()
        import torch

        allowed = np.ones(image.shape, dtype=bool) if mask is None else mask > 0
        with torch.inference_mode():
            lafs, strengths = self.detector(
                torch.from_numpy(_unit_range(image)).to(self.device)[None, None],
                torch.from_numpy(allowed).to(self.device)[None, None],
            )
        frames = lafs[0].cpu().numpy().astype(np.float64)
        responses = strengths[0].cpu().numpy()
        seen = responses > MIN_RESPONSE
        frames, responses = frames[seen], responses[seen]
        centers, radii_px = frames[:, :, 2], np.sqrt(determinants(frames[:, :, :2]))
        if self.options.detector == "keynet":
            centers = _centers_from_keynet(centers, radii_px)
        circles = lafs_from_keypoints(centers, radii_px, np.zeros(len(radii_px)))
        found = LocalFeatures(circles, responses, np.zeros((len(responses), 0), np.float32))
        return found.select(in_mask(allowed, centers))

    def describe(
        self, images: Sequence[GrayImage], detected: Sequence[LocalFeatures]
    ) -> list[LocalFeatures]:
        """Estimate shape, orientation and descriptor of features, a list element for each image.

        Patches of all (H, W) uint8 images share batches. Of the frames given, in px of the image,
        centre and scale count. Features whose shape is degenerate or whose descriptor is not finite
        are left out; the others keep their order.
        """
        counts = [len(features) for features in detected]
        if not sum(counts):
            return [LocalFeatures.empty(self.descriptor_size) for _ in detected]
        import torch

        found = union(list(detected))
        with torch.inference_mode():
            shapes, descriptors = self._describe(_sampler(images, counts, self.device), found)
        lengths = np.linalg.norm(descriptors, axis=1)
        valid = _is_sound(shapes) & np.isfinite(lengths) & (lengths > 0.0)
        rows = np.flatnonzero(valid)
        frames = _frames(shapes[rows], found.scales[rows], found.keypoints[rows])
        unit_rows = descriptors[rows] / lengths[rows, None]
        described = LocalFeatures(
            frames, found.responses[rows], unit_rows, found.rectification_ids[rows]
        )
        numbers = np.repeat(np.arange(len(detected)), counts)[rows]  # of the images
        return [described.select(numbers == number) for number in range(len(detected))]

    def _describe(
        self, sample: Callable[[Array], Tensor], found: LocalFeatures
    ) -> tuple[Array, Singles]:
        """Return (N, 2, 2) shapes of determinant 1, and (N, 128) descriptors of any length."""
        half_widths_px = self.options.patch_sigmas / MEASUREMENT_SIGMAS * found.scales
        shapes = np.tile(np.eye(2), (len(found), 1, 1))
        if self.affine_shapes is not None:
            upright = sample(_frames(shapes, half_widths_px, found.keypoints))
            shapes = _shapes_from_outputs(self._run(self.affine_shapes, upright))
        unturned = sample(_frames(shapes, half_widths_px, found.keypoints))
        # kornia's angles are of the opposite sense to those of our rotation().
        shapes = shapes @ rotation(-self._run(self.orinet, unturned).astype(np.float64))
        turned = sample(_frames(shapes, half_widths_px, found.keypoints))
        descriptors = self._run(self.descriptor, turned)
        return shapes, descriptors

    def _run(self, network: nn.Module, patches: Tensor) -> Singles:
        import torch
        from torch.nn.functional import pad

        from colmap_affrect.features.networks import arithmetic

        size = self.options.batch_size
        outputs = []
        with arithmetic(self.options.dtype, self.device):
            for begin in range(0, len(patches), size):
                batch = patches[begin : begin + size]
                filled = pad(batch, (0, 0, 0, 0, 0, 0, 0, -len(batch) % BATCH_MULTIPLE))
                outputs.append(network(filled)[: len(batch)].float())
        return np.asarray(torch.cat(outputs).cpu().numpy())


def _sampler(
    images: Sequence[GrayImage], counts: Sequence[int], device: torch.device
) -> Callable[[Array], Tensor]:
    """Return what samples (N, 1, 32, 32) patches of (N, 2, 3) frames, so many of each image."""
    import torch

    from colmap_affrect.features.networks import PatchSampler

    pairs = [pair for pair in zip(images, counts, strict=True) if pair[1]]
    samplers = [PatchSampler(_unit_range(image), device) for image, _ in pairs]
    ends = np.cumsum([count for _, count in pairs])

    def sample(lafs: Array) -> Tensor:
        parts = np.split(lafs, ends[:-1])
        return torch.cat([s.sample(part) for s, part in zip(samplers, parts, strict=True)])

    return sample


def _shapes_from_outputs(outputs: Floats) -> Array:
    """Return (N, 2, 2) shapes of determinant 1 of (N, 3) outputs of AffNet, lower triangular.

    NaN where the frame has no area.
    """
    shapes = frames_from_affnet(outputs)
    areas = shapes[:, 0, 0] * shapes[:, 1, 1]
    return shapes / np.sqrt(np.where(areas > 0.0, areas, np.nan))[:, None, None]


def _is_sound(shapes: Array) -> Bools:
    """Tell which (N, 2, 2) shapes of determinant 1 are finite and of a tilt up to MAX_TILT."""
    # The squared Frobenius norm of a shape of tilt t is t + 1 / t.
    return np.asarray((shapes**2).sum(axis=(1, 2)) <= MAX_TILT + 1.0 / MAX_TILT)


def _frames(shapes: Array, radii_px: Array, centers: Array) -> Array:
    """Return (N, 2, 3) frames of shapes of determinant 1, geometric mean radii and centres."""
    return np.concatenate([radii_px[:, None, None] * shapes, centers[:, :, None]], axis=2)


def _unit_range(image: GrayImage) -> Singles:
    """Return an (H, W) image as float32 in [0, 1]."""
    return image.astype(np.float32) / np.float32(255)


def _centers_from_keynet(centers: Array, radii_px: Array) -> Array:
    """Correct the centres that kornia's multi-resolution detector reports.

    A pixel of a level f times coarser than the image is reported at f times its coordinates,
    which holds for corner coordinates only: in pixel-centre ones (f - 1) / 2 is missing.
    """
    factors = radii_px / KEYNET_RADIUS_PX
    return centers + HALF_PIXEL * (factors - 1.0)[:, None]
