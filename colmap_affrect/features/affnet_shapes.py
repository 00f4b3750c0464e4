"""Shape source ``affnet``: affine shapes from a network, on all blocks or on patches of keypoints.

AffNet (Mishkin, Radenovic, Matas 2018) reads the shape of a feature off a 32 x 32 patch. Without
the final pooling, fully convolutional, it gives one every 4 px: the paper's DenseAffNet (Sec. 3).

The three outputs o of the network make a frame L; shapes are the unit metrics of L^-1.
"""

from __future__ import annotations

from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from colmap_affrect.data import GrayImage, Mask, ShapeGrid, ShapeSamples
from colmap_affrect.features.base import PATCH_SIZE_PX, FeatureOptions, NetworkContext, ShapeOptions
from colmap_affrect.features.sift import DogOptions, detect_dog
from colmap_affrect.geometry import conventions, tilts
from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Array, Floats, Singles
from colmap_affrect.geometry.tilts import STEP_PX
from colmap_affrect.images.reading import shrink_to
from colmap_affrect.options import within

if TYPE_CHECKING:
    import torch

ORIGIN_PX = conventions.grid_origin(STEP_PX)  # centre of the first block
LEAD_PX = (PATCH_SIZE_PX - STEP_PX) // 2
"""Cell (0, 0) of the network has the patch of the rows and columns 0...31. With 14 px more in
front, that patch has the block of rows and columns 0...3 in its middle."""
PAPER_CROP_PX = (-LEAD_PX) % STEP_PX  # puts the patches of all cells round whole blocks
PAPER_LEAD_CELLS = (LEAD_PX + PAPER_CROP_PX) // STEP_PX  # blocks before the first with a patch
CELLS_SEEN_BEFORE, CELLS_SEEN_AFTER = 3, 9  # cell i depends on rows 4 i - 11...4 i + 39
STRIP_CELLS = 64  # rows of cells that are computed at once, to bound the memory
WINDOW_PX = 33  # surroundings whose mean and deviation normalise a pixel
DEVIATION_FLOOR = 0.01 * 255  # added to deviations, gray values: blank surroundings stay blank
MAX_NORMALISED = 6.0  # as in the AffNet authors' own fully convolutional network
PATCH_SIGMAS = 12.0  # half width of a keypoint's patch in its sigmas (kornia-moons, the paper)
BATCH_SIZE = 256  # patches that go through the network at once


class AffNetOptions(ShapeOptions):
    """Shape source ``affnet``."""

    name: Literal["affnet"] = "affnet"
    scales: Annotated[
        tuple[Annotated[float, within(0.05, 1.0)], ...], Field(strict=False, min_length=1)
    ] = (1.0, 0.5, 0.25)
    """Sizes of the image at which dense shapes are estimated; their log-Euclidean mean counts."""
    paper: bool = False
    """Normalise by mean and deviation of the whole image and use the full size only, as the
    authors did; otherwise by those of the surrounding 33 x 33 px."""
    min_deviation: Annotated[float, within(0.0, 255.0)] = 3.0
    """Standard deviation of the surroundings, in gray values, under which a block counts as flat;
    not with ``paper``."""
    max_num_keypoints: Annotated[int, within(1, 1_000_000)] = 4000
    """Sparse shapes are those of the strongest keypoints."""

    @property
    def weights(self) -> tuple[str, ...]:
        """Keys of the files of weights that the network reads."""
        return ("affnet",)


