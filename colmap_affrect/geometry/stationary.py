"""What truly stands still, and what only happens to move little.

Print on a sheet, or the background of a camera that stands still, is at exactly the same place of
two photographs, but for how the sheets were laid on the scanner: a shift, and a turn that one does
not see. Around the point that a camera turns about, motions are small too, but pass through zero
with a slope: of all that move less than some px, those that hardly move at all are few.
"""

import math

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices

MAX_TURN = 0.01  # radians, and of the scale, of one sheet laid on a scanner against another
EXACT_SHARE = 0.9  # of what stands still that does so within the tolerance: some is found badly
MAX_COMPARED = 300  # motions that are compared with each other
MAX_SLOPE = 0.5  # difference of the motions of two points of one thing, of their distance
NUM_FITS = 3  # of a turn to the motions that agree, each of which may make more agree


def stationary_log_ratios(
    points: Floats, motions: Floats, tolerance_px: float, limit_px: float
) -> Array:
    """Return how much more likely each small motion is if print stands still than by chance.

    By chance motions pass through zero along a line at least: the share of those below the
    tolerance is that of the lengths.

    Args:
        points: (N, 2) px of matches in the first photograph.
        motions: (N, 2) px to the second photograph, none longer than the limit.
        tolerance_px: Error of what stands still.
        limit_px: Longest motion that is looked at.

    Returns:
        (N,) logarithms of likelihood ratios, above zero where a motion is exactly that of most.
    """
    share = min(tolerance_px / limit_px, EXACT_SHARE)
    are_exact = _agreeing(motions - _common_motions(points, motions, tolerance_px), tolerance_px)
    inside = math.log(EXACT_SHARE / share)
    outside = math.log((1.0 - EXACT_SHARE) / (1.0 - share))
    return np.where(are_exact, inside, outside)


def means_of_regions(cells: Indices, values: Array, num_cells: int, reach: int) -> Array:
    """Return for each value the mean of those in cells that are connected with its own.

    Args:
        cells: (N, 2) columns and rows.
        values: (N,) what is in them.
        num_cells: Columns, and rows, that there are.
        reach: Cells by which each is grown before it is seen which are connected.
    """
    mask = np.zeros((num_cells, num_cells), np.uint8)
    mask[cells[:, 1], cells[:, 0]] = 1
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    labels = cv2.connectedComponents(cv2.dilate(mask, kernel), connectivity=8)[1]
    own = labels[cells[:, 1], cells[:, 0]]
    sums, counts = np.bincount(own, values), np.bincount(own)
    return np.asarray((sums / np.maximum(counts, 1))[own])


def num_moving_together(points: Floats, motions: Floats, radius_px: float) -> int:
    """Count the matches beside which another one moves alike, as those of one thing do.

    Args:
        points: (N, 2) px of matches in the first photograph; of many some are looked at.
        motions: (N, 2) px to the second photograph.
        radius_px: How far apart two matches are at most.
    """
    step = -(-len(points) // MAX_COMPARED) or 1
    places, moved = points[::step], motions[::step]
    distances = np.linalg.norm(places[:, None] - places, axis=2)
    differences = np.linalg.norm(moved[:, None] - moved, axis=2)
    are_near = (distances <= radius_px) & (distances > 0.0)
    is_together = are_near & (differences <= MAX_SLOPE * distances)
    return int(step * np.count_nonzero(is_together.any(axis=1)))


def _common_motions(points: Floats, motions: Floats, tolerance_px: float) -> Array:
    """Return the (N, 2) motions of a sheet on which most of the points are."""
    some = motions[:: -(-len(motions) // MAX_COMPARED) or 1]
    if not len(some):
        return np.zeros((0, 2))
    are_near = np.linalg.norm(some[:, None] - some, axis=2) <= tolerance_px
    shift = some[are_near[are_near.sum(axis=1).argmax()]].mean(axis=0)
    found = np.broadcast_to(shift, motions.shape)
    system = _turn_system(points)
    for _ in range(NUM_FITS):
        agreeing = _agreeing(motions - found, tolerance_px)
        rows = np.repeat(agreeing, 2)
        turn = np.linalg.lstsq(system[rows], motions[agreeing].ravel(), rcond=None)[0]
        if np.abs(turn[:2]).max() > MAX_TURN:
            break
        fitted = (system @ turn).reshape(-1, 2)
        if _agreeing(motions - fitted, tolerance_px).sum() <= agreeing.sum():
            break
        found = fitted
    return found


def _agreeing(errors: Floats, tolerance_px: float) -> Bools:
    return np.asarray(np.linalg.norm(errors, axis=1) <= tolerance_px)


def _turn_system(points: Floats) -> Array:
    """Return the (2 N, 4) rows by which scale, turn and shift make the motions of points."""
    x, y = (points - points.mean(axis=0)).T
    zeros, ones = np.zeros(len(points)), np.ones(len(points))
    rows = np.stack([np.stack([x, -y, ones, zeros], 1), np.stack([y, x, zeros, ones], 1)], axis=1)
    return rows.reshape(-1, 4)
