"""Mutual nearest neighbours with a geometrically consistent ratio test (FGINN).

The second neighbour of the ratio test is the nearest descriptor that lies at least
``min_contrast_distance_px`` away from the first one (Mishkin, Matas, Perdoch, MODS, 2015): features
of several warps at one position do not reject each other. All descriptors are compared, in chunks
of bounded memory; where there are many, coarsely at first
(:mod:`colmap_affrect.matchers.nearest_8bit`). Among many pairs most have nothing in common: where
hardly a match of the largest features of two images agrees with matches beside it, the others are
not compared. Large features are seen from near and far (preemptive matching: Wu, Towards
Linear-Time Incremental Structure from Motion, 2013).
"""

import math
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np

from colmap_affrect.colmap.two_views import telling_shapes
from colmap_affrect.geometry.arrays import Bools, Floats, Indices, Singles
from colmap_affrect.geometry.neighbors import (
    NeighborLists,
    neighbors_within,
    num_consistent_matches,
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
from colmap_affrect.parallel.executor import one_openmp_thread

CHUNK_ELEMENTS = 1 << 22  # cosines held at once, which bounds memory; resource
# Pairs of descriptors compared at once, which bounds memory; resource
CHUNK_ENTRIES = 1 << 11
NO_LIMIT = 2.0  # of ratios, which are at most 1; theory
# Features of each image, the largest, by which a pair may be given up; of the strongest as many say
# far less: of 203 verified pairs of Saharov, 31 show nothing in common by them, 3 by the largest
NUM_LOOKED_AT = 2048  # measured
# Of all features, at most, so that a look takes a quarter of the comparisons; resource
SHARE_LOOKED_AT = 0.5
# Of the matches of these features, those that agree with their neighbours, below which a pair is
# given up. Of 1,090 verified pairs of ten scenes 6 have fewer, of 1,177 others 873; measured
MIN_CONSISTENT = 2


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
class ComparableFeatures:
    """Features of one image, prepared once for all comparisons."""

    descriptors: Singles  # (N, D) float32 rows of unit length
    keypoints: Floats  # (N, 2) pixel-centre px
    rivals: NeighborLists  # for each feature those too near to be its second neighbour
    coarse: nearest_8bit.CoarseDescriptors | None = None  # the descriptors in 8 bits

    @classmethod
    def of(
        cls,
        descriptors: Singles,
        keypoints: Floats,
        contrast_px: float,
        *,
        coarse: bool,
    ) -> Self:
        """Find the rivals of each feature, and round descriptors where that pays.

        Args:
            descriptors: (N, D) float32 rows of unit length.
            keypoints: (N, 2) px.
            contrast_px: Distance from which on a feature may be the second neighbour.
            coarse: Whether descriptors are compared in 8 bits at first.
        """
        rounded = nearest_8bit.CoarseDescriptors.of(descriptors) if coarse else None
        rivals = neighbors_within(keypoints, contrast_px)
        return cls(descriptors, keypoints, rivals, rounded)

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        rivals = self.rivals.starts.nbytes + self.rivals.indices.nbytes
        coarse = self.coarse.nbytes if self.coarse else 0
        own = self.descriptors.nbytes + self.keypoints.nbytes
        return own + rivals + coarse


@dataclass(frozen=True)
class LargestFeatures:
    """The features of an image by which its pairs may be given up."""

    features: ComparableFeatures
    rows: Indices  # (L,) which features of the image they are, rising
    frames: Floats  # (L, 2, 3) in pixel-centre px

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        return self.features.nbytes + self.rows.nbytes + self.frames.nbytes


@dataclass(frozen=True)
class MatchableImage:
    """One image, prepared once for all of its pairs."""

    features: ComparableFeatures
    # None where frames do not tell, or no pair is given up
    largest: LargestFeatures | None = None

    @property
    def nbytes(self) -> int:
        """Memory of all arrays."""
        largest = self.largest.nbytes if self.largest else 0
        return self.features.nbytes + largest


class NearestNeighbors:
    """Compares all descriptors, on the CPU."""

    Options = NearestOptions

    def __init__(self, options: NearestOptions, context: MatcherContext) -> None:
        self.options = options
        self.is_coarse = nearest_8bit.coarse_pays(context.num_comparisons)
        self.may_give_up = context.may_give_up

    def prepare(self, image: ImageFeatures) -> MatchableImage:
        """Prepare all features of an image, and the largest of them where pairs may be given up."""
        features = image.features
        descriptors = np.ascontiguousarray(features.descriptors, dtype=np.float32)
        prepared = self._comparable(descriptors, features.keypoints)
        if not (self.may_give_up and _frames_tell(features.lafs)):
            return MatchableImage(prepared)
        areas = np.abs(np.linalg.det(features.lafs[:, :, :2]))
        largest_first = np.argsort(-areas, kind="stable")
        num_looked_at = math.ceil(SHARE_LOOKED_AT * len(areas))
        rows = np.sort(largest_first[: min(num_looked_at, NUM_LOOKED_AT)])
        largest = LargestFeatures(
            self._comparable(descriptors[rows], features.keypoints[rows]),
            rows,
            frames=features.lafs[rows],
        )
        return MatchableImage(prepared, largest)

    def _comparable(
        self, descriptors: Singles, keypoints: Floats
    ) -> ComparableFeatures:
        return ComparableFeatures.of(
            descriptors,
            keypoints,
            self.options.min_contrast_distance_px,
            coarse=self.is_coarse,
        )

    def match(self, first: MatchableImage, second: MatchableImage) -> Matches:
        """Match two images; scores are 1 - the larger ratio of distances.

        Args:
            first: prepared image 1.
            second: prepared image 2; either may have no features.

        Returns:
            Matches, one to one: of the largest features alone where these have nothing in common.
        """
        if first.largest and second.largest:
            seen = self._match(first.largest.features, second.largest.features)
            if _shows_nothing(first.largest, second.largest, seen):
                rows1 = first.largest.rows[seen.indices[:, 0]]
                rows2 = second.largest.rows[seen.indices[:, 1]]
                return Matches(np.stack([rows1, rows2], axis=1), seen.scores)
        return self._match(first.features, second.features)

    def _match(self, first: ComparableFeatures, second: ComparableFeatures) -> Matches:
        """Match all that is given of two images."""
        if not len(first.descriptors) or not len(second.descriptors):
            return Matches.none()
        with one_openmp_thread() if self.is_coarse else nullcontext():
            indices, ratios = self._mutual(first, second)
        best_first = np.argsort(ratios, kind="stable")
        points1 = first.keypoints[indices[best_first, 0]]
        points2 = second.keypoints[indices[best_first, 1]]
        radius_px = self.options.duplicate_radius_px
        is_unique = without_duplicates(points1, points2, radius_px)
        unique = np.sort(best_first[is_unique])
        return Matches(indices[unique], 1.0 - ratios[unique])

    def _mutual(
        self, first: ComparableFeatures, second: ComparableFeatures
    ) -> tuple[Indices, Singles]:
        """Return the mutual nearest neighbours that pass the ratio test.

        Args:
            first: features of image 1.
            second: features of image 2.

        Returns:
            (K, 2) features of image 1 and 2, rising in the first column, and (K,) ratios.
        """
        options = self.options
        every = np.arange(len(first.descriptors))
        nearest2, ratios1 = _nearest(first, every, second, options.max_ratio)
        passing = np.flatnonzero(ratios1 < options.max_ratio)
        # Only features of image 2 that somebody's nearest neighbour is are compared backwards.
        targets, target_of_row = np.unique(nearest2[passing], return_inverse=True)
        limit = options.max_ratio if options.ratio_both_ways else NO_LIMIT
        nearest1, ratios2 = _nearest(second, targets, first, limit)
        ratios = ratios1[passing]
        if options.ratio_both_ways:
            ratios = np.maximum(ratios, ratios2[target_of_row])
        is_mutual = nearest1[target_of_row] == passing
        kept = is_mutual & (ratios < options.max_ratio)
        indices = np.stack([passing, targets[target_of_row]], axis=1)
        return indices[kept], ratios[kept]


def _frames_tell(lafs: Floats) -> bool:
    """Tell whether (N, 2, 3) frames differ, and were measured one by one."""
    shapes = lafs[:, :, :2].reshape(len(lafs), 4)
    keypoints = np.concatenate([lafs[:, :, 2], shapes], axis=1)
    return telling_shapes(keypoints) is not None


def _shows_nothing(
    first: LargestFeatures, second: LargestFeatures, seen: Matches
) -> bool:
    """Tell whether hardly a match of two images agrees with matches beside it."""
    frames1 = first.frames[seen.indices[:, 0]]
    frames2 = second.frames[seen.indices[:, 1]]
    return num_consistent_matches(frames1, frames2) < MIN_CONSISTENT


def _nearest(
    image1: ComparableFeatures,
    rows: Indices,
    image2: ComparableFeatures,
    max_ratio: float,
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
    queries: Singles, image: ComparableFeatures, listed: nearest_8bit.ShortList
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
    starts = _first_of_runs(listed.entry_rows)
    best_cosines = np.maximum.reduceat(cosines, starts)
    best_entries = np.flatnonzero(cosines == best_cosines[listed.entry_rows])
    first_of_row = _first_of_runs(listed.entry_rows[best_entries])
    nearest = listed.entry_columns[best_entries[first_of_row]]
    rows, rivals = image.rivals.of(nearest)
    entries = listed.entry_rows * num_features + listed.entry_columns
    cosines[_positions_in(entries, rows * num_features + rivals)] = -1.0
    second_cosines = np.maximum.reduceat(cosines, starts)
    is_doubtful = listed.is_doubtful.copy()
    is_doubtful[rows[rivals == listed.runners_up[rows]]] = True
    return nearest, distance_ratios(best_cosines, second_cosines), is_doubtful


def _first_of_runs(rising: Indices) -> Indices:
    """Return where each value of (E,) rising ones comes first."""
    is_first = np.empty(len(rising), np.bool_)
    is_first[:1] = True
    np.not_equal(rising[1:], rising[:-1], out=is_first[1:])
    return np.asarray(np.flatnonzero(is_first))


def _positions_in(rising: Indices, wanted: Indices) -> Indices:
    """Return the positions, among (E,) rising values, of the wanted ones that are there."""
    positions = np.searchsorted(rising, wanted)
    positions = np.minimum(positions, len(rising) - 1)
    return np.asarray(positions[rising[positions] == wanted])


def _listed_cosines(
    queries: Singles, descriptors: Singles, listed: nearest_8bit.ShortList
) -> Singles:
    """Return the (E,) cosines of the pairs that are listed."""
    cosines = np.empty(len(listed.entry_rows), np.float32)
    rows = listed.rows[listed.entry_rows]
    for begin in range(0, len(cosines), CHUNK_ENTRIES):
        part = slice(begin, begin + CHUNK_ENTRIES)
        query = queries.take(rows[part], axis=0)
        candidates = descriptors.take(listed.entry_columns[part], axis=0)
        cosines[part] = np.einsum("ij,ij->i", query, candidates)
    return cosines


def _nearest_of_all(
    queries: Singles, image: ComparableFeatures
) -> tuple[Indices, Singles]:
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
