"""Some of the matches, which tell poses as well as all of them do.

Mapping with a part of the tracks takes a fraction of the time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from colmap_affrect.geometry.arrays import Bools, Indices

NUM_TRACKS = 500  # kept of each image (resource: poses are as good as with all)
NUM_MATCHES_OF_PAIR = 100  # kept of each pair at least (resource)
# Of the features that are kept, from which on it saves little (resource)
MAX_SHARE = 0.5
# The same of large sets, whose models are adjusted with all tracks in the end
NUM_TRACKS_OF_LARGE = 200  # of each image (resource: poses are near enough for that)
NUM_MATCHES_OF_PAIR_OF_LARGE = 50  # of each pair at least (resource)
MAX_SHARE_OF_LARGE = 0.8  # of the features that are kept (resource)


@dataclass(frozen=True)
class Thinning:
    """How many tracks are kept."""

    num_tracks: int = NUM_TRACKS  # of each image
    num_matches_of_pair: int = NUM_MATCHES_OF_PAIR  # of each pair at least
    max_share: float = MAX_SHARE
    """Of the features that are kept: where more would be, nothing is left out."""


OF_SMALL_SETS = Thinning()
OF_LARGE_SETS = Thinning(
    num_tracks=NUM_TRACKS_OF_LARGE,
    num_matches_of_pair=NUM_MATCHES_OF_PAIR_OF_LARGE,
    max_share=MAX_SHARE_OF_LARGE,
)


@dataclass(frozen=True)
class BestTracks:
    """Which matches the best tracks have."""

    is_kept: list[Bools]  # for each pair which of its matches are kept, (M,)
    share_of_features: (
        float  # kept of all that have matches: what adjustments take time for
    )


def matches_of_best_tracks(
    pairs: Sequence[tuple[tuple[int, int], Indices]],
    num_keypoints: Mapping[int, int],
    thinning: Thinning = OF_SMALL_SETS,
) -> BestTracks:
    """Choose the matches of the best tracks of each image and of each pair.

    Tracks of most images come first, those with two features of one image last, others by chance.

    Args:
        pairs: Image ids, and (M, 2) features that match.
        num_keypoints: Number of features by image id.
        thinning: How many are kept.

    Returns:
        Their matches.
    """
    if not pairs:
        return BestTracks([], share_of_features=1.0)
    # Features of all images are numbered one after the other; a track has its lowest number.
    image_ids = sorted(num_keypoints)
    counts = [num_keypoints[image_id] for image_id in image_ids]
    num_all = sum(counts)
    matches = _numbered_through(pairs, image_ids, counts)
    edges = np.concatenate(matches)
    track_of = _connected_components(edges, num_all)
    image_of = np.repeat(np.arange(len(image_ids)), counts)
    matched = np.unique(edges)
    views = np.unique(track_of[matched] * len(image_ids) + image_of[matched])
    tracks, images = np.divmod(views, len(image_ids))
    num_features = np.bincount(track_of[matched], minlength=num_all)
    num_images = np.bincount(tracks, minlength=num_all)
    ranks = _ranks(num_features, num_images)
    is_kept = np.zeros(num_all, bool)
    # Tracks by image, and those of one image by their numbers
    by_image = tracks[np.argsort(images, kind="stable")]
    ends = np.cumsum(np.bincount(images, minlength=len(image_ids)))
    for tracks_of_image in np.split(by_image, ends[:-1]):
        is_kept[_best(tracks_of_image, ranks, thinning.num_tracks)] = True
    tracks_of_pairs = [track_of[of_pair[:, 0]] for of_pair in matches]
    for tracks_of_pair in tracks_of_pairs:
        is_kept[_best(tracks_of_pair, ranks, thinning.num_matches_of_pair)] = True
    return BestTracks(
        is_kept=[is_kept[tracks_of_pair] for tracks_of_pair in tracks_of_pairs],
        share_of_features=float(is_kept[track_of[matched]].mean()),
    )


def _numbered_through(
    pairs: Sequence[tuple[tuple[int, int], Indices]],
    image_ids: Sequence[int],
    counts: Sequence[int],
) -> list[Indices]:
    """Return the matches of pairs by numbers that tell the features of all images apart.

    Args:
        pairs: Image ids, and (M, 2) features that match.
        image_ids: Of all images, in the order in which their features are numbered.
        counts: Numbers of features of these images.

    Returns:
        (M, 2) numbers for each pair.
    """
    first_numbers = np.cumsum([0, *counts[:-1]])
    first_of = dict(zip(image_ids, first_numbers, strict=True))
    found = list[Indices]()
    for (first, second), matches in pairs:
        found.append(matches + np.array([first_of[first], first_of[second]]))
    return found


def _connected_components(edges: Indices, num_nodes: int) -> Indices:
    """Return the lowest node that edges connect with each node, (num_nodes,).

    Args:
        edges: (E, 2) nodes.
        num_nodes: Nodes are 0 to this number.
    """
    lowest = np.arange(num_nodes)
    has_changed = True
    while has_changed:
        before = lowest.copy()
        of_edges = lowest[edges].min(axis=1)
        np.minimum.at(lowest, edges[:, 0], of_edges)
        np.minimum.at(lowest, edges[:, 1], of_edges)
        lowest = lowest[lowest]
        has_changed = not np.array_equal(lowest, before)
    return lowest


def _ranks(num_features: Indices, num_images: Indices) -> Indices:
    """Return the position of each track in the order of choice, 0 for the best, (T,).

    Args:
        num_features: Features of each track, (T,).
        num_images: Images that these are of, (T,).
    """
    is_ambiguous = num_features > num_images
    # The seed is fixed: what is left out does not depend on the seed of mapping.
    by_chance = np.random.default_rng(0).random(len(num_images))
    order = np.lexsort((by_chance, -num_images, is_ambiguous))
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order))
    return ranks


def _best(tracks: Indices, ranks: Indices, number: int) -> Indices:
    """Return the tracks with the lowest ranks."""
    return tracks[np.argsort(ranks[tracks])[:number]]
