"""Photographs of one view: prints of one negative, or taken from one place.

What they have in common tells no depth, and neither confirms the other.
"""

from functools import lru_cache
from pathlib import Path

from colmap_affrect.errors import ImageError
from colmap_affrect.geometry.parallax import correlation, same_view_homography
from colmap_affrect.images.reading import read_gray
from colmap_affrect.mappers.pair_graph import Ids, PairGraph

MIN_CORRELATION = 0.65  # of what is where: photographs of one thing from nearby have up to 0.57
MAX_PAIRS = 1000  # looked at, all of 45 photographs; of more some are missed


@lru_cache(maxsize=1)
def one_views(graph: PairGraph, image_path: Path | None) -> frozenset[Ids]:
    """Return the pairs of a graph that show one view, by the photographs below a folder."""
    found = set[Ids]()
    if image_path is None:
        return frozenset()
    for pair in graph.pairs[:: -(-len(graph.pairs) // MAX_PAIRS) or 1]:
        points1, points2 = graph.points(pair)
        homography = same_view_homography(points1, points2, graph.sizes(pair.ids))
        if homography is None:
            continue
        try:
            first, second = (read_gray(image_path / graph.names[i]) for i in pair.ids)
        except ImageError:
            continue
        if correlation(first, second, homography) >= MIN_CORRELATION:
            found.add(pair.ids)
    return frozenset(found)
