"""Mutual nearest neighbours with a geometrically consistent ratio test (FGINN).

The second neighbour of the ratio test is the nearest descriptor that lies at least
``min_contrast_distance_px`` away from the first one (Mishkin, Matas, Perdoch, MODS, 2015):
features of several warps at one location do not reject each other. Exact: every distance
is computed, in chunks of bounded memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.geometry.neighbors import NeighborLists, neighbors_within
from colmap_affrect.options import MatchingOptions

CHUNK_ELEMENTS = 1 << 24
"""Similarities held at once: 64 MiB of float32."""

ROUNDING = np.float32(1e-6)
"""Similarities closer to 1 than this are equal: two copies of a descriptor have ratio 1."""


@dataclass(frozen=True)
class MatchableImage:
    """What matching needs of one image, prepared once for all of its pairs.

    Attributes:
        descriptors: (N, D) float32 rows of unit length.
        keypoints: (N, 2) pixel-centre px.
        rivals: for each feature those too close to serve as its second neighbour.
    """

    descriptors: NDArray[np.float32]
    keypoints: NDArray[np.floating]
    rivals: NeighborLists


@dataclass(frozen=True)
class PutativeMatches:
    """Matches before geometric verification.

    Attributes:
        indices: (M, 2) int64 feature indices in image 1 and 2, by row of image 1.
        ratios: (M,) float32 larger of the two distance ratios, smaller is better.
    """

    indices: NDArray[np.int64]
    ratios: NDArray[np.float32]


def matchable(
    descriptors: NDArray[np.floating], keypoints: NDArray[np.floating], options: MatchingOptions
) -> MatchableImage:
    """Prepare the features of one image for matching."""
    return MatchableImage(
        np.ascontiguousarray(descriptors, dtype=np.float32),
        keypoints,
        neighbors_within(keypoints, options.min_contrast_distance_px),
    )


def match_features(
    image1: MatchableImage, image2: MatchableImage, options: MatchingOptions
) -> PutativeMatches:
    """Match two images; see the module docstring. Either may have no features."""
    if not len(image1.descriptors) or not len(image2.descriptors):
        return PutativeMatches(np.zeros((0, 2), np.int64), np.zeros(0, np.float32))
    forward, ratios = _nearest(image1.descriptors, image2)
    rows = np.flatnonzero(ratios < options.max_ratio)
    targets, back = np.unique(forward[rows], return_inverse=True)
    backward, back_ratios = _nearest(image2.descriptors[targets], image1)
    mutual = backward[back] == rows
    worst = ratios[rows]
    if options.ratio_both_ways:
        worst = np.maximum(worst, back_ratios[back])
    keep = mutual & (worst < options.max_ratio)
    matches = PutativeMatches(np.stack([rows, targets[back]], axis=1)[keep], worst[keep])
    return _without_duplicates(matches, image1, image2, options.duplicate_radius_px)


def _nearest(
    queries: NDArray[np.float32], image: MatchableImage
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
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
        rows, rivals = image.rivals.of(best)
        similarity[rows, rivals] = -1.0
        second = similarity.max(axis=1)
        nearest[begin : begin + step] = best
        ratios[begin : begin + step] = np.sqrt(
            np.maximum(1.0 - first, ROUNDING) / np.maximum(1.0 - second, ROUNDING)
        )
    return nearest, ratios


def _without_duplicates(
    matches: PutativeMatches, image1: MatchableImage, image2: MatchableImage, radius_px: float
) -> PutativeMatches:
    """Drop matches that have a better one within ``radius_px`` at both ends."""
    order = np.argsort(matches.ratios, kind="stable")
    points1 = image1.keypoints[matches.indices[order, 0]]
    points2 = image2.keypoints[matches.indices[order, 1]]
    close = neighbors_within(points1, radius_px)
    rows, others = close.of(np.arange(len(order)))
    near = ((points2[rows] - points2[others]) ** 2).sum(axis=1) <= radius_px**2
    keep = np.ones(len(order), dtype=bool)
    for row, other in zip(
        rows[near & (others < rows)], others[near & (others < rows)], strict=True
    ):
        if keep[other]:
            keep[row] = False
    kept = np.sort(order[keep])
    return PutativeMatches(matches.indices[kept], matches.ratios[kept])
