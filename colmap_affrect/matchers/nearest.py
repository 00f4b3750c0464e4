"""Mutual nearest neighbours with a geometrically consistent ratio test (FGINN).

The second neighbour of the ratio test is the nearest descriptor that lies at least
``min_contrast_distance_px`` away from the first one (Mishkin, Matas, Perdoch, MODS, 2015): features
of several warps at one position do not reject each other. All descriptors are compared, in chunks
of bounded memory.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from colmap_affrect.geometry.arrays import Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists, neighbors_within, without_duplicates
from colmap_affrect.matchers.base import (
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
    Matches,
    distance_ratios,
)
from colmap_affrect.options import within

CHUNK_ELEMENTS = 1 << 22  # cosines held at once, which bounds memory


class NearestOptions(MatcherOptions):
    """Mutual nearest neighbours."""

    name: Literal["nearest"] = "nearest"
    max_ratio: Annotated[float, within(0.1, 1.0)] = 0.85
    """Largest ratio of first to second descriptor distance."""
    ratio_both_ways: bool = True
    """Test the ratio in both directions; False: from image 1 to 2 only, as in the paper."""
    min_contrast_distance_px: Annotated[float, within(0.1, 1000.0)] = 10.0
    """The second neighbour must be this far from the first (FGINN; MODS: 10-30 px)."""
    duplicate_radius_px: Annotated[float, within(0.01, 1000.0)] = 2.0
    """Of matches closer than this at both ends the best one stays."""
    max_num_first: Annotated[int, within(0, 1_000_000)] = 8192


@dataclass(frozen=True)
class MatchableImage:
    """Features of one image, prepared once for all of its pairs."""

    descriptors: Singles  # (N, D) float32 rows of unit length
    keypoints: Floats  # (N, 2) pixel-centre px
    rivals: NeighborLists  # for each feature those too near to be its second neighbour

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        rivals = self.rivals.starts.nbytes + self.rivals.indices.nbytes
        return self.descriptors.nbytes + self.keypoints.nbytes + rivals


class NearestNeighbors:
    """Compares all descriptors, on the CPU."""

    Options = NearestOptions

    def __init__(self, options: NearestOptions, context: MatcherContext) -> None:
        del context
        self.options = options

    def prepare(self, image: ImageFeatures) -> MatchableImage:
        """Find the rivals of each feature of an image."""
        keypoints = image.features.keypoints
        return MatchableImage(
            np.ascontiguousarray(image.features.descriptors, dtype=np.float32),
            keypoints,
            neighbors_within(keypoints, self.options.min_contrast_distance_px),
        )

    def match(self, first: MatchableImage, second: MatchableImage) -> Matches:
        """Match two images; scores are 1 - the larger ratio of distances.

        Args:
            first: prepared image 1.
            second: prepared image 2; either may have no features.

        Returns:
            Matches, one to one.
        """
        options = self.options
        if not len(first.descriptors) or not len(second.descriptors):
            return Matches.none()
        nearest2, ratios1 = _nearest(first.descriptors, second)
        rows1 = np.flatnonzero(ratios1 < options.max_ratio)
        # Only features of image 2 that somebody's nearest neighbour is are compared backwards.
        targets, target_of_row = np.unique(nearest2[rows1], return_inverse=True)
        nearest1, ratios2 = _nearest(second.descriptors[targets], first)
        ratios = ratios1[rows1]
        if options.ratio_both_ways:
            ratios = np.maximum(ratios, ratios2[target_of_row])
        is_mutual = nearest1[target_of_row] == rows1
        kept = is_mutual & (ratios < options.max_ratio)
        indices = np.stack([rows1, targets[target_of_row]], axis=1)[kept]
        ratios = ratios[kept]
        best_first = np.argsort(ratios, kind="stable")
        points1 = first.keypoints[indices[best_first, 0]]
        points2 = second.keypoints[indices[best_first, 1]]
        is_unique = without_duplicates(points1, points2, options.duplicate_radius_px)
        unique = np.sort(best_first[is_unique])
        return Matches(indices[unique], 1.0 - ratios[unique])


def _nearest(queries: Singles, image: MatchableImage) -> tuple[Indices, Singles]:
    """Return the nearest feature of each query and the ratio to the nearest non-rival.

    Args:
        queries: (Q, D) float32 rows of unit length.
        image: features that they are compared with, at least one.

    Returns:
        (Q,) features, and (Q,) ratios of the distances to both neighbours.
    """
    num_features = len(image.descriptors)
    nearest = np.empty(len(queries), np.int64)
    ratios = np.empty(len(queries), np.float32)
    step = max(1, CHUNK_ELEMENTS // num_features)
    buffer = np.empty((min(step, len(queries)), num_features), np.float32)
    for begin in range(0, len(queries), step):
        chunk = queries[begin : begin + step]
        cosines = np.matmul(chunk, image.descriptors.T, out=buffer[: len(chunk)])
        best = cosines.argmax(axis=1)
        best_cosines = cosines[np.arange(len(chunk)), best]
        cosines[image.rivals.of(best)] = -1.0
        nearest[begin : begin + step] = best
        ratios[begin : begin + step] = distance_ratios(best_cosines, cosines.max(axis=1))
    return nearest, ratios