class AffNet:
    """Shapes of all 4 x 4 blocks of an image, or of its DoG keypoints."""

    Options = AffNetOptions

    def __init__(
        self,
        options: AffNetOptions,
        network: NetworkContext,
        features: FeatureOptions | None = None,
    ) -> None:
        """Load the network; keypoints are found as ``features`` of the recipe if those are DoG."""
        from colmap_affrect.features.networks import load_affnet, resolve_device

        self.options = options
        dog = features if isinstance(features, DogOptions) else DogOptions()
        self.detect = partial(detect_dog, options=dog)
        self.device = resolve_device(network.device)
        self.layers = load_affnet(network.weights["affnet"], network.device)

    def grid(self, image: GrayImage) -> ShapeGrid:
        """Estimate one affine shape per 4 x 4 block of a (H, W) uint8 image.

        By default the border is reflected; blocks without texture (``min_deviation``) get the
        identity. With ``paper`` the network sees the image without padding (at least 32 px), blocks
        near the border get the nearest shape, and all are textured.
        """
        if self.options.paper:
            logs = self._paper_logs(image)
            textured = np.ones(logs.shape[:2], dtype=bool)
        else:
            logs, textured = self._mean_logs(image), _textured(image, self.options.min_deviation)
            logs[~textured] = 0.0
        return ShapeGrid(tilts.metrics_from_log(logs), textured, ORIGIN_PX, STEP_PX)

    def samples(self, image: GrayImage) -> ShapeSamples:
        """Estimate the shapes of the strongest keypoints of a (H, W) uint8 image, where finite."""
        lafs = self.detect(image).lafs[: self.options.max_num_keypoints]  # by falling response
        shapes = _frames(self._patch_outputs(image, lafs))
        valid = np.isfinite(shapes).all(axis=(1, 2)) & (determinants(shapes) > 0)
        return ShapeSamples(lafs[valid, :, 2], tilts.rectifying_metrics(shapes[valid]))

    def _mean_logs(self, image: GrayImage) -> Singles:
        """Return (R, C, 2) logarithms of metrics, the mean over all sizes of the image."""
        size = image.shape[::-1]
        resized = [shrink_to(image, round(max(size) * scale)) for scale in self.options.scales]
        largest = max(min(level.shape) for level in resized)
        levels = [level for level in resized if min(level.shape) >= min(PATCH_SIZE_PX, largest)]
        mean = np.zeros((ceil(size[1] / STEP_PX), ceil(size[0] / STEP_PX), 2), dtype=np.float32)
        for level in levels:
            around, deviation = _mean_and_deviation(level)
            normalised = (level - around) / (deviation + DEVIATION_FLOOR)
            clipped = np.clip(normalised, -MAX_NORMALISED, MAX_NORMALISED).astype(np.float32)
            logs = self._dense_logs(_with_reflected_border(clipped))
            matrix = conventions.resized_from_original((size[0], size[1]), level.shape[::-1])
            mean += _read_grid(logs, matrix, mean.shape[:2]) / len(levels)
        return mean

    def _paper_logs(self, image: GrayImage) -> Singles:
        """Return (R, C, 2) logarithms of metrics as in the paper, border cells replicated."""
        values = image.astype(np.float32)
        normalised = (values - values.mean()) / (values.std() + 1e-6)
        logs = self._dense_logs(normalised[PAPER_CROP_PX:, PAPER_CROP_PX:])
        below, right = (
            ceil(length / STEP_PX) - PAPER_LEAD_CELLS - count
            for length, count in zip(image.shape, logs.shape[:2], strict=True)
        )
        widths = ((PAPER_LEAD_CELLS, below), (PAPER_LEAD_CELLS, right), (0, 0))
        return np.pad(logs, widths, mode="edge")

    def _dense_logs(self, normalised: Singles) -> Singles:
        """Return (R, C, 2) logarithms of the metrics that the network sees in a float image."""
        import torch

        image = torch.from_numpy(normalised)[None, None]
        num_rows = ceil(len(normalised) / STEP_PX) - PATCH_SIZE_PX // STEP_PX + 1
        strips = []
        for first in range(0, num_rows, STRIP_CELLS):
            last = min(first + STRIP_CELLS, num_rows)
            begin = max(first - CELLS_SEEN_BEFORE, 0)
            strip = image[:, :, STEP_PX * begin : STEP_PX * (last + CELLS_SEEN_AFTER)]
            with torch.inference_mode():
                outputs = self.layers(strip.to(self.device))[0, :, first - begin : last - begin]
            metrics = tilts.rectifying_metrics(_frames(outputs.permute(1, 2, 0)))
            strips.append(tilts.log_metrics(metrics))
        return np.concatenate(strips)

    def _patch_outputs(self, image: GrayImage, lafs: Array) -> torch.Tensor:
        """Return the (N, 3) outputs of the network on the patches of (N, 2, 3) frames."""
        import torch

        from colmap_affrect.features.networks import PatchSampler, standardized

        wide = lafs.copy()
        wide[:, :, :2] *= PATCH_SIGMAS / conventions.MEASUREMENT_SIGMAS
        patches = PatchSampler(image.astype(np.float32), self.device).sample(wide)
        with torch.inference_mode():
            batches = (batch for batch in torch.split(patches, BATCH_SIZE) if len(batch))
            outputs = [self.layers(standardized(batch))[:, :, 0, 0] for batch in batches]
            return torch.cat([patches.new_empty((0, 3)), *outputs])


def _frames(outputs: torch.Tensor) -> Array:
    """Return (..., 2, 2) frames L of (..., 3) outputs."""
    return tilts.shapes_from_affnet(outputs.cpu().numpy().astype(np.float64))


def _mean_and_deviation(image: GrayImage) -> tuple[Array, Array]:
    """Return (H, W) mean and standard deviation of the window round each pixel."""
    window, border = (WINDOW_PX, WINDOW_PX), cv2.BORDER_REFLECT_101
    mean = np.asarray(cv2.boxFilter(image, cv2.CV_64F, window, borderType=border), np.float64)
    mean_square = cv2.sqrBoxFilter(image, cv2.CV_64F, window, borderType=border)
    return mean, np.sqrt(np.maximum(mean_square - mean**2, 0.0))


def _with_reflected_border(values: Floats) -> Floats:
    """Add a border so that the cells of the network are the 4 x 4 blocks of the image."""
    bottom, right = (LEAD_PX + -length % STEP_PX for length in values.shape)
    return np.asarray(
        cv2.copyMakeBorder(values, LEAD_PX, bottom, LEAD_PX, right, cv2.BORDER_REFLECT_101)
    )


def _textured(image: GrayImage, min_deviation: float) -> Mask:
    """Tell in which blocks gray values deviate by more than ``min_deviation`` round the middle."""
    deviation = _with_reflected_border(_mean_and_deviation(image)[1])
    middle = LEAD_PX + STEP_PX // 2
    return np.asarray(deviation[middle:-LEAD_PX:STEP_PX, middle:-LEAD_PX:STEP_PX] > min_deviation)


def _read_grid(values: Singles, level_from_image: Array, cells: tuple[int, int]) -> Singles:
    """Interpolate (r, c, D) values at the blocks of a resized image at (R, C) cells of the image.

    The map (3, 3) is of pixel-centre px; beyond the outermost centres their values count.
    """
    weights = []
    for axis, (count, length) in enumerate(zip(cells, values.shape[:2], strict=True)):
        scale, shift = level_from_image[1 - axis, [1 - axis, 2]]
        centers = ORIGIN_PX + STEP_PX * np.arange(count)
        indices = (scale * centers + shift - ORIGIN_PX) / STEP_PX
        distances = np.clip(indices, 0, length - 1)[:, None] - np.arange(length)
        weights.append(np.maximum(1.0 - np.abs(distances), 0.0).astype(np.float32))
    by_row, by_column = weights
    return np.stack([by_row @ channel @ by_column.T for channel in np.moveaxis(values, -1, 0)], -1)
