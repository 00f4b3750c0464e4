"""Guided matching: the features of a pair once more, where its two-view geometry allows a match.

Only features near an epipolar line, or near the place that a homography gives, are compared; among
these few many more pass the ratio test, which gives more tracks through three images.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np

from colmap_affrect.geometry import epipolar
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Bools, Indices, Singles, rows_in
from colmap_affrect.geometry.two_views import homogeneous
from colmap_affrect.matchers.base import distance_ratios
from colmap_affrect.options import Options, within

BANDS_BESIDE = 6.0  # distance, in bands, of the geometry beside that counts accidental matches
MAX_ACCIDENTAL = 0.5  # share of guided matches that are found beside, above which none counts
GROUP_ROWS = 48  # compared at once: more take longer in products, fewer in Python
TINY = np.finfo(float).tiny
BANDS_OF_HOMOGRAPHY = 2.0  # radius round the place of a homography: planes are never quite plane


class GuidedOptions(Options):
    """Guided matching: which pairs, and what counts as a match."""

    enabled: Literal["auto", "always", "never"] = "auto"
    """``auto``: pairs of images that are missing or hang on few tracks through three images;
    ``always``: all verified pairs, which costs accuracy where guided matches outweigh others."""
    min_num_tracks: Annotated[int, within(0, 1_000_000)] = 30
    """An image with fewer features in tracks through three images or more needs guided matches:
    mapping registers images by such features."""
    band_px: Annotated[float, within(0.1, 1000.0)] = 3.0
    """Half width of the band around epipolar lines (Sampson's distance); of images that are shrunk
    for extraction in pixels of the shrunk ones."""
    min_cosine: Annotated[float, within(-1.0, 1.0)] = 0.75
    """Smallest cosine of the descriptors of a match."""
    max_ratio: Annotated[float, within(0.1, 1.0)] = 0.8
    """Largest ratio of first to second descriptor distance, the second one inside the band."""
    min_contrast_distance_px: Annotated[float, within(0.1, 1000.0)] = 10.0
    """The second neighbour must be this far from the first (FGINN)."""
    max_angle_deg: Annotated[float, within(0.0, 180.0)] = 20.0
    """Largest angle between a frame and the one that the geometry carries over (Barath, Hajder,
    Matas): of epipolar directions; frames of right matches are off by 5 to 10 degrees."""


def guided_matches(
    descriptors: tuple[Singles, Singles],
    shapes: tuple[Array, Array] | None,
    model: epipolar.PairModel,
    inliers: Indices,
    options: GuidedOptions,
) -> Indices:
    """Return the (M, 2) inliers of a pair and its guided matches, one to one, as (K, 2).

    They rise by features of image 1; all inliers stay. There are no others where too many are
    found beside the geometry (:data:`MAX_ACCIDENTAL`): they are accidental.

    Args:
        descriptors: (N, D) float32 rows of unit length of both images.
        shapes: (N, 2, 2) linear parts of their frames, up to a factor; None without directions.
        model: geometry of the pair, with the points of all features; those with NaN match nothing.
        inliers: (M, 2) features that are matched already.
        options: what counts as a match.
    """
    sign = 1.0
    if shapes and model.has_sign:
        sign = epipolar.common_sign(model.cosines(inliers[:, 0], inliers[:, 1], shapes))

    def matched(model: epipolar.PairModel) -> Indices:
        matches = nearest_allowed(descriptors, model, options)
        if not shapes:
            return matches
        cosines = sign * model.cosines(matches[:, 0], matches[:, 1], shapes)
        return np.asarray(matches[cosines >= np.cos(np.radians(options.max_angle_deg))])

    found, beside = matched(model), map(matched, _beside(model, options.band_px))
    num_accidental = min(np.count_nonzero(~rows_in(matches, found)) for matches in beside)
    if num_accidental > MAX_ACCIDENTAL * len(found):
        return inliers
    free = ~(np.isin(found[:, 0], inliers[:, 0]) | np.isin(found[:, 1], inliers[:, 1]))
    both = np.concatenate([inliers, found[free]])
    return np.asarray(both[np.argsort(both[:, 0], kind="stable")])


def nearest_allowed(
    descriptors: tuple[Singles, Singles], model: epipolar.PairModel, options: GuidedOptions
) -> Indices:
    """Return the (M, 2) mutual nearest neighbours that may match; see :func:`guided_matches`."""
    (descriptors1, descriptors2), points2 = descriptors, model.points[1]
    count1 = len(descriptors1)
    forward, accepted = np.full(count1, -1), np.zeros(count1, bool)
    backward, highest = np.full(len(points2), -1), np.full(len(points2), -1.0, np.float32)
    for rows, near in _allowed(model, options.band_px):
        columns = np.flatnonzero(near.any(axis=0))
        if not len(columns):
            continue
        similarity = descriptors1[rows] @ descriptors2[columns].T
        similarity[~near[:, columns]] = -1.0
        best = similarity.argmax(axis=1)
        value = similarity[np.arange(len(rows)), best]
        forward[rows] = columns[best]
        top = similarity.argmax(axis=0)
        top_value = similarity[top, np.arange(len(columns))]
        better = (top_value > highest[columns]) | (
            (top_value == highest[columns]) & (rows[top] < backward[columns])
        )
        highest[columns[better]], backward[columns[better]] = top_value[better], rows[top[better]]
        alike = np.flatnonzero(value > options.min_cosine)
        chosen, others = points2[columns[best[alike]]], similarity[alike]
        beside = np.linalg.norm(chosen[:, None] - points2[columns], axis=2)
        others[beside <= options.min_contrast_distance_px] = -1.0
        # A second neighbour that is missing is an opposite one.
        ratios = distance_ratios(value[alike], others.max(axis=1))
        accepted[rows[alike]] = ratios < options.max_ratio
    kept = np.flatnonzero(accepted)
    kept = kept[backward[forward[kept]] == kept]
    return np.stack([kept, forward[kept]], axis=1)


def _beside(model: epipolar.PairModel, band_px: float) -> list[epipolar.PairModel]:
    """Return geometries that are moved away in image 2: in one of them nothing is right.

    Across most epipolar lines; of a homography along both axes, for what lies before or behind its
    plane is along one direction only.
    """
    points1, points2 = model.points
    across = np.eye(2)
    if isinstance(model, epipolar.EpipolarModel):
        normals = epipolar.epipolar_lines(model.fundamental, points1, points2)[1][:, :2]
        normals = normals[np.isfinite(normals).all(axis=1)]
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), TINY)
        across = np.linalg.eigh(normals.T @ normals)[1][:, 1:].T
    steps = BANDS_BESIDE * band_px * across
    return [replace(model, points=(points1, points2 + step)) for step in steps]


def _allowed(model: epipolar.PairModel, band_px: float) -> Iterator[tuple[Indices, Bools]]:
    """Yield (R,) features of image 1, each once, and (R, N) which of image 2 they may match.

    Those of a group lie beside each other, so that they may match few.
    """
    points1, points2 = model.points
    if isinstance(model, epipolar.HomographyModel):
        with np.errstate(divide="ignore", invalid="ignore"):
            places = project(model.matrix, points1)
        radius = BANDS_OF_HOMOGRAPHY * band_px
        for rows in _groups(places[:, 1]):
            x, y = (places[rows, axis, None] - points2[:, axis] for axis in (0, 1))
            yield rows, x**2 + y**2 <= radius**2
        return
    lines1, lines2 = epipolar.epipolar_lines(model.fundamental, points1, points2)
    squares1, squares2 = ((lines[:, :2] ** 2).sum(axis=1) for lines in (lines1, lines2))
    homogeneous2 = homogeneous(points2)
    _, scales, axes = np.linalg.svd(model.fundamental)
    along = homogeneous(points1) @ axes[:2].T * scales[:2]
    for rows in _groups(np.arctan2(along[:, 0], along[:, 1]) % np.pi):  # angles in the pencil
        squares = squares2[rows, None] + squares1
        yield rows, (lines2[rows] @ homogeneous2.T) ** 2 <= band_px**2 * squares


def _groups(values: Array) -> list[Indices]:
    """Sort by values and cut into groups."""
    return np.split(np.argsort(values), range(GROUP_ROWS, len(values), GROUP_ROWS))
