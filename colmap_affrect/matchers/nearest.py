"""Mutual nearest neighbours with a geometrically consistent ratio test (FGINN).

The second neighbour of the ratio test is the nearest descriptor that lies at least
``min_contrast_distance_px`` away from the first one (Mishkin, Matas, Perdoch, MODS, 2015):
features of several warps at one location do not reject each other. All descriptors are compared,
in chunks of bounded memory; many at first coarsely (:mod:`colmap_affrect.matchers.nearest_8bit`).
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from colmap_affrect.geometry.arrays import Bools, Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import NeighborLists, neighbors_within, without_duplicates
from colmap_affrect.matchers import nearest_8bit
from colmap_affrect.matchers.base import (
    ImageFeatures,
    MatcherContext,
    MatcherOptions,
    Matches,
    distance_ratios,
)
from colmap_affrect.options import within

CHUNK_ELEMENTS = 1 << 22  # similarities held at once, which bounds memory
CHUNK_ROWS = 1 << 12  # pairs of descriptors held at once, which bounds memory
NO_LIMIT = 2.0  # no ratio is larger than 1


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
    """What matching needs of one image, prepared once for all of its pairs."""

    descriptors: Singles  # (N, D) float32 rows of unit length
    keypoints: Floats  # (N, 2) pixel-centre px
    rivals: NeighborLists  # for each feature those too close to serve as its second neighbour
    coarse: nearest_8bit.CoarseDescriptors | None = None  # those in few bits, where that pays

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        kept = (self.descriptors, self.keypoints, self.rivals.starts, self.rivals.indices)
        return sum(array.nbytes for array in kept) + (self.coarse.nbytes if self.coarse else 0)


class NearestNeighbors:
    """Compares all descriptors, on the CPU."""

    Options = NearestOptions

    def __init__(self, options: NearestOptions, context: MatcherContext) -> None:
        self.options, self._is_coarse = options, nearest_8bit.coarse_pays(context.num_similarities)

    def prepare(self, image: ImageFeatures) -> MatchableImage:
        """Make the features of an image ready for matching."""
        descriptors = np.ascontiguousarray(image.features.descriptors, dtype=np.float32)
        keypoints = image.features.keypoints
        rivals = neighbors_within(keypoints, self.options.min_contrast_distance_px)
        coarse = nearest_8bit.CoarseDescriptors.of(descriptors) if self._is_coarse else None
        return MatchableImage(descriptors, keypoints, rivals, coarse)

    def match(self, first: MatchableImage, second: MatchableImage) -> Matches:
        """Match two images; scores are 1 - the larger ratio of distances."""
        options = self.options
        if not len(first.descriptors) or not len(second.descriptors):
            return Matches.none()
        everything = np.arange(len(first.descriptors))
        forward, ratios = _nearest(first, everything, second, options.max_ratio)
        rows = np.flatnonzero(ratios < options.max_ratio)
        targets, back = np.unique(forward[rows], return_inverse=True)
        back_limit = options.max_ratio if options.ratio_both_ways else NO_LIMIT
        backward, back_ratios = _nearest(second, targets, first, back_limit)
        worst = ratios[rows]
        if options.ratio_both_ways:
            worst = np.maximum(worst, back_ratios[back])
        keep = (backward[back] == rows) & (worst < options.max_ratio)
        rows, columns, worst = rows[keep], targets[back][keep], worst[keep]
        order = np.argsort(worst, kind="stable")
        places = first.keypoints[rows[order]], second.keypoints[columns[order]]
        kept = np.sort(order[without_duplicates(*places, options.duplicate_radius_px)])
        return Matches(np.stack([rows, columns], axis=1)[kept], 1.0 - worst[kept])


def _nearest(
    image1: MatchableImage, rows: Indices, image2: MatchableImage, max_ratio: float
) -> tuple[Indices, Singles]:
    """Return nearest features and ratios to non-rivals; perhaps -1 and infinite from the limit."""
    queries = image1.descriptors[rows]
    first, second = image1.coarse, image2.coarse
    if first is None or second is None:
        return _nearest_of_all(queries, image2)
    nearest, doubtful = np.full(len(rows), -1), np.zeros(len(rows), bool)
    ratios = np.full(len(rows), np.inf, np.float32)
    for short in nearest_8bit.short_lists(first, second, rows, image2.rivals, max_ratio):
        at = short.rows
        nearest[at], ratios[at], doubtful[at] = _nearest_of_listed(queries, image2, short)
    nearest[doubtful], ratios[doubtful] = _nearest_of_all(queries[doubtful], image2)
    return nearest, ratios


def _nearest_of_listed(
    queries: Singles, image: MatchableImage, short: nearest_8bit.ShortList
) -> tuple[Indices, Singles, Bools]:
    """Return nearest and ratio among the listed features, and where these are doubtful."""
    similarity = np.empty(len(short.entry_rows), np.float32)
    for begin in range(0, len(similarity), CHUNK_ROWS):
        part = slice(begin, begin + CHUNK_ROWS)
        query = queries[short.rows[short.entry_rows[part]]]
        candidates = image.descriptors[short.entry_columns[part]]
        similarity[part] = np.einsum("ij,ij->i", query, candidates)
    starts = np.searchsorted(short.entry_rows, np.arange(len(short.rows)))
    first = np.maximum.reduceat(similarity, starts)
    highest = np.flatnonzero(similarity == first[short.entry_rows])
    _, lowest_column = np.unique(short.entry_rows[highest], return_index=True)
    nearest = short.entry_columns[highest[lowest_column]]
    rows, rivals = image.rivals.of(nearest)
    count = len(image.descriptors)
    listed = short.entry_rows * count + short.entry_columns
    similarity[np.isin(listed, rows * count + rivals)] = -1.0
    doubtful = short.doubtful.copy()
    doubtful[rows[rivals == short.runners_up[rows]]] = True
    second = np.maximum.reduceat(similarity, starts)
    return nearest, distance_ratios(first, second), doubtful


def _nearest_of_all(queries: Singles, image: MatchableImage) -> tuple[Indices, Singles]:
    """Return the nearest feature of each query and the ratio to the nearest non-rival."""
    count = len(image.descriptors)
    nearest = np.empty(len(queries), np.int64)
    ratios = np.empty(len(queries), np.float32)
    step = max(1, CHUNK_ELEMENTS // count)
    buffer = np.empty((min(step, len(queries)), count), np.float32)
    for begin in range(0, len(queries), step):
        chunk = queries[begin : begin + step]
        similarity = np.matmul(chunk, image.descriptors.T, out=buffer[: len(chunk)])
        best = similarity.argmax(axis=1)
        first = similarity[np.arange(len(chunk)), best]
        similarity[image.rivals.of(best)] = -1.0
        nearest[begin : begin + step] = best
        ratios[begin : begin + step] = distance_ratios(first, similarity.max(axis=1))
    return nearest, ratios
