"""Features ``aliked``: a network that detects and describes in one pass.

LAFs are upright circles of ``RADIUS_PX`` in the view; those of a warp are ellipses in the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np

from colmap_affrect.data import ColorImage, GrayImage, LocalFeatures, View, in_mask
from colmap_affrect.features.base import (
    FeatureExtractor,
    FeatureOptions,
    NetworkContext,
)
from colmap_affrect.features.sift import is_searchable
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.arrays import Singles
from colmap_affrect.options import within

if TYPE_CHECKING:
    from torch import Tensor

RADIUS_PX = 12.0
"""Radius of all LAFs, of a sigma of 2 px: measured on photographs, the network finds a point again
within so much, so that the same point of several warps is recognized as one."""


class AlikedOptions(FeatureOptions):
    """Features ``aliked`` (Zhao et al. 2023)."""

    name: Literal["aliked"] = "aliked"
    in_color: ClassVar[bool] = True
    bytes_per_px: ClassVar[int] = 1600  # measured
    has_shapes: ClassVar[bool] = False
    max_num_features: Annotated[int, within(1, 1_000_000)] = 2048  # paper
    """Most features of one view, by response, as its authors match them."""
    model: Literal["n16", "n16rot"] = "n16"
    """``n16rot`` was trained with rotated images."""
    score_threshold: Annotated[float, within(0.001, 1.0)] = 0.2  # paper
    """Least score; where nothing has it, all maxima above the mean score of the view stay."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Key of the file of weights."""
        return (f"aliked-{self.model}",)


class Aliked(FeatureExtractor):
    """ALIKED: maxima of a score map with subpixel positions, descriptors of deformable patches.

    The positions of ``n16`` have no bias; those of ``n16rot`` are up to 1 px too low, depending on
    the content of the image.
    """

    Options = AlikedOptions
    descriptor_size = 128

    def __init__(self, options: AlikedOptions, context: NetworkContext) -> None:
        """Load the network; AffrectError as :mod:`.networks` raises them."""
        from colmap_affrect.features.networks import load_extractor, resolve_device

        self.options = options
        self.device = resolve_device(context.device)
        (key,) = options.weights
        path = context.weights[key]
        self.network: Any = load_extractor(
            key, options.score_threshold, path, context.device
        )

    def detect(self, view: View) -> LocalFeatures:
        """Detect and describe, by falling response.

        The mask selects features after detection, so that its edge makes none.
        """
        image, mask = view
        if not is_searchable(image, mask):
            return LocalFeatures.empty(self.descriptor_size)
        import torch

        is_allowed = np.ones(image.shape[:2], dtype=bool) if mask is None else mask > 0
        with torch.inference_mode():
            pixels = _pixels(image).to(self.device)
            feature_map, score_map = self.network.extract_dense_map(pixels)
            # Positions in [-1, 1]
            (normalized,), (scores,), _ = self.network.dkd(score_map)
            last_pixel = normalized.new_tensor([image.shape[1] - 1, image.shape[0] - 1])
            points = (normalized + 1) / 2 * last_pixel
            kept = np.flatnonzero(in_mask(is_allowed, _array(points)))
            order = np.argsort(-_array(scores)[kept], kind="stable")
            strongest = kept[order[: self.options.max_num_features]]
            rows = torch.from_numpy(strongest).to(self.device)
            described = self.network.desc_head(feature_map, [normalized[rows]])
            descriptors = _array(described[0][0])
            keypoints = _array(points[rows])
            responses = _array(scores[rows])
        radii_px = np.full(len(keypoints), RADIUS_PX)
        lafs = lafs_from_keypoints(keypoints, radii_px, np.zeros(len(keypoints)))
        return LocalFeatures(lafs=lafs, responses=responses, descriptors=descriptors)


def _pixels(image: GrayImage | ColorImage) -> Tensor:
    """Return an (H, W) or (H, W, 3) image as (1, 3, H, W) float32 in [0, 1]."""
    import torch

    color = np.broadcast_to(np.atleast_3d(image), (*image.shape[:2], 3))
    channels = np.ascontiguousarray(color.transpose(2, 0, 1), dtype=np.float32)
    return torch.from_numpy(channels)[None] / 255


def _array(values: Tensor) -> Singles:
    return np.asarray(values.float().cpu().numpy())
