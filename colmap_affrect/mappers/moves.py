"""Moves: which pairs the next models are made of.

The sparse mapper tries them one after the other and keeps the model with most evidence. A move is a
function of all pairs and of the ids of those that only unmeasured frames verify, and has one line
in :data:`MOVES`. It returns None where there is nothing to try.
"""

from collections.abc import Callable, Mapping, Set

from colmap_affrect.mappers.pair_graph import Ids, PairGraph


def measured_pairs(graph: PairGraph, unmeasured: Set[Ids]) -> PairGraph | None:
    """Take the pairs that measured frames verify, where there are others.

    Others also verify sides of a thing that look the same.
    """
    return graph.without(unmeasured) if unmeasured else None


def all_pairs(graph: PairGraph, _: Set[Ids]) -> PairGraph:
    """Take everything."""
    return graph


MOVES: Mapping[str, Callable[[PairGraph, Set[Ids]], PairGraph | None]] = {
    "with the pairs of measured frames": measured_pairs,
    "with all pairs": all_pairs,
}
"""In the order in which they are tried, by what a report calls them."""
