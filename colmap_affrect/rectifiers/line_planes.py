"""Rectifier ``lines``: walls and floors as if seen from the front, without depth maps.

Two of the three orthogonal directions of the straight lines of a photograph span a plane whose
normal is the third. Where segments of both lie, the photograph shows such a plane; it is warped by
the homography that ``depth-planes`` takes for a normal of a depth map.
"""

import itertools
import math
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.data import Photograph, Rectification, RectificationPlan
from colmap_affrect.geometry import planes
from colmap_affrect.geometry.arrays import Array, Floats, Singles
from colmap_affrect.geometry.conventions import HALF_PIXEL
from colmap_affrect.geometry.lines import MIN_EVIDENCE, Explanation
from colmap_affrect.geometry.segments import Segments
from colmap_affrect.images.lines import lines_of
from colmap_affrect.options import within
from colmap_affrect.rectifiers.base import RectifierOptions, Warps, WithInputs
from colmap_affrect.rectifiers.depth_planes import connected_regions
from colmap_affrect.rectifiers.regions import homography_rectification

MAP_SIZE_PX = 160  # longer side of the maps of where segments lie; resource
REACH = 0.04  # longer sides; a segment tells of a plane about so far around it; judged
# Of segments, in units of a single long one that runs through a pixel; judged
MIN_DENSITY = 0.3
# Of directions, which span a plane; theory
PAIRS = tuple(itertools.combinations(range(3), 2))


class LinePlanesOptions(RectifierOptions):
    """One homography per region in which straight lines span a plane, as if seen from the front."""

    name: Literal["lines"] = "lines"
    warps: ClassVar[Warps] = "some"
    min_angle_deg: Annotated[float, within(0.0, 85.0)] = 30.0  # judged
    """Planes seen at a smaller angle from the front, in the middle of a region, are not warped."""
    # Same as PlaneOptions.max_angle_deg
    max_angle_deg: Annotated[float, within(0.0, 85.0)] = 75.0
    """Planes seen at a larger angle are not warped."""
    # Same as PlaneOptions.min_region_frac
    min_region_frac: Annotated[float, within(0.0, 1.0)] = 0.03
    """Connected regions of a smaller share of the image are not warped."""


class LinePlanes(WithInputs):
    """Planes that straight lines span as if seen from the front."""

    Options = LinePlanesOptions

    def plan(self, photograph: Photograph) -> RectificationPlan:
        """Plan one warp for each region of a plane; none where lines say nothing."""
        lines = lines_of(photograph.gray, photograph.mask)
        explanation = lines.explanation()
        if explanation is None or explanation.evidence < MIN_EVIDENCE:
            return RectificationPlan(photograph.size)
        camera = camera_matrix_of(explanation, photograph.size)
        labels = plane_labels(lines.segments, explanation, photograph.size)
        items: list[Rectification] = []
        for label, (first, second) in enumerate(PAIRS):
            (third,) = {0, 1, 2} - {first, second}
            for sign in (-1.0, 1.0):  # a camera between two walls sees both sides
                normal = sign * explanation.rotation[third]
                items += self._warps(
                    is_of_plane=labels == label,
                    normal=normal,
                    camera=camera,
                    first_number=len(items),
                )
        return RectificationPlan(photograph.size, tuple(items))

    def _warps(
        self,
        is_of_plane: NDArray[np.bool_],
        normal: Floats,
        camera: Array,
        first_number: int,
    ) -> list[Rectification]:
        """Return the warps of the connected regions of one plane.

        Args:
            is_of_plane: (H, W).
            normal: (3,) of the plane, towards those who see its front.
            camera: (3, 3) intrinsics.
            first_number: of the regions, for reports.
        """
        if normal[2] >= math.cos(math.radians(1.0)):  # nobody sees its front
            return []
        height, width = is_of_plane.shape
        cosines = planes.viewing_cosines(normal, camera, (width, height))
        min_cosine = math.cos(math.radians(self.options.max_angle_deg))
        max_mean_cosine = math.cos(math.radians(self.options.min_angle_deg))
        is_seen = is_of_plane & (cosines >= min_cosine)
        min_area_px = self.options.min_region_frac * is_of_plane.size
        homography = planes.fronto_parallel_homography(normal, camera)
        items: list[Rectification] = []
        for region in connected_regions(is_seen, min_area_px):
            left, top = region.origin
            rows, columns = region.mask.shape
            inside = cosines[top : top + rows, left : left + columns][region.mask]
            if float(inside.mean()) <= max_mean_cosine:
                number = first_number + len(items)
                items.append(homography_rectification(region, homography, number))
        return items


def camera_matrix_of(explanation: Explanation, size: tuple[int, int]) -> Array:
    """Return the (3, 3) intrinsics by lines for an image of (width, height), pixel-centre px."""
    longer_side = max(size)
    focal = explanation.focal * longer_side
    x = size[0] / 2.0 - HALF_PIXEL
    y = size[1] / 2.0 - HALF_PIXEL + explanation.shift * longer_side
    return np.array([[focal, 0.0, x], [0.0, focal, y], [0.0, 0.0, 1.0]])


def plane_labels(
    segments: Segments,
    explanation: Explanation,
    size: tuple[int, int],
) -> NDArray[np.int32]:
    """Return which pair of directions spans the plane at each pixel.

    Args:
        segments: N of the photograph.
        explanation: has their directions.
        size: (width, height) of the photograph in px.

    Returns:
        (height, width) indices of ``PAIRS``, -1 where no two directions have segments nearby.
    """
    densities = [
        _density(segments, explanation.kinds == kind, size) for kind in range(3)
    ]
    of_pairs = []
    for first, second in PAIRS:
        of_pairs.append(np.minimum(densities[first], densities[second]))
    pair_densities = np.stack(of_pairs)
    is_dense = pair_densities.max(axis=0) >= MIN_DENSITY
    labels = np.where(is_dense, pair_densities.argmax(axis=0), -1).astype(np.int32)
    resized = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized, dtype=np.int32)


def _density(
    segments: Segments, is_chosen: NDArray[np.bool_], size: tuple[int, int]
) -> Singles:
    """Return how many of the chosen segments lie around each pixel of a small map of the image."""
    scale = MAP_SIZE_PX / max(size)
    width = max(1, round(scale * size[0]))
    height = max(1, round(scale * size[1]))
    drawn: Singles = np.zeros((height, width), np.float32)
    middle = np.array([width, height]) / 2.0 - HALF_PIXEL
    starts = np.rint(segments.starts[is_chosen] * MAP_SIZE_PX + middle).astype(int)
    ends = np.rint(segments.ends[is_chosen] * MAP_SIZE_PX + middle).astype(int)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        one_line = np.zeros_like(drawn)
        cv2.line(one_line, start, end, 1.0)
        drawn += one_line
    sigma = REACH * MAP_SIZE_PX
    blurred = cv2.GaussianBlur(drawn, (0, 0), sigma)
    return np.asarray(blurred * (math.sqrt(2.0 * math.pi) * sigma), dtype=np.float32)
