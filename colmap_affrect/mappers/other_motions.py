"""Whether something moves as one between photographs, against what their model says: ice, a crowd.

A surface that moves has consistent matches, which contradict those of all that stays. Nothing in
photographs tells which of both is the scene: the smaller a motion is, the less likely. Repeated
structure has consistent matches that contradict a model, too, but other ones in each pair; what
moves is the same surface again and again.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.model_files import relative_pose
from colmap_affrect.colmap.verification import (
    Side,
    VerificationOptions,
    estimate_geometry,
    num_consistent_keypoints,
)
from colmap_affrect.geometry.arrays import Array, Indices
from colmap_affrect.mappers.model_score import GRID, grid_cells
from colmap_affrect.mappers.pair_graph import (
    CameraById,
    PairGraph,
    PoseById,
    VerifiedPair,
    cameras_of,
    compared_with_pose,
    poses_of,
    strongest_of_images,
)
from colmap_affrect.parallel.executor import available_cores, map_ordered

NUM_PAIRS = 6  # the strongest of each image that are looked at; resource
MAX_NUM_PAIRS = 300  # of a model that are looked at, the strongest; resource
FARTHER = 1.5
"""Times the tolerance of matches that agree, from which on they contradict: between are those of
poses and lenses that are not quite right (judged)."""
MIN_CHAINED = 1.0 / 3.0
"""Of the matches of another motion, the share that moves in another pair, too. Measured: 0.4 to
0.95 of surfaces that were made to move, up to 0.2 of repeated windows and of wrong matches."""
MIN_CELLS = 6
"""Cells of another motion, a tenth of a photograph: lenses and poses that are a little off leave
less, 1 to 5 of old prints (measured)."""
MIN_SHOWING = 0.2
"""Share of the pairs of a model that show another motion, where something moves: a quarter and more
where surfaces were made to move, none of others (measured)."""
MIN_NUM_SHOWING = 2  # of pairs: what one alone shows, nothing confirms; theory

Features = Counter[tuple[int, int]]  # numbers of pairs, by image id and feature


@dataclass(frozen=True)
class _Motions:
    """What of a pair moves as its model says, and what as one in another way."""

    pair: VerifiedPair
    sides: tuple[Side, Side]
    own: Indices  # (M, 2) matches
    other: Indices  # (K, 2) matches

    def cells(self) -> Array:
        """Return the numbers of cells that each of both has, the mean of both images.

        A cell belongs to the motion with more matches in it.
        """
        counts = []
        for index, side in enumerate(self.sides):
            num_own = _in_cells(side, self.own[:, index])
            num_other = _in_cells(side, self.other[:, index])
            is_other = num_other > num_own
            is_own = (num_own > 0) & ~is_other
            counts.append([is_own.sum(), is_other.sum()])
        return np.asarray(np.mean(counts, axis=0))

    def is_large(self) -> bool:
        """Tell whether more moves in another way than lenses and poses that are a little off."""
        return bool(self.cells()[1] >= MIN_CELLS)

    def is_chained(self, num_pairs: Features) -> bool:
        """Tell whether what moves in another way does so in other pairs, too."""
        first, second = self.pair.ids
        num_chained = 0
        for feature1, feature2 in self.other.tolist():
            known = num_pairs[first, feature1], num_pairs[second, feature2]
            num_chained += max(known) > 1
        return num_chained >= MIN_CHAINED * len(self.other)


def share_moving_as_modelled(model: pycolmap.Reconstruction, graph: PairGraph) -> float:
    """Return the share of what moves as a model says, where something moves in another way, too.

    Args:
        model: The model.
        graph: Its pairs, with their raw matches.

    Returns:
        Of the cells of the pairs that show another motion; 1 where too few of the pairs do.
    """
    poses = poses_of(model)
    strongest = strongest_of_images(graph.pairs_inside(poses), NUM_PAIRS)
    pairs = strongest[:MAX_NUM_PAIRS]
    least = max(MIN_NUM_SHOWING, MIN_SHOWING * len(pairs))
    cameras = cameras_of(model)
    contradicting = list[_Motions]()
    for pair in pairs:
        at_most = _contradicting(pair, poses, cameras, graph)
        if at_most:
            contradicting.append(at_most)
    if len(contradicting) < least:
        return 1.0  # whatever moves in them
    showing = _showing_another_motion(contradicting, least)
    if len(showing) < least:
        return 1.0
    num_cells = np.sum([motions.cells() for motions in showing], axis=0)
    return float(num_cells[0] / max(num_cells.sum(), 1.0))


def _showing_another_motion(
    contradicting: Sequence[_Motions], least: float
) -> list[_Motions]:
    """Return what moves in the pairs in which enough moves as one, and in other pairs, too.

    Args:
        contradicting: All matches of pairs that contradict a model.
        least: The fewest of these pairs that matter; none are returned once it is out of reach.
    """
    found = list[_Motions]()
    num_large = 0
    searched = map_ordered(_moving_as_one, contradicting, available_cores())
    with closing(searched) as results:
        for num_searched, motions in enumerate(results, start=1):
            if motions:
                found.append(motions)
                num_large += motions.is_large()
            if num_large + len(contradicting) - num_searched < least:
                return []
    num_pairs = _num_pairs_of_features(found)
    return [
        motions
        for motions in found
        if motions.is_large() and motions.is_chained(num_pairs)
    ]


def _num_pairs_of_features(found: Collection[_Motions]) -> Features:
    """Return in how many pairs each feature moves in another way than its model says."""
    num_pairs: Features = Counter()
    for motions in found:
        for image_id, features in zip(motions.pair.ids, motions.other.T, strict=True):
            num_pairs.update((image_id, feature) for feature in features.tolist())
    return num_pairs


def _contradicting(
    pair: VerifiedPair,
    poses: PoseById,
    cameras: CameraById,
    graph: PairGraph,
) -> _Motions | None:
    """Return what moves as poses say, and all that contradicts them; None where that is little.

    Args:
        pair: The pair.
        poses: cam_from_world of its images, by image id.
        cameras: Of its images, by image id.
        graph: Has keypoints and raw matches.
    """
    first, second = pair.ids
    raw = graph.raw_matches.get(pair.ids, pair.matches)
    matches = np.unique(np.concatenate([raw, pair.matches]), axis=0)
    keypoints1 = graph.shaped_keypoints.get(first, graph.keypoints[first])
    keypoints2 = graph.shaped_keypoints.get(second, graph.keypoints[second])
    sides = Side(cameras[first], keypoints1), Side(cameras[second], keypoints2)
    points1 = keypoints1[matches[:, 0], :2].astype(np.float64)
    points2 = keypoints2[matches[:, 1], :2].astype(np.float64)
    pose = relative_pose(poses[first], poses[second])
    both = cameras[first], cameras[second]
    agreement = compared_with_pose(pose, both, (points1, points2))
    agrees = agreement.agrees
    is_far = ~(agreement.errors_px <= FARTHER * agreement.tolerance_px)
    least = VerificationOptions().min_num_inliers
    if is_far.sum() < least:
        return None
    far = matches[is_far]
    # No motion has more cells than all of the matches that contradict the model.
    at_most = _Motions(
        pair=pair,
        sides=sides,
        own=matches[agrees],
        other=far,
    )
    if not at_most.is_large():
        return None
    matched = keypoints1[far[:, 0]], keypoints2[far[:, 1]]
    num_consistent = num_consistent_keypoints(matched)
    if num_consistent is not None and num_consistent < least:
        return None  # the matches of a surface agree with those beside them
    return at_most


def _moving_as_one(at_most: _Motions) -> _Motions | None:
    """Return what of the matches that contradict a model moves as one; None where nothing does."""
    geometry = estimate_geometry(at_most.sides, at_most.other, VerificationOptions())
    other = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
    return replace(at_most, other=other) if len(other) else None


def _in_cells(side: Side, features: Indices) -> Array:
    """Return how many of some features of an image are in each cell of a grid."""
    cells = grid_cells(side.camera, side.keypoints[features, :2])
    return np.bincount(cells, minlength=GRID * GRID).astype(np.float64)
