"""What ties the images of a model: where one pair alone does, it should agree nearly whole."""

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import replace

import networkx as nx

from colmap_affrect.colmap import pycolmap
from colmap_affrect.geometry.arrays import rows_in
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.pair_graph import (
    MIN_SHARE,
    PairGraph,
    VerifiedPair,
    cameras_of,
    poses_of,
)

MIN_AGREEMENT_OF_TIE = 0.85
"""Share of the exact inliers of a pair that alone ties images to the others: nothing else says
where they are, so a right one agrees nearly whole."""

Ties = Mapping[frozenset[int], list[VerifiedPair]]
"""Pairs by the frames of their images: two, or one where a rig took both at once."""


def hanging_images(
    model: pycolmap.Reconstruction,
    graph: PairGraph,
    task: MappingTask,
    agreements: Mapping[tuple[int, int], float],
) -> dict[str, str]:
    """Return the names of the images that nothing ties well to the others, with the reason.

    They are the smaller part where one pair alone ties two parts, and is at odds with itself, or
    where all pairs between them disagree; of equal parts both. Pairs without which no part falls
    off confirm each other, and so do those that the graph leaves out; images of a rig that were
    taken at once hold together anyway.

    Args:
        model: which the pairs agree with or not.
        graph: its pairs.
        task: tells which matches are guided ones, which do not count.
        agreements: of all pairs inside the model, by image ids.
    """
    poses, cameras = poses_of(model), cameras_of(model)

    def exact_agreement(pair: VerifiedPair) -> float:
        guided = rows_in(pair.matches, task.guided.get(pair.ids, pair.matches[:0]))
        exact = replace(pair, matches=pair.matches[~guided])
        return graph.agreement(pair if guided.all() else exact, poses, cameras)

    frame_of = {i: model.images[i].frame_id for i in model.reg_image_ids()}
    ties: defaultdict[frozenset[int], list[VerifiedPair]] = defaultdict(list)
    for pair in graph.pairs_inside(frame_of):
        ties[frozenset(frame_of[image_id] for image_id in pair.ids)].append(pair)
    frames = _tied_frames(frame_of, graph, ties, agreements)
    for ids in list(nx.bridges(frames)):
        tie = ties.get(frozenset(ids), [])
        if len(tie) == 1 and exact_agreement(tie[0]) < MIN_AGREEMENT_OF_TIE:
            frames.remove_edge(*ids)
    parts = sorted(nx.connected_components(frames), key=len)
    part_of = {frame_id: number for number, part in enumerate(parts) for frame_id in part}
    between: defaultdict[int, list[VerifiedPair]] = defaultdict(list)
    for ids, pairs in ties.items():
        numbers = {part_of[frame_id] for frame_id in ids}
        for number in numbers if len(numbers) > 1 else ():
            between[number] += pairs
    reasons = {
        number: _reason(pairs, graph.names, exact_agreement)
        for number, pairs in between.items()
        if len(parts[number]) < len(parts[-1]) or len(parts[-2]) == len(parts[-1])
    }
    part_of_name = {graph.names[i]: part_of[frame_id] for i, frame_id in frame_of.items()}
    return {name: reasons[part] for name, part in part_of_name.items() if part in reasons}


def _tied_frames(
    frame_of: Mapping[int, int],
    graph: PairGraph,
    ties: Ties,
    agreements: Mapping[tuple[int, int], float],
) -> nx.Graph:
    """Join frames between which a pair agrees, or may agree since the graph leaves it out."""
    frames = nx.Graph()
    frames.add_nodes_from(frame_of.values())
    frames.add_edges_from(
        tuple(ids)
        for ids, pairs in ties.items()
        if len(ids) == 2 and max(agreements[pair.ids] for pair in pairs) >= MIN_SHARE
    )
    for first, second in (pair.ids for pair in graph.weak):
        if first in frame_of and second in frame_of and frame_of[first] != frame_of[second]:
            frames.add_edge(frame_of[first], frame_of[second])
    return frames


def _reason(
    pairs: list[VerifiedPair],
    names: Mapping[int, str],
    exact_agreement: Callable[[VerifiedPair], float],
) -> str:
    if len(pairs) > 1:
        return f"none of the {len(pairs)} pairs that tie it to the others agrees well"
    first, second = (names[image_id] for image_id in pairs[0].ids)
    share = f"{exact_agreement(pairs[0]):.0%}"
    return f"hangs on the pair {first} and {second} alone, of whose inliers only {share} agree"
