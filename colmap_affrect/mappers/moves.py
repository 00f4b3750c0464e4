"""Moves: which pairs the next models are made of.

The sparse mapper tries them one after the other and keeps the model with most evidence. A move is a
function of all pairs and of the inliers of measured frames, by pair, and has one line in
:data:`MOVES`. It returns None where there is nothing to try.
"""

from collections.abc import Callable, Mapping

from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.mappers.pair_graph import Ids, PairGraph

Measured = Mapping[Ids, Indices]
"""(M, 2) inliers of measured frames, of pairs that have others, too."""


def measured_frames(graph: PairGraph, measured: Measured) -> PairGraph | None:
    """Take the matches of measured frames only, where there are others.

    These are less exact, and verify sides of a thing that look the same.
    """
    return graph.with_inliers(measured) if measured else None


def measured_pairs(graph: PairGraph, measured: Measured) -> PairGraph | None:
    """Take all matches of the pairs that those of measured frames verify."""
    others = {ids for ids, inliers in measured.items() if not len(inliers)}
    return graph.without(others) if others else None


def all_pairs(graph: PairGraph, _: Measured) -> PairGraph:
    """Take everything."""
    return graph


MOVES: Mapping[str, Callable[[PairGraph, Measured], PairGraph | None]] = {
    "with the matches of measured frames": measured_frames,
    "with the pairs of measured frames": measured_pairs,
    "with all pairs": all_pairs,
}
"""In the order in which they are tried, by what a report calls them."""
