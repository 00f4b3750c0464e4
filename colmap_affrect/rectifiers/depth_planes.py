"""Rectifiers of planar segments: ``depth-planes``, as if seen from the front; ``depth-affnet``.

Segments are those of the paper's depth-map-based rectification (Sec. 3) after Toft et al. 2020:
normals from a depth map, their clusters on the sphere, connected segments of each cluster. The
paper's DepthAffNet warps each as ``affnet-shapes`` does, by a cover of the shapes inside it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import Mask, Photograph, Rectification, RectificationPlan
from colmap_affrect.geometry import planes
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.conventions import resized_from_original
from colmap_affrect.options import Options, within
from colmap_affrect.rectifiers.base import CoverOptions, RectifierOptions, Warps, WithInputs
from colmap_affrect.rectifiers.regions import Region, homography_rectification

MAX_DEPTH_SIZE_PX = 640
"""Larger depth maps are shrunk to this: windows of 5 x 5 px of them see too little of a plane,
and noise too much (the paper's maps have 512 px)."""


@dataclass(frozen=True)
class PlanarSegment:
    """Connected part of an image, and its (3,) unit normal in camera coordinates, facing us."""

    region: Region
    normal: Array


class PlaneOptions(Options):
    """Planes from the normals of a depth map (the paper's depth-map-based method)."""

    num_candidates: Annotated[int, within(10, 100_000)] = 500
    """Candidate normals, on a spiral over the whole sphere. Paper: 500."""
    bin_angle_deg: Annotated[float, within(1.0, 89.0)] = 35.0
    """Normals at most this far from a candidate vote for it."""
    min_separation_deg: Annotated[float, within(0.0, 180.0)] = 87.5
    """Planes are at least this far apart."""
    max_num_planes: Annotated[int, within(1, 100)] = 3
    """Most planes of a photograph."""
    min_votes_frac: Annotated[float, within(0.0, 1.0)] = 0.15
    """Share of the pixels that a plane must have."""
    max_angle_deg: Annotated[float, within(0.0, 85.0)] = 75.0
    """Planes seen at a larger angle are not rectified."""
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.03
    """Connected regions of a smaller share of the image are not rectified."""


class DepthPlanesOptions(RectifierOptions):
    """One homography per planar region, as if seen from the front."""

    name: Literal["depth-planes"] = "depth-planes"
    warps: ClassVar[Warps] = "some"
    planes: PlaneOptions = PlaneOptions()
    """How planes are found in a depth map."""
    keep_original: Literal["everywhere", "outside"] = "everywhere"
    """Features of the photograph itself are kept ``everywhere`` or ``outside`` of the rectified
    regions (the paper)."""
    uses_depth: ClassVar[bool] = True


class DepthPlanes(WithInputs):
    """Planar segments as if seen from the front."""

    Options = DepthPlanesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan one warp for each segment; DepthError when there is no usable depth map."""
        segments = planar_segments(photograph, self.depth.depth(photograph), self.options.planes)
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            turned = planes.fronto_parallel_homography(segment.normal, photograph.camera_matrix)
            items.append(homography_rectification(segment.region, turned, number))
        everywhere = self.options.keep_original == "everywhere"
        outside = None if everywhere else ~_union(segments, photograph.size)
        return RectificationPlan(photograph.size, tuple(items), outside)


def planar_segments(
    photograph: Photograph, depth: Floats, options: PlaneOptions
) -> list[PlanarSegment]:
    """Segment a photograph into connected parts of planes.

    A pixel belongs to the plane whose normal is nearest, if near enough, and if it sees it at no
    more than ``max_angle_deg``, the angle between normal and ray. (The authors take the optical
    axis, and keep a plane as a whole.) From the front an area grows by 1 / cos^3 of it, so far ends
    are left out. ``depth`` is (h, w) z-depth of the whole photograph, of any size; NaN: unknown.
    """
    size_of_depth = (depth.shape[1], depth.shape[0])
    depth, shrunk_from_depth = planes.shrink_depth(depth, MAX_DEPTH_SIZE_PX)
    depth_from_image = shrunk_from_depth @ resized_from_original(photograph.size, size_of_depth)
    clusters = planes.cluster_normals(
        planes.normals_from_depth(depth, depth_from_image @ photograph.camera_matrix),
        num_candidates=options.num_candidates,
        bin_angle_rad=np.deg2rad(options.bin_angle_deg),
        min_separation_rad=np.deg2rad(options.min_separation_deg),
        max_num_planes=options.max_num_planes,
        min_votes_frac=options.min_votes_frac,
    )
    labels = _resampled(clusters.labels, depth_from_image, photograph.size)
    min_cos = np.cos(np.deg2rad(options.max_angle_deg))
    min_area_px = options.min_region_frac * labels.size
    segments = []
    for label, normal in enumerate(clusters.normals):
        cosines = planes.viewing_cosines(normal, photograph.camera_matrix, photograph.size)
        found = _connected_regions((labels == label) & (cosines >= min_cos), min_area_px)
        segments += [PlanarSegment(region, normal) for region in found]
    return segments


def _connected_regions(mask: Mask, min_area_px: float) -> Iterator[Region]:
    """Yield the 4-connected regions that have enough pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    for label, (left, top, width, height, area) in enumerate(stats.tolist()):
        if label > 0 and area >= min_area_px:
            yield Region(labels[top : top + height, left : left + width] == label, (left, top))


def _resampled(
    labels: NDArray[np.int32], labels_from_image: Array, size: tuple[int, int]
) -> NDArray[np.int32]:
    """Give each pixel of an image of (width, height) its nearest label; the map only scales."""
    columns, rows = (
        np.rint(labels_from_image[axis, axis] * np.arange(extent) + labels_from_image[axis, 2])
        .astype(int)
        .clip(0, labels.shape[1 - axis] - 1)
        for axis, extent in enumerate(size)
    )
    return np.asarray(labels[rows[:, None], columns])


def _union(segments: list[PlanarSegment], size: tuple[int, int]) -> Mask:
    mask = np.zeros(size[::-1], dtype=bool)
    for segment in segments:
        left, top = segment.region.origin
        height, width = segment.region.mask.shape
        mask[top : top + height, left : left + width] |= segment.region.mask
    return mask


class DepthAffNetOptions(CoverOptions):
    """Planar regions from depth, each warped by a cover of the shapes inside it."""

    name: Literal["depth-affnet"] = "depth-affnet"
    warps: ClassVar[Warps] = "some"
    planes: PlaneOptions = PlaneOptions()
    """How planes are found in a depth map."""
    uses_depth: ClassVar[bool] = True


class DepthAffNet(WithInputs):
    """Planar segments, each warped by the affine maps that cover its shapes."""

    Options = DepthAffNetOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan the warps of each segment, if its shapes are tilted; DepthError without depth."""
        options = self.options
        segments = planar_segments(photograph, self.depth.depth(photograph), options.planes)
        samples = self.shapes.samples(photograph.gray)
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            inside = segment.region.contains(samples.points)
            for tilt, angle in options.cover(samples.metrics[inside]).centers.tolist():
                items.append(options.warp(segment.region, tilt, angle, number))
        return RectificationPlan(photograph.size, tuple(items))
