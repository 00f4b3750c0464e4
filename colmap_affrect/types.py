"""Data that flows between the layers: frozen, checked, numpy only."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import is_inside

GrayImage = NDArray[np.uint8]
"""(H, W) gray values, 0.299 R + 0.587 G + 0.114 B."""

Mask = NDArray[np.bool_]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class ShapeGrid:
    """Affine shapes on a regular grid over an image; what every dense shape source returns.

    Attributes:
        metrics: (R, C, 3) unit metrics (S11, S22, S12) of the *rectifying* maps.
        textured: (R, C) bool, False where the image has no structure to read a shape from.
        origin_px: centre of cell (0, 0) in x and in y, pixel-centre px.
        step_px: distance of neighbouring cells in px.
    """

    metrics: NDArray[np.floating]
    textured: Mask
    origin_px: float
    step_px: int

    def __post_init__(self) -> None:
        _require(
            self.metrics.ndim == 3 and self.metrics.shape == (*self.textured.shape, 3),
            f"{self.metrics.shape=} but expected (R, C, 3) with {self.textured.shape=}",
        )


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image as full local affine frames.

    Attributes:
        lafs: (N, 2, 3) float64 frames in image px; x = A u + c maps the unit circle to the
            measurement ellipse (conventions, item 6); det A > 0.
        responses: (N,) float32 detector responses, > 0.
        descriptors: (N, D) float32 of unit length.
        rectification_ids: (N,) int32, the warp each feature comes from; 0 is the image itself.
    """

    lafs: NDArray[np.float64]
    responses: NDArray[np.float32]
    descriptors: NDArray[np.float32]
    rectification_ids: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))

    def __post_init__(self) -> None:
        count = len(self.lafs)
        if count and not len(self.rectification_ids):
            object.__setattr__(self, "rectification_ids", np.zeros(count, np.int32))
        shapes = (self.lafs.shape, self.responses.shape, self.rectification_ids.shape)
        _require(
            shapes == ((count, 2, 3), (count,), (count,)) and len(self.descriptors) == count,
            f"shapes of frames, responses, ids {shapes} and {self.descriptors.shape=} do not fit",
        )
        _require(
            bool(np.isfinite(self.lafs).all() and (np.linalg.det(self.lafs[:, :, :2]) > 0).all()),
            "frames must be finite and of positive determinant",
        )

    def __len__(self) -> int:
        return len(self.lafs)

    @property
    def keypoints(self) -> NDArray[np.float64]:
        """(N, 2) centres of the frames, pixel-centre px."""
        return self.lafs[:, :, 2]

    @property
    def scales(self) -> NDArray[np.float64]:
        """(N,) geometric mean radius sqrt(det A) of the measurement ellipses in px."""
        return np.asarray(np.sqrt(np.linalg.det(self.lafs[:, :, :2])))

    def select(self, index: NDArray[np.generic]) -> LocalFeatures:
        """Keep the features of an index or mask array, in its order."""
        return LocalFeatures(
            self.lafs[index],
            self.responses[index],
            self.descriptors[index],
            self.rectification_ids[index],
        )

    def with_frames(
        self, lafs: NDArray[np.float64], rectification_id: int | None = None
    ) -> LocalFeatures:
        """Replace the frames and, if given, the rectification that all come from."""
        if rectification_id is None:
            return replace(self, lafs=lafs)
        ids = np.full(len(self), rectification_id, np.int32)
        return replace(self, lafs=lafs, rectification_ids=ids)

    def inside(self, size: tuple[int, int]) -> Mask:
        """Tell which centres lie in an image of (width, height)."""
        return is_inside(self.keypoints, size)


def union(parts: list[LocalFeatures]) -> LocalFeatures:
    """Concatenate features in the order given; at least one part."""
    return LocalFeatures(
        np.concatenate([part.lafs for part in parts]),
        np.concatenate([part.responses for part in parts]),
        np.concatenate([part.descriptors for part in parts]),
        np.concatenate([part.rectification_ids for part in parts]),
    )


@dataclass(frozen=True)
class Rectification:
    """One rectifying warp and the part of the image it is meant for.

    Attributes:
        rectified_from_image: (3, 3) float64 map of pixel-centre coordinates.
        canvas_size: (width, height) of the warp in px.
        region: (h, w) bool mask of the part of the image.
        tilt, tilt_angle_rad: class of the map in the space of tilts.
        region_origin: (x, y) image pixel of the mask's first pixel.
    """

    rectified_from_image: NDArray[np.float64]
    canvas_size: tuple[int, int]
    region: Mask
    tilt: float
    tilt_angle_rad: float
    region_origin: tuple[int, int] = (0, 0)

    def in_region(self, points: NDArray[np.floating]) -> Mask:
        """Tell which (N, 2) points, rounded to pixels of the image, belong to the region."""
        height, width = self.region.shape
        columns, rows = (np.rint(points).astype(int) - self.region_origin).T
        inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
        return np.asarray(inside & self.region[rows, columns])

    @property
    def image_from_rectified(self) -> NDArray[np.float64]:
        """(3, 3) inverse map."""
        return np.asarray(np.linalg.inv(self.rectified_from_image), dtype=np.float64)

    @property
    def canvas_area_px(self) -> int:
        """Number of pixels of the warp."""
        return self.canvas_size[0] * self.canvas_size[1]


@dataclass(frozen=True)
class RectificationPlan:
    """What to warp: data only, made by a rectifier and executed by :mod:`colmap_affrect.rectified`.

    The image itself is always part of the result and not listed. Warp k of ``items``
    has the rectification id k + 1.

    Attributes:
        image_size: (width, height) in px.
        items: the warps; may be empty.
    """

    image_size: tuple[int, int]
    items: tuple[Rectification, ...]

    @property
    def rectified_area_px(self) -> int:
        """Pixels of all warps together."""
        return sum(item.canvas_area_px for item in self.items)
