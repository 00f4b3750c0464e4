"""Loops of verified pairs: rotations around a loop must multiply to the identity.

Repeated structure gives wrong pairs that no test of two views finds, and a plane seen twice
allows two relative poses. Both show in the loops that they stand in: rotations that are averaged
robustly over the whole graph follow the majority.
"""

from collections.abc import Iterable, Mapping
from functools import lru_cache

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.pair_graph import Ids, PairGraph, RelativePose

MAX_ERROR_DEG = 10.0
"""A relative rotation farther from the averaged ones is wrong. Of right pairs with guessed focal
lengths it is a few degrees, of repeated structure mostly more than 50."""

MAX_ROUNDS = 3
"""How often rotations are averaged again after other poses of pairs have been chosen."""


@lru_cache(maxsize=1)
def contradicting_pairs(graph: PairGraph, random_seed: int) -> frozenset[Ids]:
    """Return the pairs that contradict others, and without which their images are still tied.

    The rotations of all pairs are averaged; none of the relative poses of such a pair fits them.
    """
    poses = {
        pair.ids: graph.relative_poses(pair, graph.cameras, random_seed) for pair in graph.pairs
    }
    poses = {ids: found for ids, found in poses.items() if found}
    weights = {pair.ids: len(pair.matches) for pair in graph.pairs}
    errors: dict[Ids, float] = {}
    for _ in range(MAX_ROUNDS):
        rotations = _averaged(poses, weights, graph.cache, random_seed)
        chosen = {}
        for ids, found in poses.items():
            rounded = [round(_error_deg(ids, one, rotations)) for one in found]
            chosen[ids] = [found[i] for i in np.argsort(rounded, kind="stable")]  # ties stay
        errors = {ids: _error_deg(ids, found[0], rotations) for ids, found in chosen.items()}
        changed = any(chosen[ids][0] is not poses[ids][0] for ids in poses)
        poses = chosen
        if not changed:
            break
    wrong = [ids for ids in errors if errors[ids] > MAX_ERROR_DEG]
    return frozenset(dispensable(sorted(wrong, key=lambda ids: -errors[ids]), weights))


def _averaged(
    poses: Mapping[Ids, list[RelativePose]],
    weights: Mapping[Ids, int],
    cache: pycolmap.DatabaseCache,
    random_seed: int,
) -> dict[int, NDArray[np.float64]]:
    """Return a rotation for each image, one connected part of the graph after the other."""
    rotations: dict[int, NDArray[np.float64]] = {}
    left = dict(poses)
    options = pycolmap.RotationEstimatorOptions(random_seed=max(random_seed, 0))
    while left:
        model, edges = pycolmap.Reconstruction(), pycolmap.PoseGraph()
        model.load(cache)
        for ids, found in left.items():
            edge = pycolmap.PoseGraphEdge(pycolmap.Rigid3d(np.column_stack(found[0].pose)))
            edge.num_matches = weights[ids]
            edges.add_edge(*ids, edge)
        if not pycolmap.run_rotation_averaging(options, edges, model, []):
            break
        new = {i: model.images[i].cam_from_world().matrix()[:, :3] for i in model.reg_image_ids()}
        rotations |= new
        left = {ids: found for ids, found in left.items() if not new.keys() & set(ids)}
        if not new:
            break
    return rotations


def _error_deg(
    ids: Ids, relative: RelativePose, rotations: Mapping[int, NDArray[np.float64]]
) -> float:
    if not rotations.keys() >= set(ids):
        return 0.0
    averaged = rotations[ids[1]] @ rotations[ids[0]].T
    cosine = (np.trace(averaged @ relative.pose[0].T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def dispensable(wrong: Iterable[Ids], weights: Mapping[Ids, int]) -> list[Ids]:
    """Return the wrong pairs without which their images are still tied to each other.

    Where these hang on single pairs else, the loop says no more than that one of them is wrong: the
    weakest goes.
    """
    graph, dropped = nx.Graph(), []
    graph.add_edges_from(weights)
    for ids in wrong:
        if not graph.has_edge(*ids):
            continue
        graph.remove_edge(*ids)
        if not nx.has_path(graph, *ids):
            graph.add_edge(*ids)
            continue
        single = set(map(frozenset, nx.bridges(graph)))
        path = nx.utils.pairwise(nx.shortest_path(graph, *ids))
        hanging = [(min(edge), max(edge)) for edge in path if frozenset(edge) in single]
        weakest = min([ids, *hanging], key=weights.__getitem__)
        if weakest != ids:
            graph.add_edge(*ids)
            graph.remove_edge(*weakest)
        dropped.append(weakest)
    return dropped
