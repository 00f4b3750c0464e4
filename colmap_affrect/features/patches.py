"""Patches of local affine frames, sampled from an image pyramid.

The same patches as ``kornia.feature.extract_patches_from_pyramid`` gives, to rounding, in a quarter
of the time on a CPU: the pyramid is built once for all samplings of an image, positions become
sampling coordinates in one product, and they are computed in pieces that stay in the cache.
"""

import numpy as np
import torch
from kornia.feature import extract_patches_from_pyramid
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from colmap_affrect.conventions import HALF_PIXEL
from colmap_affrect.features.base import PATCH_SIZE_PX
from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Array, Floats, Indices, Singles
from colmap_affrect.images.warping import halved

PATCHES_AT_ONCE = 512


class PatchSampler:
    """An image and its halved versions, down to the size of a patch."""

    def __init__(self, image: Singles, device: torch.device) -> None:
        """Build the pyramid of an (H, W) image, for sampling on a device."""
        levels = [image]
        while min(levels[-1].shape) >= 2 * PATCH_SIZE_PX:
            levels.append(halved(levels[-1]))
        self.levels = [torch.from_numpy(level)[None, None].to(device) for level in levels]

    def sample(self, lafs: Floats) -> Tensor:
        """Return (N, 1, 32, 32) patches of (N, 2, 3) frames in px.

        Pixel (i, j) of a patch is the image at c + A u, u = ((2 j + 1) / 32 - 1, (2 i + 1) / 32 -
        1), bilinear, of the pyramid level whose pixels are as large as those of the patch or up to
        half as large. Beyond the border the outermost pixels count. What frames that are not finite
        give is undefined.
        """
        image = self.levels[0]
        if image.device.type == "mps":  # which has no sampling beyond the border
            given = torch.from_numpy(lafs.astype(np.float32)).to(image.device)
            return extract_patches_from_pyramid(image, given[None], PATCH_SIZE_PX)[0]
        frames = np.where(np.isfinite(lafs), lafs, 0.0)
        numbers = self._level_numbers(frames[:, :, :2])
        pixel = 2.0 / np.array(image.shape[:1:-1])
        frames[:, :, 2] = (frames[:, :, 2] + HALF_PIXEL) * pixel - 1.0
        frames[:, :, :2] *= pixel[:, None]
        normalized = torch.from_numpy(frames.astype(np.float32)).to(image.device)
        patches = image.new_empty((len(lafs), 1, PATCH_SIZE_PX, PATCH_SIZE_PX))
        for number, level in enumerate(self.levels):
            rows = np.flatnonzero(numbers == number)
            for begin in range(0, len(rows), PATCHES_AT_ONCE):
                part = torch.from_numpy(rows[begin : begin + PATCHES_AT_ONCE]).to(image.device)
                patches[part] = _sampled(level, normalized[part])
        return patches

    def _level_numbers(self, matrices: Array) -> Indices:
        """Return the (N,) levels to sample frames of (N, 2, 2) matrices from."""
        steps_px = 2.0 * np.sqrt(np.abs(determinants(matrices))) / PATCH_SIZE_PX
        numbers = np.floor(np.log2(np.maximum(steps_px, 1.0))).astype(np.int64)
        return np.asarray(np.minimum(numbers, len(self.levels) - 1))


def _sampled(level: Tensor, frames: Tensor) -> Tensor:
    """Sample (N, 2, 3) frames in coordinates of -1...1 from border to border."""
    size = [len(frames), 1, PATCH_SIZE_PX, PATCH_SIZE_PX]
    positions = affine_grid(frames, size, align_corners=False).view(1, -1, PATCH_SIZE_PX, 2)
    values = grid_sample(level, positions, padding_mode="border", align_corners=False)
    return values.view(size)
