"""Which images verified pairs connect, and how well: parts, lone ties, tracks."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from itertools import chain
from typing import TypeVar

import numpy as np

from colmap_affrect.geometry.arrays import Bools, Indices

T = TypeVar("T", int, str)


def connected_parts(
    pairs: Iterable[tuple[T, T]], images: Iterable[T] = ()
) -> list[set[T]]:
    """Return the images that pairs connect, largest part first; of ``images`` also lone ones."""
    listed = list(pairs)
    partners = {image: {image} for image in images}
    for first, second in listed:
        partners.setdefault(first, {first}).add(second)
        partners.setdefault(second, {second}).add(first)
    if not partners:
        return []
    first_part = _tied_to(next(iter(partners)), partners)
    if len(first_part) == len(partners):
        return [first_part]  # which is so most often
    import networkx  # which takes as long to load as numpy and OpenCV together

    graph: networkx.Graph[T] = networkx.Graph()
    graph.add_nodes_from(partners)
    graph.add_edges_from(listed)
    return sorted(
        networkx.connected_components(graph), key=lambda part: (-len(part), min(part))
    )


def _tied_to(image: T, partners: Mapping[T, set[T]]) -> set[T]:
    """Return the images that pairs connect with one, itself among them."""
    found = {image}
    new = [image]
    while new:
        added = partners[new.pop()] - found
        found |= added
        new.extend(added)
    return found


def lone_ties(pairs: Iterable[tuple[T, T]]) -> list[tuple[T, T]]:
    """Return, smaller image first, the pairs that alone tie two parts of two images or more."""
    listed = list(pairs)
    partners = defaultdict[T, set[T]](set)
    for first, second in listed:
        partners[first].add(second)
        partners[second].add(first)
    between_parts = list[tuple[T, T]]()
    for first, second in listed:
        if len(partners[first]) > 1 and len(partners[second]) > 1:
            between_parts.append((first, second))
    if all(_is_tied_otherwise(*pair, partners) for pair in between_parts):
        return []
    import networkx

    graph: networkx.Graph[T] = networkx.Graph()
    graph.add_edges_from(listed)
    found = list[tuple[T, T]]()
    for first, second in networkx.bridges(graph):
        if len(partners[first]) > 1 and len(partners[second]) > 1:
            found.append((min(first, second), max(first, second)))
    return found


def _is_tied_otherwise(first: T, second: T, partners: Mapping[T, set[T]]) -> bool:
    """Tell whether a third image ties two images, too, or a third and a fourth one.

    Args:
        first: Of the images.
        second: The other one.
        partners: Of each image those that it is tied to.
    """
    if not partners[first].isdisjoint(partners[second]):
        return True
    others = partners[second] - {first}
    thirds = partners[first] - {second}
    return any(not others.isdisjoint(partners[third]) for third in thirds)


def num_in_tracks(matches: Mapping[tuple[T, T], Indices]) -> dict[T, int]:
    """Return how many features of each image, of (M, 2) by pair, are in tracks of three or more."""
    images = sorted(set(chain.from_iterable(matches)))
    num_features = dict.fromkeys(images, 0)  # as far as they have matches
    for pair, indices in matches.items():
        for image, features in zip(pair, indices.T, strict=True):
            most = int(features.max(initial=-1)) + 1
            num_features[image] = max(num_features[image], most)
    # Features of all images are numbered one after the other.
    starts = _sums_before(np.array(list(num_features.values()), np.int64))
    start_of = dict(zip(images, starts.tolist(), strict=False))
    ends = [np.zeros((0, 2), np.int64)]
    for pair, indices in matches.items():
        ends.append(indices + np.array([start_of[image] for image in pair]))
    first, second = np.concatenate(ends).T
    num_all = int(starts[-1])
    num_matches = np.bincount(first, minlength=num_all)
    num_matches += np.bincount(second, minlength=num_all)
    has_two_matches = num_matches > 1
    in_track = has_two_matches.copy()
    in_track[first[has_two_matches[second]]] = True
    in_track[second[has_two_matches[first]]] = True
    counts = np.diff(_sums_before(in_track)[starts]).tolist()
    return dict(zip(images, counts, strict=True))


def _sums_before(values: Indices | Bools) -> Indices:
    """Return the (N + 1,) sums of all values before each of N, and of all."""
    sums = np.zeros(len(values) + 1, np.int64)
    np.cumsum(values, out=sums[1:])
    return sums


def weakly_connected_images(
    matches: Mapping[tuple[str, str], Indices], min_num_features: int
) -> set[str]:
    """Return the images with fewer features than that in tracks through three images or more.

    Mappers register images by features that two others have triangulated already.
    """
    counts = num_in_tracks(matches)
    return {name for name, count in counts.items() if count < min_num_features}
