"""Which photographs match which: view graph and matrix of verified inliers, as parts of a page."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log, sqrt

import networkx
import numpy as np

from colmap_affrect.geometry.arrays import Array
from colmap_affrect.pairs.base import Pair
from colmap_affrect.report.pictures import base64_text

CLASS_STARTS = (1, 30, 60, 120, 240, 480)  # smallest number of inliers of each class
CLASS_COLORS = ("#e3b341", "#f08c3c", "#e2604f", "#cf4080", "#a14bb5", "#6f60dd")
"""Of few to many inliers; all stand out from white and from nearly black."""
CLASS_WIDTHS = (1.2, 2.0, 3.0, 4.2, 5.6, 7.2)  # of the edges, in units of the graph
GRAPH_SIZE = (640.0, 620.0)
MAX_NUM_THUMBNAILS = 60  # with more photographs the nodes are dots
MAX_NUM_LAID_OUT, MAX_NUM_IN_MATRIX = 300, 1000
"""With more photographs the nodes are on a circle; and there is no matrix."""
MAX_NODE, MIN_NODE, DOT = 64.0, 22.0, 9.0  # sides of nodes in units of the graph
EDGE = 3.0  # free edge of a graph, in which frames of nodes are
SPACING = 1.6  # of nodes that are thumbnails, in their sides: edges show between them
MIDDLE, GRAVITY = "", 0.1
"""A node and the weight of its edges to all others: they hold parts of the graph
together that have no edge between them."""
MAX_NUM_EDGES = 4000


def inlier_class(num_inliers: int) -> int:
    """Return the class of a number of inliers."""
    return sum(num_inliers >= start for start in CLASS_STARTS) - 1


def class_labels() -> list[str]:
    """Return the range of each class, as "1-29"."""
    ends = [f"-{start - 1}" for start in CLASS_STARTS[1:]]
    return [f"{start}{end}" for start, end in zip(CLASS_STARTS, [*ends, " or more"], strict=True)]


@dataclass(frozen=True)
class Node:
    """A photograph in a view graph; it has the same number, from 1, everywhere on the page."""

    number: int
    name: str
    state: str  # ``always``, ``sometimes`` or ``never`` registered, over the seeds
    is_wrong: bool  # registered, but at a wrong place with some seed
    text: str


@dataclass(frozen=True)
class Layout:
    """Where photographs are in all view graphs of a page, (N, 2) in ``GRAPH_SIZE``, and a side."""

    centers: Array
    node_size: float


def lay_out(names: Sequence[str], graphs: Sequence[Mapping[Pair, int]]) -> Layout:
    """Place photographs so that those which share many inliers in any graph are close."""
    count = len(names)
    size = DOT
    if count > MAX_NUM_LAID_OUT:
        turn = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
        places = np.stack([np.sin(turn), -np.cos(turn)], axis=1)
        return Layout((places + 1) / 2 * (np.array(GRAPH_SIZE) - size) + size / 2, size)
    if count <= MAX_NUM_THUMBNAILS:
        size = min(MAX_NODE, max(MIN_NODE, 0.3 * sqrt(GRAPH_SIZE[0] * GRAPH_SIZE[1] / count)))
    graph = networkx.Graph()
    graph.add_nodes_from(names)
    strongest = log(1 + max((n for pairs in graphs for n in pairs.values()), default=1))
    for pairs in graphs:
        for pair, inliers in pairs.items():
            known = graph.get_edge_data(*pair, default={"weight": 0.0})["weight"]
            graph.add_edge(*pair, weight=max(known, log(1 + inliers) / strongest))
    graph.add_weighted_edges_from((name, MIDDLE, GRAVITY) for name in names)
    places = networkx.spring_layout(graph, seed=0, iterations=200 if count < 100 else 60)
    centers = np.array([places[name] for name in names])
    room = np.array(GRAPH_SIZE) - size - 2 * EDGE
    extent = np.maximum(np.ptp(centers, axis=0), 1e-9)
    centers = (centers - centers.min(axis=0)) / extent * room + size / 2 + EDGE
    return Layout(_apart(centers, size), size)


def _apart(centers: Array, size: float) -> Array:
    """Push squares of a side apart until edges show between them, or nearly."""
    low, high = size / 2 + EDGE, np.array(GRAPH_SIZE) - size / 2 - EDGE
    rows, columns = np.triu_indices(len(centers), 1)
    spacing = SPACING if len(centers) <= MAX_NUM_THUMBNAILS else 1.0
    for _ in range(200):
        offsets = centers[columns] - centers[rows]
        gaps = spacing * size - np.abs(offsets).max(axis=1)
        close = gaps > 0
        if not close.any():
            break
        lengths = np.maximum(np.linalg.norm(offsets[close], axis=1), 1e-6)
        push = offsets[close] / lengths[:, None] * (gaps[close, None] / 2 + 1e-3)
        moved = centers.copy()
        np.add.at(moved, columns[close], push)
        np.add.at(moved, rows[close], -push)
        centers = np.clip(moved, low, high)
    return centers


def edge_paths(
    names: Sequence[str], layout: Layout, pair_inliers: Mapping[Pair, int]
) -> list[tuple[str, str]]:
    """Return (class of CSS, SVG path of its edges), few inliers first; ``MAX_NUM_EDGES`` in all."""
    index = {name: number for number, name in enumerate(names)}
    parts: dict[int, list[str]] = {}
    strongest = sorted(pair_inliers, key=lambda pair: -pair_inliers[pair])[:MAX_NUM_EDGES]
    for name1, name2 in strongest:
        (x1, y1), (x2, y2) = layout.centers[[index[name1], index[name2]]]
        line = f"M{x1:.0f} {y1:.0f}L{x2:.0f} {y2:.0f}"
        parts.setdefault(inlier_class(pair_inliers[name1, name2]), []).append(line)
    return [(f"i{number}", "".join(parts[number])) for number in sorted(parts)]


def matrix(names: Sequence[str], pair_inliers: Mapping[Pair, int]) -> str:
    """Return the symmetric (N, N) uint16 inliers of pairs, row by row, as base64."""
    if len(names) > MAX_NUM_IN_MATRIX:
        return ""
    index = {name: number for number, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)), dtype="<u2")
    for (name1, name2), inliers in pair_inliers.items():
        row, column = index[name1], index[name2]
        counts[row, column] = counts[column, row] = min(inliers, np.iinfo(np.uint16).max)
    return base64_text(counts.tobytes())
