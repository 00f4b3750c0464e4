"""Rectifiers of planar segments: ``depth-planes``, as if seen from the front; ``depth-affnet``.

Segments are those of the paper's depth-map-based rectification (Sec. 3) after Toft et al. 2020:
normals of a depth map are clustered on the sphere, and each connected region of a cluster is a
segment. The paper's DepthAffNet warps each segment as ``affnet-shapes`` does, by a cover of the
shapes inside it.
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
from colmap_affrect.rectifiers.base import (
    CoverOptions,
    RectifierOptions,
    Warps,
    WithInputs,
)
from colmap_affrect.rectifiers.regions import Region, homography_rectification

MAX_DEPTH_SIZE_PX = 640
"""Longer side to which larger depth maps are shrunk: in their windows of 5 x 5 px noise is too
large for the small part of a plane (the paper's maps have 512 px); judged."""


@dataclass(frozen=True)
class PlanarSegment:
    """Connected part of an image that shows one plane."""

    region: Region
    normal: Array  # (3,) unit, in camera coordinates, facing the camera


class PlaneOptions(Options):
    """Planes from the normals of a depth map (the paper's depth-map-based method)."""

    num_candidates: Annotated[int, within(10, 100_000)] = 500
    """Candidate normals, on a spiral over the whole sphere. Paper: 500."""
    bin_angle_deg: Annotated[float, within(1.0, 89.0)] = 35.0  # judged
    """Normals at most this far from a candidate vote for it."""
    # Theory: walls are perpendicular
    min_separation_deg: Annotated[float, within(0.0, 180.0)] = 87.5
    """Planes are at least this far apart."""
    max_num_planes: Annotated[int, within(1, 100)] = 3  # theory
    """Most planes of a photograph."""
    min_votes_frac: Annotated[float, within(0.0, 1.0)] = 0.15  # judged
    """Share of the pixels that a plane must have."""
    max_angle_deg: Annotated[float, within(0.0, 85.0)] = 75.0  # judged
    """Planes seen at a larger angle are not rectified."""
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.03  # judged
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
        depth = self.depth.depth(photograph)
        segments = planar_segments(photograph, depth, self.options.planes)
        camera_matrix = photograph.camera_matrix
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            homography = planes.fronto_parallel_homography(
                segment.normal, camera_matrix
            )
            items.append(homography_rectification(segment.region, homography, number))
        outside = None
        if self.options.keep_original == "outside":
            outside = ~_union(segments, photograph.size)
        return RectificationPlan(
            image_size=photograph.size, items=tuple(items), original_region=outside
        )


def planar_segments(
    photograph: Photograph, depth: Floats, options: PlaneOptions
) -> list[PlanarSegment]:
    """Segment a photograph into connected parts of planes.

    A pixel belongs to the plane with the nearest normal, if that is near enough, and if the angle
    between normal and ray is at most ``max_angle_deg``. (The authors take the optical axis instead
    of the ray, and keep a plane as a whole.) A rectified area is 1 / cos^3 of that angle times as
    large, so far ends of planes are left out.

    Args:
        photograph: with its camera.
        depth: (h, w) z-depth of the whole photograph, of any size; NaN where unknown.
        options: which planes count.

    Returns:
        Segments, in the order of the planes.
    """
    given_size = (depth.shape[1], depth.shape[0])
    depth, shrunk_from_given = planes.shrink_depth(depth, MAX_DEPTH_SIZE_PX)
    given_from_image = resized_from_original(photograph.size, given_size)
    depth_from_image = shrunk_from_given @ given_from_image
    depth_camera = depth_from_image @ photograph.camera_matrix
    clusters = planes.cluster_normals(
        planes.normals_from_depth(depth, depth_camera),
        num_candidates=options.num_candidates,
        bin_angle_rad=np.deg2rad(options.bin_angle_deg),
        min_separation_rad=np.deg2rad(options.min_separation_deg),
        max_num_planes=options.max_num_planes,
        min_votes_frac=options.min_votes_frac,
    )
    labels = _resampled_labels(clusters.labels, depth_from_image, photograph.size)
    min_cosine = np.cos(np.deg2rad(options.max_angle_deg))
    min_area_px = options.min_region_frac * labels.size
    segments = []
    for label, normal in enumerate(clusters.normals):
        cosines = planes.viewing_cosines(
            normal, photograph.camera_matrix, photograph.size
        )
        is_on_plane = (labels == label) & (cosines >= min_cosine)
        for region in connected_regions(is_on_plane, min_area_px):
            segments.append(PlanarSegment(region, normal))
    return segments


def connected_regions(mask: Mask, min_area_px: float) -> Iterator[Region]:
    """Yield the 4-connected regions that have enough pixels."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=4
    )
    for label, (left, top, width, height, area) in enumerate(stats.tolist()):
        is_background = label == 0
        if is_background or area < min_area_px:
            continue
        box = labels[top : top + height, left : left + width]
        yield Region(box == label, (left, top))


def _resampled_labels(
    labels: NDArray[np.int32], labels_from_image: Array, size: tuple[int, int]
) -> NDArray[np.int32]:
    """Return the nearest label of each pixel of an image.

    Args:
        labels: (h, w).
        labels_from_image: (3, 3) map of pixel-centre px, which only scales and shifts.
        size: (width, height) of the image.

    Returns:
        (height, width) labels.
    """
    width, height = size
    x = np.rint(labels_from_image[0, 0] * np.arange(width) + labels_from_image[0, 2])
    y = np.rint(labels_from_image[1, 1] * np.arange(height) + labels_from_image[1, 2])
    columns = x.astype(int).clip(0, labels.shape[1] - 1)
    rows = y.astype(int).clip(0, labels.shape[0] - 1)
    return np.asarray(labels[rows[:, None], columns])


def _union(segments: list[PlanarSegment], size: tuple[int, int]) -> Mask:
    """Return the pixels of all segments in an image of (width, height)."""
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
        depth = self.depth.depth(photograph)
        segments = planar_segments(photograph, depth, options.planes)
        samples = self.shapes.samples(photograph.gray)
        items: list[Rectification] = []
        for number, segment in enumerate(segments):
            is_inside = segment.region.contains(samples.points)
            cover = options.cover(samples.metrics[is_inside])
            for tilt, angle in cover.centers.tolist():
                items.append(
                    options.warp(
                        region=segment.region,
                        tilt=tilt,
                        angle_rad=angle,
                        segment_id=number,
                    )
                )
        return RectificationPlan(photograph.size, tuple(items))
