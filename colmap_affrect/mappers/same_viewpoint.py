"""Photographs from the same viewpoint: prints of one negative, or taken from one place.

What they have in common tells no depth, and neither confirms the pose of the other.
"""

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from colmap_affrect.colmap.connections import connected_parts
from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.arrays import sampling_step
from colmap_affrect.geometry.parallax import correlation, same_view_homography
from colmap_affrect.images.reading import read_gray
from colmap_affrect.mappers.pair_graph import Ids, PairGraph

MIN_CORRELATION = 0.65
"""Of two photographs, one warped onto the other; measured: photographs of one thing from nearby
have up to 0.57."""
# Of a graph that are looked at, all of 45 photographs; of more some are missed; resource
MAX_PAIRS = 1000


@lru_cache(maxsize=1)
def same_viewpoint_pairs(graph: PairGraph, image_path: Path | None) -> frozenset[Ids]:
    """Return the pairs of a graph whose photographs, below a folder, show the same view."""
    if image_path is None:
        return frozenset()
    found = set[Ids]()
    step = sampling_step(len(graph.pairs), MAX_PAIRS)
    for pair in graph.pairs[::step]:
        points1, points2 = graph.points(pair)
        homography = same_view_homography(points1, points2, graph.sizes(pair.ids))
        if homography is None:
            continue
        first, second = pair.ids
        try:
            image1 = read_gray(image_path / graph.names[first])
            image2 = read_gray(image_path / graph.names[second])
        except ImageError:
            continue
        if correlation(image1, image2, homography) >= MIN_CORRELATION:
            found.add(pair.ids)
    return frozenset(found)


def viewpoints(pairs: Iterable[Ids]) -> dict[int, int]:
    """Return the viewpoints of images: of each the lowest id of those from the same one.

    Images from the same viewpoint as a third one are from the same viewpoint, too.

    Args:
        pairs: Pairs from the same viewpoint.

    Returns:
        By id of the images of these pairs.
    """
    viewpoint_of = dict[int, int]()
    for images in connected_parts(pairs):
        viewpoint_of |= dict.fromkeys(images, min(images))
    return viewpoint_of
