"""Which images verified pairs connect, and how well: parts, lone ties, tracks."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import TypeVar

import numpy as np

from colmap_affrect.geometry.arrays import Indices

T = TypeVar("T", int, str)


def connected_parts(
    pairs: Iterable[tuple[T, T]], images: Iterable[T] = ()
) -> list[set[T]]:
    """Return the images that pairs connect, largest part first; of ``images`` also lone ones."""
    partners = dict[T, list[T]]()
    for image in images:
        partners.setdefault(image, [])
    for first, second in pairs:
        partners.setdefault(first, []).append(second)
        partners.setdefault(second, []).append(first)
    parts = list[set[T]]()
    known = set[T]()
    for image in partners:
        if image not in known:
            part = _reached_from(image, partners)
            known |= part
            parts.append(part)
    return sorted(parts, key=lambda part: (-len(part), min(part)))


def _reached_from(image: T, partners: Mapping[T, Iterable[T]]) -> set[T]:
    """Return an image and all that pairs connect with it."""
    # networkx, which has this, takes as long to load as numpy and OpenCV together.
    reached = {image}
    waiting = [image]
    for one in waiting:
        for partner in partners[one]:
            if partner not in reached:
                reached.add(partner)
                waiting.append(partner)
    return reached


def lone_ties(pairs: Iterable[tuple[T, T]]) -> list[tuple[T, T]]:
    """Return, smaller image first, the pairs that alone tie two parts of two images or more."""
    listed = list(pairs)
    partners = defaultdict[T, set[T]](set)
    for first, second in listed:
        partners[first].add(second)
        partners[second].add(first)
    if not any(
        partners[first].isdisjoint(partners[second]) for first, second in listed
    ):
        return []  # a third image ties each pair, too
    import networkx

    graph: networkx.Graph[T] = networkx.Graph()
    graph.add_edges_from(listed)
    return [
        (min(first, second), max(first, second))
        for first, second in networkx.bridges(graph)
        if len(partners[first]) > 1 and len(partners[second]) > 1
    ]


def num_in_tracks(matches: Mapping[tuple[T, T], Indices]) -> dict[T, int]:
    """Return how many features of each image, of (M, 2) by pair, are in tracks of three or more."""
    images = sorted(set(chain.from_iterable(matches)))
    number = {image: index for index, image in enumerate(images)}
    ends = [np.zeros(0, np.int64)]  # features of first images, then of second ones
    for side in (0, 1):
        for pair, indices in matches.items():
            ends.append((number[pair[side]] << 32) + indices[:, side])
    features, index, num_matches = np.unique(
        np.concatenate(ends), return_inverse=True, return_counts=True
    )
    first, second = index.reshape(2, -1)
    is_shared = num_matches > 1
    in_track = is_shared.copy()
    in_track[first[is_shared[second]]] = True
    in_track[second[is_shared[first]]] = True
    counts = np.bincount(features[in_track] >> 32, minlength=len(images)).tolist()
    return dict(zip(images, counts, strict=True))


def weakly_connected_images(
    matches: Mapping[tuple[str, str], Indices], min_num_features: int
) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    Mappers register images by features that two others have triangulated already.
    """
    counts = num_in_tracks(matches)
    return {name for name, count in counts.items() if count < min_num_features}
