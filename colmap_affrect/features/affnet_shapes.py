"""Shape source ``affnet``: affine shapes from a network, on all blocks or on patches of keypoints.

AffNet (Mishkin, Radenovic, Matas 2018) reads the shape of a feature from a 32 x 32 patch. Without
the final pooling it is fully convolutional and gives a shape every 4 px: the paper's DenseAffNet
(Sec. 3).

The three outputs of the network make the shape L of a LAF; affine shapes are the unit metrics of
L^-1.
"""

from __future__ import annotations

from functools import partial
from math import ceil
from typing import TYPE_CHECKING, Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from colmap_affrect.data import GrayImage, Mask, ShapeGrid, ShapeSamples
from colmap_affrect.features.base import (
    PATCH_SIZE_PX,
    FeatureOptions,
    NetworkContext,
    ShapeOptions,
)
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
front, that patch has the block of rows and columns 0...3 in its middle; theory."""
PAPER_CROP_PX = (-LEAD_PX) % STEP_PX  # puts the patches of all cells round whole blocks
# Blocks before the first with a patch
PAPER_LEAD_CELLS = (LEAD_PX + PAPER_CROP_PX) // STEP_PX
# Cell i depends on rows 4 i - 11...4 i + 39; theory
CELLS_SEEN_BEFORE, CELLS_SEEN_AFTER = 3, 9
# Rows of cells that are computed at once, to bound the memory; resource
STRIP_CELLS = 64
# Surroundings whose mean and deviation normalize a pixel: about a patch; theory
WINDOW_PX = 33
DEVIATION_FLOOR = 0.01 * 255
"""Gray values added to deviations, so that surroundings without texture stay so; judged."""
# Added to the deviation of the whole image (the value of the paper's authors)
PAPER_DEVIATION_FLOOR = 1e-6
MAX_NORMALIZED = 6.0
"""Largest normalized value, as in the fully convolutional network of AffNet's authors; paper."""
# Half width of a keypoint's patch in its sigmas (kornia-moons, the paper)
PATCH_SIGMAS = 12.0
BATCH_SIZE = 256  # patches that go through the network at once; resource


class AffNetOptions(ShapeOptions):
    """Shape source ``affnet``."""

    name: Literal["affnet"] = "affnet"
    scales: Annotated[
        tuple[Annotated[float, within(0.05, 1.0)], ...],
        Field(strict=False, min_length=1),
    ] = (1.0, 0.5, 0.25)  # judged
    """Sizes of the image at which dense shapes are estimated; their log-Euclidean mean counts."""
    paper: bool = False
    """Normalise by mean and deviation of the whole image and use the full size only, as the
    authors did; otherwise by those of the surrounding 33 x 33 px."""
    min_deviation: Annotated[float, within(0.0, 255.0)] = 3.0
    """Standard deviation of the surroundings, in gray values, under which a block counts as flat;
    not with ``paper``."""
    max_num_keypoints: Annotated[int, within(1, 1_000_000)] = 4000  # resource
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
            logs = self._mean_logs(image)
            textured = _textured_blocks(image, self.options.min_deviation)
            logs[~textured] = 0.0
        return ShapeGrid(
            metrics=tilts.metrics_from_log(logs),
            textured=textured,
            origin_px=ORIGIN_PX,
            step_px=STEP_PX,
        )

    def samples(self, image: GrayImage) -> ShapeSamples:
        """Estimate the shapes of the strongest keypoints of a (H, W) uint8 image, where finite."""
        # By falling response
        lafs = self.detect(image).lafs[: self.options.max_num_keypoints]
        shapes = _shapes(self._patch_outputs(image, lafs))
        is_finite = np.isfinite(shapes).all(axis=(1, 2))
        is_valid = is_finite & (determinants(shapes) > 0)
        metrics = tilts.rectifying_metrics(shapes[is_valid])
        return ShapeSamples(lafs[is_valid, :, 2], metrics)

    def _mean_logs(self, image: GrayImage) -> Singles:
        """Return (R, C, 2) logarithms of metrics, the mean over all sizes of the image."""
        height, width = image.shape
        mean = np.zeros(
            (ceil(height / STEP_PX), ceil(width / STEP_PX), 2), dtype=np.float32
        )
        levels = self._levels(image)
        for level in levels:
            local_mean, deviation = _mean_and_deviation(level)
            normalized = (level - local_mean) / (deviation + DEVIATION_FLOOR)
            clipped = np.clip(normalized, -MAX_NORMALIZED, MAX_NORMALIZED)
            logs = self._dense_logs(_with_reflected_border(clipped.astype(np.float32)))
            level_size = (level.shape[1], level.shape[0])
            level_from_image = conventions.resized_from_original(
                (width, height), level_size
            )
            mean += _interpolated(logs, level_from_image, mean.shape[:2]) / len(levels)
        return mean

    def _levels(self, image: GrayImage) -> list[GrayImage]:
        """Return the sizes of the image that have a whole patch, or else the largest."""
        resized = []
        for scale in self.options.scales:
            size_px = round(max(image.shape) * scale)
            resized.append(shrink_to(image, size_px))
        largest_px = max(min(level.shape) for level in resized)
        min_px = min(PATCH_SIZE_PX, largest_px)
        return [level for level in resized if min(level.shape) >= min_px]

    def _paper_logs(self, image: GrayImage) -> Singles:
        """Return (R, C, 2) logarithms of metrics as in the paper, border cells replicated."""
        values = image.astype(np.float32)
        normalized = (values - values.mean()) / (values.std() + PAPER_DEVIATION_FLOOR)
        logs = self._dense_logs(normalized[PAPER_CROP_PX:, PAPER_CROP_PX:])
        num_rows = ceil(image.shape[0] / STEP_PX)
        num_columns = ceil(image.shape[1] / STEP_PX)
        num_below = num_rows - PAPER_LEAD_CELLS - logs.shape[0]
        num_right = num_columns - PAPER_LEAD_CELLS - logs.shape[1]
        widths = ((PAPER_LEAD_CELLS, num_below), (PAPER_LEAD_CELLS, num_right), (0, 0))
        return np.pad(logs, widths, mode="edge")

    def _dense_logs(self, normalized: Singles) -> Singles:
        """Return (R, C, 2) logarithms of the metrics that the network sees in a float image."""
        import torch

        image = torch.from_numpy(normalized)[None, None]
        num_rows = ceil(len(normalized) / STEP_PX) - PATCH_SIZE_PX // STEP_PX + 1
        strips = []
        for first in range(0, num_rows, STRIP_CELLS):
            last = min(first + STRIP_CELLS, num_rows)
            begin = max(first - CELLS_SEEN_BEFORE, 0)
            strip = image[:, :, STEP_PX * begin : STEP_PX * (last + CELLS_SEEN_AFTER)]
            with torch.inference_mode():
                (outputs,) = self.layers(strip.to(self.device))
            outputs = outputs[:, first - begin : last - begin]
            metrics = tilts.rectifying_metrics(_shapes(outputs.permute(1, 2, 0)))
            strips.append(tilts.log_metrics(metrics))
        return np.concatenate(strips)

    def _patch_outputs(self, image: GrayImage, lafs: Array) -> torch.Tensor:
        """Return the (N, 3) outputs of the network on the patches of (N, 2, 3) LAFs."""
        import torch

        from colmap_affrect.features.networks import PatchSampler, standardized

        wide = lafs.copy()
        wide[:, :, :2] *= PATCH_SIGMAS / conventions.MEASUREMENT_SIGMAS
        patches = PatchSampler(image.astype(np.float32), self.device).sample(wide)
        outputs = [patches.new_empty((0, 3))]
        with torch.inference_mode():
            for batch in torch.split(patches, BATCH_SIZE):
                if len(batch):
                    outputs.append(self.layers(standardized(batch))[:, :, 0, 0])
            return torch.cat(outputs)


