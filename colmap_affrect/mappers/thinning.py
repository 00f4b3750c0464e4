"""Some of the matches, which tell poses as well as all of them do."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

NUM_TRACKS, NUM_MATCHES_OF_PAIR = 500, 100  # kept, of an image, and of a pair at least


def matches_of_best_tracks(
    pairs: Sequence[tuple[tuple[int, int], NDArray[np.int64]]], num_keypoints: Mapping[int, int]
) -> list[NDArray[np.bool_]]:
    """Return for each pair, of image ids and (M, 2) features, which of its matches are kept, (M,).

    Tracks of most images come first, those with two features of one image last, others by chance.
    ``num_keypoints`` is by image id.
    """
    if not pairs:
        return []
    ids = sorted(num_keypoints)
    starts = dict(zip(ids, np.cumsum([0, *(num_keypoints[i] for i in ids)]), strict=False))
    total = sum(num_keypoints.values())
    matches = [features + [starts[i] for i in pair] for pair, features in pairs]
    edges = np.concatenate(matches)
    track_of = np.arange(total)
    while True:  # the lowest number in reach becomes that of the track
        before = track_of.copy()
        lowest = track_of[edges].min(axis=1)
        np.minimum.at(track_of, edges[:, 0], lowest)
        np.minimum.at(track_of, edges[:, 1], lowest)
        track_of = track_of[track_of]
        if np.array_equal(track_of, before):
            break
    image_of = np.repeat(np.arange(len(ids)), [num_keypoints[i] for i in ids])
    nodes = np.unique(edges)
    sizes = np.bincount(track_of[nodes], minlength=total)
    both = np.unique(np.stack([track_of[nodes], image_of[nodes]]), axis=1)
    num_images = np.bincount(both[0], minlength=total)
    order = np.lexsort((np.random.default_rng(0).random(total), -num_images, sizes > num_images))
    rank = np.empty(total, np.int64)
    rank[order] = np.arange(total)
    kept = np.zeros(total, bool)
    for index in range(len(ids)):
        tracks = both[0][both[1] == index]
        kept[tracks[np.argsort(rank[tracks])[:NUM_TRACKS]]] = True
    of_pairs = [track_of[nodes_of_pair[:, 0]] for nodes_of_pair in matches]
    for tracks in of_pairs:
        kept[tracks[np.argsort(rank[tracks])[:NUM_MATCHES_OF_PAIR]]] = True
    return [kept[tracks] for tracks in of_pairs]
