"""Data that flows between the layers: frozen, checked, numpy only."""

from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.affine import determinants
from colmap_affrect.geometry.arrays import Array, Bools, Bytes, Floats, Singles

GrayImage = Bytes  # (H, W) gray values, 0.299 R + 0.587 G + 0.114 B
ColorImage = Bytes  # (H, W, 3) red, green, blue
Mask = Bools
View = tuple[GrayImage | ColorImage, Bytes | None]
"""An image or a warp to find features in, and where (mask not 0; everywhere if it is None)."""


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class Photograph:
    """An image as rectifiers and depth sources see it."""

    gray: GrayImage  # (H, W) uint8 at the size of processing, at most ``max_image_size_px``
    name: str  # relative POSIX path below the image folder, the key of depth maps
    path: Path | None  # the file; None for an image that was never one
    # (3, 3) float64 pinhole intrinsics in pixel-centre px of ``gray``
    camera_matrix: Array
    mask: Mask | None = None  # (H, W) bool, where features may be; None: everywhere
    color: ColorImage | None = None  # (H, W, 3) uint8, for extractors that ask for it
    stretched: bool = False  # its contrast was low, and its tones have been stretched

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.gray.shape[1], self.gray.shape[0]


@dataclass(frozen=True)
class ShapeSamples:
    """Affine shapes at points of an image."""

    points: Array  # (N, 2) float64 pixel-centre px
    metrics: Floats  # (N, 3) unit metrics (S11, S22, S12) of the *rectifying* maps


@dataclass(frozen=True)
class ShapeGrid:
    """Affine shapes on a regular grid over an image; what every dense shape source returns."""

    metrics: Floats  # (R, C, 3) unit metrics (S11, S22, S12) of the *rectifying* maps
    # (R, C) bool, False where the image has no structure to read a shape from
    textured: Mask
    origin_px: float  # centre of cell (0, 0) in x and in y, pixel-centre px
    step_px: int  # distance of neighbouring cells in px

    def __post_init__(self) -> None:
        _require(
            self.metrics.ndim == 3 and self.metrics.shape == (*self.textured.shape, 3),
            f"{self.metrics.shape=} but expected (R, C, 3) with {self.textured.shape=}",
        )

    def samples(self) -> ShapeSamples:
        """Return the shapes of all textured cells with their centres."""
        rows, columns = np.nonzero(self.textured)
        points = self.origin_px + self.step_px * np.stack([columns, rows], axis=1)
        return ShapeSamples(points.astype(np.float64), self.metrics[rows, columns])


@dataclass(frozen=True)
class LocalFeatures:
    """Local features of one image as full local affine frames.

    Attributes:
        lafs: (N, 2, 3) float64 frames in image px; x = A u + c maps the unit circle to the
            measurement ellipse (conventions, item 6); det A > 0.
        responses: (N,) float32 detector responses, > 0.
        descriptors: (N, D) float32 of unit length; D = 0 before they are described.
        rectification_ids: (N,) int32, the warp each feature comes from; 0 is the image itself.
    """

    lafs: Array
    responses: Singles
    descriptors: Singles
    rectification_ids: NDArray[np.int32] = field(
        default_factory=lambda: np.zeros(0, np.int32)
    )

    def __post_init__(self) -> None:
        count = len(self.lafs)
        if count and not len(self.rectification_ids):
            object.__setattr__(self, "rectification_ids", np.zeros(count, np.int32))
        shapes = (self.lafs.shape, self.responses.shape, self.rectification_ids.shape)
        _require(
            shapes == ((count, 2, 3), (count,), (count,))
            and len(self.descriptors) == count,
            f"shapes of frames, responses, ids {shapes} and {self.descriptors.shape=} do not fit",
        )
        _require(
            bool(
                np.isfinite(self.lafs).all()
                and (determinants(self.lafs[:, :, :2]) > 0).all()
            ),
            "frames must be finite and of positive determinant",
        )

    def __len__(self) -> int:
        return len(self.lafs)

    @property
    def keypoints(self) -> Array:
        """(N, 2) centres of the frames, pixel-centre px."""
        return self.lafs[:, :, 2]

    @property
    def scales(self) -> Array:
        """(N,) geometric mean radius sqrt(det A) of the measurement ellipses in px."""
        return np.asarray(np.sqrt(determinants(self.lafs[:, :, :2])))

    def select(self, index: NDArray[np.generic]) -> Self:
        """Keep the features of an index or mask array, in its order."""
        return type(self)(*(getattr(self, item.name)[index] for item in fields(self)))

    @classmethod
    def empty(cls, descriptor_size: int = 0) -> Self:
        """Return the result for an image without features."""
        descriptors = np.zeros((0, descriptor_size), np.float32)
        return cls(np.zeros((0, 2, 3)), np.zeros(0, np.float32), descriptors)

    def with_rectification_id(self, rectification_id: int) -> Self:
        """Say which rectification all features come from."""
        return replace(
            self, rectification_ids=np.full(len(self), rectification_id, np.int32)
        )


