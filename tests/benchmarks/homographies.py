"""Metrics of matches and homographies against a true homography, pure numpy.

All homographies are (3, 3), image2_from_image1, of pixel-centre px, with a positive third
coordinate in the part of image 1 that image 2 shows.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.conventions import is_inside
from colmap_affrect.geometry.affine import project

CORRECT_PX = 3.0
"""A match is correct if its transfer error in image 2 is smaller."""

THRESHOLDS_PX = (1.0, 2.0, 3.0, 5.0, 10.0, 20.0)
"""Pairs are counted whose homography error is smaller (the paper's table on EVD)."""

GRID_STEP_PX = 4


def transfer_errors(
    homography: NDArray[np.floating], points1: NDArray[np.floating], points2: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the (N,) distances in image 2, in px, of (N, 2) points 1 carried over to points 2."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.linalg.norm(project(homography, points1) - points2, axis=1)
    return np.where(third_coordinates(homography, points1) > 0, distances, np.inf)


def third_coordinates(
    homography: NDArray[np.floating], points: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return the (N,) third coordinates of (N, 2) points carried over, before the division."""
    return np.asarray(points @ homography[2, :2] + homography[2, 2])


def visible_points(
    truth: NDArray[np.floating], size1: tuple[int, int], size2: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the points of image 1 that image 2 shows.

    Args:
        truth: (3, 3) true homography.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.

    Returns:
        (N, 2) pixel centres, every ``GRID_STEP_PX``-th in x and y.
    """
    columns, rows = (np.arange(0, extent, GRID_STEP_PX) for extent in size1)
    points = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    points = points[third_coordinates(truth, points) > 0]
    return points[is_inside(project(truth, points), size2)]


def homography_error(
    estimate: NDArray[np.floating],
    truth: NDArray[np.floating],
    size1: tuple[int, int],
    size2: tuple[int, int],
) -> float:
    """Return the mean distance in image 2 of what two homographies make of the visible points.

    The error measure of the Extreme View Dataset (Mishkin et al. 2015) as the paper uses it: mean
    Euclidean distance over the part of image 1 that image 2 shows. An estimate whose horizon
    runs through that part has an infinite error.

    Args:
        estimate: (3, 3) estimated homography, of any scale.
        truth: (3, 3) true homography.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.

    Returns:
        Mean error in px.
    """
    points = visible_points(truth, size1, size2)
    signed = estimate * np.sign(third_coordinates(estimate, points).sum())
    return float(transfer_errors(signed, points, project(truth, points)).mean())


def counts_below(errors_px: Iterable[float | None]) -> list[int]:
    """Count the errors below each of ``THRESHOLDS_PX``; None stands for no estimate."""
    known = [error for error in errors_px if error is not None]
    return [sum(error < threshold for error in known) for threshold in THRESHOLDS_PX]
