"""Matches that are stationary, against matches that only happen to move little.

Print on a sheet, or the background of a fixed camera, is at exactly the same position in two
photographs, up to how the sheets were laid on the scanner: a shift, and an invisible rotation.
Around the point that a camera turns about, motions are small too, but pass through zero with a
slope: of all that are shorter than some px, few are nearly zero.
"""

import math

import cv2
import numpy as np

from colmap_affrect.geometry.arrays import Array, Bools, Floats, Indices, sampling_step
from colmap_affrect.geometry.neighbors import MAX_RELATIVE_ERROR

MAX_SHEET_ROTATION = 0.01
"""Rotation in radians, and change of scale, between two positions of a sheet on a scanner; theory:
half a degree."""
EXACT_RATIO = 0.9
"""Stationary matches whose motion is zero within the tolerance, as a share of all; judged: some
keypoints are badly localized."""
# Motions that are compared with each other, which bounds time; resource
MAX_COMPARED = 300
# Of a rotation to the motions that agree, each of which may make more agree; resource
MAX_FITS = 3


def stationary_log_ratios(
    points: Floats, motions: Floats, tolerance_px: float, limit_px: float
) -> Array:
    """Return how much more likely each small motion is for print than by chance.

    Motions that are short by chance pass through zero along a line at least: the ratio of those
    below the tolerance is that of the lengths.

    Args:
        points: (N, 2) px of matches in the first photograph.
        motions: (N, 2) px to the second photograph, none longer than the limit.
        tolerance_px: error of the motion of a stationary match.
        limit_px: longest motion that is looked at.

    Returns:
        (N,) log-likelihood ratios, above zero where a motion is exactly that of most.
    """
    ratio_by_chance = min(tolerance_px / limit_px, EXACT_RATIO)
    errors = motions - _common_motions(points, motions, tolerance_px)
    exact = math.log(EXACT_RATIO / ratio_by_chance)
    inexact = math.log((1.0 - EXACT_RATIO) / (1.0 - ratio_by_chance))
    return np.where(_agreeing(errors, tolerance_px), exact, inexact)


def means_of_regions(
    cells: Indices, values: Array, num_cells: int, reach: int
) -> Array:
    """Return for each value the mean of those in cells that are connected with its own.

    Args:
        cells: (N, 2) columns and rows.
        values: (N,) values in these cells.
        num_cells: number of columns, and of rows, of the grid.
        reach: cells by which each is dilated before connected components are found.

    Returns:
        (N,) means.
    """
    mask = np.zeros((num_cells, num_cells), np.uint8)
    mask[cells[:, 1], cells[:, 0]] = 1
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    _, labels = cv2.connectedComponents(cv2.dilate(mask, kernel), connectivity=8)
    regions = labels[cells[:, 1], cells[:, 0]]
    sums = np.bincount(regions, values)
    counts = np.bincount(regions)
    return np.asarray((sums / np.maximum(counts, 1))[regions])


def num_moving_together(points: Floats, motions: Floats, radius_px: float) -> int:
    """Count the matches that have a neighbour with a similar motion, as matches of one object.

    Motions differ by at most ``MAX_RELATIVE_ERROR`` of the distance, as of matches that support
    each other.

    Args:
        points: (N, 2) px of matches in the first photograph; of many some are looked at.
        motions: (N, 2) px to the second photograph.
        radius_px: largest distance of neighbours.

    Returns:
        The number of matches, extrapolated from those that are looked at.
    """
    step = sampling_step(len(points), MAX_COMPARED)
    sampled_points = points[::step]
    sampled_motions = motions[::step]
    distances = np.linalg.norm(sampled_points[:, None] - sampled_points, axis=2)
    differences = np.linalg.norm(sampled_motions[:, None] - sampled_motions, axis=2)
    is_near = (distances <= radius_px) & (distances > 0.0)
    is_similar = differences <= MAX_RELATIVE_ERROR * distances
    has_companion = (is_near & is_similar).any(axis=1)
    return int(step * np.count_nonzero(has_companion))


def _common_motions(points: Floats, motions: Floats, tolerance_px: float) -> Array:
    """Return the motions of a sheet that most of the points are on.

    Args:
        points: (N, 2) px of matches in the first photograph.
        motions: (N, 2) px to the second photograph.
        tolerance_px: error of the motion of a stationary match.

    Returns:
        (N, 2) px.
    """
    if not len(motions):
        return np.zeros((0, 2))
    sampled = motions[:: sampling_step(len(motions), MAX_COMPARED)]
    is_near = np.linalg.norm(sampled[:, None] - sampled, axis=2) <= tolerance_px
    densest = is_near.sum(axis=1).argmax()
    shift = sampled[is_near[densest]].mean(axis=0)
    common = np.broadcast_to(shift, motions.shape)
    system = _similarity_system(points)
    for _ in range(MAX_FITS):
        is_agreeing = _agreeing(motions - common, tolerance_px)
        equations = np.repeat(is_agreeing, 2)
        right_sides = motions[is_agreeing].ravel()
        similarity, *_ = np.linalg.lstsq(system[equations], right_sides, rcond=None)
        if np.abs(similarity[:2]).max() > MAX_SHEET_ROTATION:
            break
        fitted = (system @ similarity).reshape(-1, 2)
        num_agreeing = _agreeing(motions - fitted, tolerance_px).sum()
        if num_agreeing <= is_agreeing.sum():
            break
        common = fitted
    return common


def _agreeing(errors: Floats, tolerance_px: float) -> Bools:
    return np.asarray(np.linalg.norm(errors, axis=1) <= tolerance_px)


def _similarity_system(points: Floats) -> Array:
    """Return the (2 N, 4) equations of the motions of points by scale, rotation and shift."""
    x, y = (points - points.mean(axis=0)).T
    zeros = np.zeros(len(points))
    ones = np.ones(len(points))
    motions_x = np.stack([x, -y, ones, zeros], axis=1)
    motions_y = np.stack([y, x, zeros, ones], axis=1)
    return np.stack([motions_x, motions_y], axis=1).reshape(-1, 4)