def of_one_size(parts: list[LocalFeatures]) -> list[LocalFeatures]:
    """Fill up shorter descriptors with zeros, so that features of two kinds can be united."""
    widths = [part.descriptors.shape[1] for part in parts]
    return [
        replace(
            part,
            descriptors=np.pad(part.descriptors, ((0, 0), (0, max(widths) - width))),
        )
        for part, width in zip(parts, widths, strict=True)
    ]


def union(parts: list[LocalFeatures]) -> LocalFeatures:
    """Concatenate features in the order given; at least one part."""
    names = [item.name for item in fields(LocalFeatures)]
    return LocalFeatures(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in names)
    )


@dataclass(frozen=True)
class Rectification:
    """One rectifying warp and the part of the image it is meant for."""

    # (3, 3) float64 map of pixel-centre px; of a homography third coordinates are > 0 in the region
    rectified_from_image: Array
    canvas_size: tuple[int, int]  # (width, height) of the warp in px
    region: Mask | None  # (h, w) bool mask of the part of the image; None: all of it
    # class of the map in the space of tilts; of a homography that of its Jacobian in the middle
    tilt: float
    tilt_angle_rad: float
    region_origin: tuple[int, int] = (
        0,
        0,
    )  # (x, y) image pixel of the mask's first pixel
    segment_id: int = 0  # the segment of the image, from 0; several warps may share one

    def in_region(self, points: Floats) -> Mask:
        """Tell which (N, 2) points, rounded to pixels of the image, belong to the region."""
        if self.region is None:
            return np.ones(len(points), dtype=bool)
        return in_mask(self.region, points, self.region_origin)

    @property
    def image_from_rectified(self) -> Array:
        """(3, 3) inverse map."""
        return np.asarray(np.linalg.inv(self.rectified_from_image), dtype=np.float64)

    @property
    def canvas_area_px(self) -> int:
        """Number of pixels of the warp."""
        return self.canvas_size[0] * self.canvas_size[1]

    @property
    def is_affine(self) -> bool:
        """Whether the last row of the map is (0, 0, 1)."""
        return bool(np.array_equal(self.rectified_from_image[2], [0.0, 0.0, 1.0]))


def in_mask(mask: Mask, points: Floats, origin: tuple[int, int] = (0, 0)) -> Mask:
    """Tell which points, rounded to pixels, a mask holds.

    Args:
        mask: (h, w) of a part of an image.
        points: (N, 2) pixel-centre px of the image.
        origin: (x, y) of the first pixel of the mask.

    Returns:
        (N,) bool.
    """
    height, width = mask.shape
    columns, rows = (np.rint(points).astype(int) - origin).T
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    columns = np.where(inside, columns, 0)
    rows = np.where(inside, rows, 0)
    return np.asarray(inside & mask[rows, columns])


@dataclass(frozen=True)
class RectificationPlan:
    """What to warp: data only, made by a rectifier, executed by ``rectifiers.execute``.

    The image itself is not listed. Warp k of ``items`` has the rectification id k + 1.
    """

    image_size: tuple[int, int]  # (width, height) in px
    items: tuple[Rectification, ...] = ()  # the warps
    # (H, W) where features of the image stay; None: all
    original_region: Mask | None = None
    # a feature of a warp takes the place of one of the image itself at the same place and scale:
    # for disjoint regions, each with the map that suits it best
    replaces_original: bool = False

    @property
    def rectified_area_px(self) -> int:
        """Pixels of all warps together."""
        return sum(item.canvas_area_px for item in self.items)
