"""Moves: which pairs the next models are made of.

The search tries them one after the other and keeps the model with most evidence. A move is a
function of what is known so far, and has one line in :data:`MOVES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.loops import contradicting_pairs
from colmap_affrect.mappers.pair_graph import Ids, PairGraph

Reduction = Callable[[PairGraph], PairGraph]


@dataclass(frozen=True)
class State:
    """What a move begins with.

    Attributes:
        graph: all pairs.
        measured: (M, 2) inliers of measured frames, of pairs that have others, too.
        random_seed: of what is drawn.
        model: the best one so far.
    """

    graph: PairGraph
    measured: Mapping[Ids, NDArray[np.int64]]
    random_seed: int
    model: pycolmap.Reconstruction | None


def measured_frames(state: State) -> Reduction | None:
    """Take the matches of measured frames only, where there are others.

    These are less exact, and verify sides of a thing that look the same.
    """
    return (lambda graph: graph.with_inliers(state.measured)) if state.measured else None


def measured_pairs(state: State) -> Reduction | None:
    """Take all matches of the pairs that those of measured frames verify."""
    others = {ids for ids, inliers in state.measured.items() if not len(inliers)}
    return (lambda graph: graph.without(others)) if others else None


def all_pairs(_: State) -> Reduction:
    """Take everything."""
    return lambda graph: graph


def consistent_loops(state: State) -> Reduction | None:
    """Leave out the pairs whose rotations contradict the loops that they are in."""
    wrong = contradicting_pairs(state.graph, state.random_seed)
    return (lambda graph: graph.without(wrong)) if wrong else None


def consistent_model(state: State) -> Reduction | None:
    """Leave out the pairs that contradict the best model, if it lacks images."""
    if not state.model or state.model.num_reg_images() == len(state.graph.keypoints):
        return None
    wrong = state.graph.contradicted(state.model)
    return (lambda graph: graph.without(wrong)) if wrong else None


MOVES: Mapping[str, Callable[[State], Reduction | None]] = {
    "with the matches of measured frames": measured_frames,
    "with the pairs of measured frames": measured_pairs,
    "with all pairs": all_pairs,
    "without pairs that contradict loops": consistent_loops,
    "without pairs that contradict the model": consistent_model,
}
"""In the order in which they are tried, by what a report calls them."""
