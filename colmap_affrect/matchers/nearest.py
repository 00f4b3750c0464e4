"""Mutual nearest neighbours with a geometrically consistent ratio test (FGINN).

The second neighbour of the ratio test is the nearest descriptor that lies at least
``min_contrast_distance_px`` away from the first one (Mishkin, Matas, Perdoch, MODS, 2015): features
of several warps at one position do not reject each other. All descriptors are compared, in chunks
of bounded memory; where there are many, coarsely at first
(:mod:`colmap_affrect.matchers.nearest_8bit`).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from colmap_affrect.geometry.arrays import Bools, Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import (
    NeighborLists,
    neighbors_within,
    without_duplicates,
)
from colmap_affrect.matchers import nearest_8bit
from colmap_affrect.matchers.base import (
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
    Matches,
    distance_ratios,
)
from colmap_affrect.options import within

CHUNK_ELEMENTS = 1 << 22  # cosines held at once, which bounds memory; resource
# Pairs of descriptors compared at once, which bounds memory; resource
CHUNK_ENTRIES = 1 << 12
NO_LIMIT = 2.0  # of ratios, which are at most 1; theory


class NearestOptions(MatcherOptions):
    """Mutual nearest neighbours."""

    name: Literal["nearest"] = "nearest"
    max_ratio: Annotated[float, within(0.1, 1.0)] = 0.85  # judged
    """Largest ratio of first to second descriptor distance."""
    ratio_both_ways: bool = True
    """Test the ratio in both directions; False: from image 1 to 2 only, as in the paper."""
    min_contrast_distance_px: Annotated[float, within(0.1, 1000.0)] = 10.0  # paper
    """The second neighbour must be this far from the first (FGINN; MODS: 10-30 px)."""
    duplicate_radius_px: Annotated[float, within(0.01, 1000.0)] = 2.0  # judged
    """Of matches closer than this at both ends the best one stays."""
    max_num_first: Annotated[int, within(0, 1_000_000)] = 8192  # resource

    def load_meanwhile(self, num_pairs: int) -> None:
        """Begin to load torch, where so many pairs of images take it."""
        nearest_8bit.load_meanwhile(float(num_pairs) * self.max_num_first**2)


@dataclass(frozen=True)
class MatchableImage:
    """Features of one image, prepared once for all of its pairs."""

    descriptors: Singles  # (N, D) float32 rows of unit length
    keypoints: Floats  # (N, 2) pixel-centre px
    rivals: NeighborLists  # for each feature those too near to be its second neighbour
    coarse: nearest_8bit.CoarseDescriptors | None = None  # the descriptors in 8 bits

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        rivals = self.rivals.starts.nbytes + self.rivals.indices.nbytes
        coarse = self.coarse.nbytes if self.coarse else 0
        return self.descriptors.nbytes + self.keypoints.nbytes + rivals + coarse


class NearestNeighbors:
    """Compares all descriptors, on the CPU."""

    Options = NearestOptions

    def __init__(self, options: NearestOptions, context: MatcherContext) -> None:
        self.options = options
        self.is_coarse = nearest_8bit.coarse_pays(context.num_comparisons)

    def prepare(self, image: ImageFeatures) -> MatchableImage:
        """Find the rivals of each feature of an image, and round descriptors where that pays."""
        descriptors = np.ascontiguousarray(image.features.descriptors, dtype=np.float32)
        keypoints = image.features.keypoints
        rivals = neighbors_within(keypoints, self.options.min_contrast_distance_px)
        coarse = None
        if self.is_coarse:
            coarse = nearest_8bit.CoarseDescriptors.of(descriptors)
        return MatchableImage(descriptors, keypoints, rivals, coarse)

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
        all_rows = np.arange(len(first.descriptors))
        nearest2, ratios1 = _nearest(first, all_rows, second, options.max_ratio)
        rows1 = np.flatnonzero(ratios1 < options.max_ratio)
        # Only features of image 2 that somebody's nearest neighbour is are compared backwards.
        targets, target_of_row = np.unique(nearest2[rows1], return_inverse=True)
        limit = options.max_ratio if options.ratio_both_ways else NO_LIMIT
        nearest1, ratios2 = _nearest(second, targets, first, limit)
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


def _nearest(
    image1: MatchableImage, rows: Indices, image2: MatchableImage, max_ratio: float
) -> tuple[Indices, Singles]:
    """Return the nearest feature of some of image 1, and the ratio to the nearest non-rival.

    Args:
        image1: features of which some are asked for.
        rows: (Q,) which of them.
        image2: features that they are compared with, at least one.
        max_ratio: from which on a ratio does not matter.

    Returns:
        (Q,) features of image 2, and (Q,) ratios of the distances to both neighbours. Where the
        ratio is ``max_ratio`` and larger, they may be -1 and infinite.
    """
    queries = image1.descriptors[rows]
    if image1.coarse is None or image2.coarse is None:
        return _nearest_of_all(queries, image2)
    nearest = np.full(len(rows), -1)
    ratios = np.full(len(rows), np.inf, np.float32)
    is_doubtful = np.zeros(len(rows), np.bool_)
    codes1 = image1.coarse.codes[rows]
    for listed in nearest_8bit.short_lists(
        codes1, image1.coarse.step, image2.coarse, image2.rivals, max_ratio
    ):
        found = _nearest_of_listed(queries, image2, listed)
        nearest[listed.rows], ratios[listed.rows], is_doubtful[listed.rows] = found
    nearest[is_doubtful], ratios[is_doubtful] = _nearest_of_all(
        queries[is_doubtful], image2
    )
    return nearest, ratios


def _nearest_of_listed(
    queries: Singles, image: MatchableImage, listed: nearest_8bit.ShortList
) -> tuple[Indices, Singles, Bools]:
    """Return for R listed rows what `_nearest` does, and where these may be others than listed.

    Args:
        queries: (Q, D) float32 rows of unit length.
        image: features that they are compared with.
        listed: rows of the queries, and what may be their neighbours.

    Returns:
        (R,) nearest features, (R,) ratios, and (R,) whether all have to be compared.
    """
    num_features = len(image.descriptors)
    cosines = _listed_cosines(queries, image.descriptors, listed)
    starts = np.searchsorted(listed.entry_rows, np.arange(len(listed.rows)))
    best_cosines = np.maximum.reduceat(cosines, starts)
    best_entries = np.flatnonzero(cosines == best_cosines[listed.entry_rows])
    _, first_of_row = np.unique(listed.entry_rows[best_entries], return_index=True)
    nearest = listed.entry_columns[best_entries[first_of_row]]
    rows, rivals = image.rivals.of(nearest)
    entries = listed.entry_rows * num_features + listed.entry_columns
    is_rival = np.isin(entries, rows * num_features + rivals)
    cosines[is_rival] = -1.0
    second_cosines = np.maximum.reduceat(cosines, starts)
    is_doubtful = listed.is_doubtful.copy()
    is_doubtful[rows[rivals == listed.runners_up[rows]]] = True
    return nearest, distance_ratios(best_cosines, second_cosines), is_doubtful


def _listed_cosines(
    queries: Singles, descriptors: Singles, listed: nearest_8bit.ShortList
) -> Singles:
    """Return the (E,) cosines of the pairs that are listed."""
    cosines = np.empty(len(listed.entry_rows), np.float32)
    for begin in range(0, len(cosines), CHUNK_ENTRIES):
        part = slice(begin, begin + CHUNK_ENTRIES)
        query = queries[listed.rows[listed.entry_rows[part]]]
        candidates = descriptors[listed.entry_columns[part]]
        cosines[part] = np.einsum("ij,ij->i", query, candidates)
    return cosines


def _nearest_of_all(queries: Singles, image: MatchableImage) -> tuple[Indices, Singles]:
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
        ratios[begin : begin + step] = distance_ratios(
            best_cosines, cosines.max(axis=1)
        )
    return nearest, ratios