def _shapes(outputs: torch.Tensor) -> Array:
    """Return (..., 2, 2) shapes L of (..., 3) outputs of the network."""
    return tilts.shapes_from_affnet(outputs.cpu().numpy().astype(np.float64))


def _mean_and_deviation(image: GrayImage) -> tuple[Array, Array]:
    """Return (H, W) mean and standard deviation of the window around each pixel."""
    window = (WINDOW_PX, WINDOW_PX)
    border = cv2.BORDER_REFLECT_101
    mean = np.asarray(
        cv2.boxFilter(image, cv2.CV_64F, window, borderType=border), np.float64
    )
    mean_square = cv2.sqrBoxFilter(image, cv2.CV_64F, window, borderType=border)
    variance = np.maximum(mean_square - mean**2, 0.0)
    return mean, np.sqrt(variance)


def _with_reflected_border(values: Floats) -> Floats:
    """Add a border so that the cells of the network are the 4 x 4 blocks of the image."""
    height, width = values.shape
    bottom = LEAD_PX + -height % STEP_PX
    right = LEAD_PX + -width % STEP_PX
    bordered = cv2.copyMakeBorder(
        values, LEAD_PX, bottom, LEAD_PX, right, cv2.BORDER_REFLECT_101
    )
    return np.asarray(bordered)


def _textured_blocks(image: GrayImage, min_deviation: float) -> Mask:
    """Tell in which blocks gray values deviate by more than ``min_deviation``."""
    _, deviation = _mean_and_deviation(image)
    bordered = _with_reflected_border(deviation)
    middle = LEAD_PX + STEP_PX // 2
    middle_deviation = bordered[middle:-LEAD_PX:STEP_PX, middle:-LEAD_PX:STEP_PX]
    return np.asarray(middle_deviation > min_deviation)


def _interpolated(
    values: Singles, level_from_image: Array, cells: tuple[int, int]
) -> Singles:
    """Interpolate values at the blocks of a resized image at the blocks of the image.

    Beyond the outermost blocks their values count.

    Args:
        values: (r, c, D) at the blocks of the resized image.
        level_from_image: (3, 3) map of pixel-centre px, which only scales and shifts.
        cells: numbers R and C of rows and columns of blocks of the image.

    Returns:
        (R, C, D) float32.
    """
    num_rows, num_columns, num_channels = values.shape
    scale_x, shift_x = level_from_image[0, [0, 2]]
    scale_y, shift_y = level_from_image[1, [1, 2]]
    row_weights = _linear_weights(
        scale=scale_y, shift=shift_y, num_cells=cells[0], num_values=num_rows
    )
    column_weights = _linear_weights(
        scale=scale_x, shift=shift_x, num_cells=cells[1], num_values=num_columns
    )
    channels = []
    for number in range(num_channels):
        channels.append(row_weights @ values[:, :, number] @ column_weights.T)
    return np.stack(channels, -1)


def _linear_weights(
    scale: float, shift: float, num_cells: int, num_values: int
) -> Singles:
    """Return (num_cells, num_values) weights of linear interpolation along one axis.

    Scale and shift map px of the image to px of the resized one.
    """
    centers = ORIGIN_PX + STEP_PX * np.arange(num_cells)
    positions = (scale * centers + shift - ORIGIN_PX) / STEP_PX
    inside = np.clip(positions, 0, num_values - 1)
    distances = inside[:, None] - np.arange(num_values)
    return np.maximum(1.0 - np.abs(distances), 0.0).astype(np.float32)
