"""Guided matching: the features of a pair once more, where its two-view geometry allows a match.

Only the features near an epipolar line, or near the place that a homography gives, are compared;
among these few many more pass the ratio test, which gives more tracks through three images.
Features of image 1 are compared in groups whose epipolar lines (or places) lie close together.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numpy as np

from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Bools, Indices, Singles
from colmap_affrect.geometry.epipolar import (
    EpipolarModel,
    HomographyModel,
    common_sign,
    epipolar_lines,
)
from colmap_affrect.geometry.shapes import vary_singly
from colmap_affrect.geometry.two_views import homogeneous
from colmap_affrect.matchers.base import distance_ratios
from colmap_affrect.options import Options, within

GROUP_ROWS = 48  # compared at once: more take longer in products, fewer in Python

MIN_AGREEING = 0.5  # share of inliers whose frames agree with the geometry, of a right pair
BANDS_BESIDE = 6.0  # distance, in bands, of the geometry beside that counts accidental matches
MAX_ACCIDENTAL = 0.5  # share of guided matches beside the geometry, above which none counts
TINY = np.finfo(float).tiny
ANGLE_ROUNDING = 1e-9  # far below any band, far above the error of angles in a pencil of lines
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
    """Half width of the band around epipolar lines; of images that are shrunk for extraction in
    pixels of the shrunk ones."""
    min_cosine: Annotated[float, within(-1.0, 1.0)] = 0.75
    """Smallest cosine of the descriptors of a match."""
    max_ratio: Annotated[float, within(0.1, 1.0)] = 0.8
    """Largest ratio of first to second descriptor distance, the second one inside the band."""
    min_contrast_distance_px: Annotated[float, within(0.1, 1000.0)] = 10.0
    """The second neighbour must be this far from the first (FGINN)."""
    max_angle_deg: Annotated[float, within(0.0, 180.0)] = 20.0
    """Largest angle between the epipolar direction of image 2 and that of image 1 carried over by
    the local affine frames; of planes between these and the map of the homography."""


@dataclass(frozen=True)
class GuidableImage:
    """The features of an image."""

    descriptors: Singles  # (N, D) float32 rows of unit length
    points: Array  # (N, 2) px in which the geometry of the pair holds; rows with NaN match nothing
    # (N, 2, 2) linear parts of the frames, up to a factor; None without frames
    shapes: Array | None = None

    @property
    def has_directions(self) -> bool:
        """Whether frames can tell a direction.

        Similarities (COLMAP's SIFT) do, circles do not, nor what warps made of them.
        """
        return self.shapes is not None and len(self.shapes) > 0 and vary_singly(self.shapes)


class EpipolarGuide:
    """Matches lie within a band around epipolar lines (Sampson's distance).

    Both images are brought to unit size, which keeps angles around far epipoles apart.
    ``model`` is the geometry.
    """

    def __init__(self, fundamental: Array, points1: Array, points2: Array, band_px: float) -> None:
        self.model: EpipolarModel = EpipolarModel(fundamental, (points1, points2))
        self._band_px = band_px
        finite = [points[np.isfinite(points).all(axis=1)] for points in (points1, points2)]
        size = max([1.0, *(float(np.ptp(p, axis=0).max()) for p in finite if len(p))])
        to_pixels, unit = [], []
        for points, usable in zip((points1, points2), finite, strict=True):
            center = usable.mean(axis=0) if len(usable) else np.zeros(2)
            to_pixels.append(np.array([[size, 0, center[0]], [0, size, center[1]], [0, 0, 1]]))
            unit.append((points - center) / size)
        matrix = to_pixels[1].T @ fundamental @ to_pixels[0]
        self._band = band_px / size
        self._homogeneous2 = homogeneous(unit[1])
        lines1, self._lines2 = epipolar_lines(matrix, *unit)
        self._squares1 = (lines1[:, :2] ** 2).sum(axis=1)
        self._squares2 = (self._lines2[:, :2] ** 2).sum(axis=1)
        self._pencil(matrix, unit)

    def _pencil(self, matrix: Array, unit: list[Array]) -> None:
        """Give each point of both images the angle of its epipolar line in one common pencil.

        With F = s1 u1 v1' + s2 u2 v2' the residual of points 1 and 2 is r1 r2 sin(a1 - a2), where
        r and a are the polar coordinates of (s1 v1'x1, s2 v2'x1), turned by a right angle, and of
        (u1'x2, u2'x2).
        """
        u, s, vt = np.linalg.svd(matrix)
        along1 = homogeneous(unit[0]) @ vt[:2].T * s[:2]
        along2 = self._homogeneous2 @ u[:, :2]
        inverse1, inverse2 = (
            1.0 / np.maximum(np.linalg.norm(a, axis=1), TINY) for a in (along1, along2)
        )
        self._angles1 = np.arctan2(along1[:, 0], -along1[:, 1]) % np.pi
        self._angles2 = np.arctan2(along2[:, 1], along2[:, 0]) % np.pi
        self._reach1 = inverse1, np.sqrt(self._squares2) * inverse1
        self._reach2 = inverse2, np.sqrt(self._squares1) * inverse2

    def groups(self) -> Iterator[tuple[Indices, Indices]]:
        """Yield features of image 1, each once, and all of image 2 that any of these may match.

        Sorted by reach, then by angle: near the epipole lines fan out.
        """
        order, edges = _sorted_within(np.log2(self._reach1[0]), self._angles1)
        order2, edges2 = _sorted_within(2.0 * np.log2(self._reach2[0]), self._angles2)
        classes = [_Pencil.of(part, self) for part in np.split(order2, edges2) if len(part)]
        for rows in _chunks(order, edges):
            reach = [float(part[rows].max()) for part in self._reach1]
            span = self._angles1[rows[0]], self._angles1[rows[-1]]
            near = [pencil.near(span, reach, self._band) for pencil in classes]
            yield rows, np.concatenate([np.zeros(0, np.int64), *near])

    def allowed(self, rows: Indices, columns: Indices) -> Bools:
        """Return which of (R,) and (C,) features may match, (R, C)."""
        residuals = self._lines2[rows] @ self._homogeneous2[columns].T
        squares = self._squares2[rows, None] + self._squares1[columns]
        return np.asarray(residuals**2 <= self._band**2 * squares)

    def beside(self) -> "list[EpipolarGuide]":
        """Return the geometry with image 2 moved away, across most epipolar lines."""
        points1, points2 = self.model.points
        normals = self._lines2[:, :2] / np.sqrt(np.maximum(self._squares2, TINY))[:, None]
        normals = normals[np.isfinite(normals).all(axis=1)]
        across = np.linalg.eigh(normals.T @ normals)[1][:, 1]
        moved = points2 + BANDS_BESIDE * self._band_px * across
        return [EpipolarGuide(self.model.fundamental, points1, moved, self._band_px)]


class HomographyGuide:
    """Matches lie near the places that a homography gives: of planes, and without a baseline."""

    def __init__(self, homography: Array, points1: Array, points2: Array, band_px: float) -> None:
        self._points2, self._band_px = points2, band_px
        self.model: HomographyModel = HomographyModel(homography, (points1, points2))
        with np.errstate(divide="ignore", invalid="ignore"):
            self._places = project(homography, points1)
        self._radius = BANDS_OF_HOMOGRAPHY * band_px

    def groups(self) -> Iterator[tuple[Indices, Indices]]:
        """Yield the same as :meth:`EpipolarGuide.groups`; a group is a part of a strip."""
        points2, radius = self._points2, self._radius
        order2 = np.argsort(points2[:, 1])[: np.isfinite(points2).all(axis=1).sum()]
        if not len(order2):
            return
        x, y = points2[order2].T
        low, high = np.array([x.min(), y[0]]) - radius, np.array([x.max(), y[-1]]) + radius
        inside = ((self._places >= low) & (self._places <= high)).all(axis=1)
        height = np.sqrt(np.prod(high - low) * GROUP_ROWS / max(1, inside.sum()))
        strips = np.where(inside, (self._places[:, 1] - low[1]) / height, np.nan)
        for rows in _chunks(*_sorted_within(strips, self._places[:, 0])):
            lowest = self._places[rows].min(axis=0) - radius
            highest = self._places[rows].max(axis=0) + radius
            part = slice(*np.searchsorted(y, [lowest[1], np.nextafter(highest[1], np.inf)]))
            yield rows, order2[part][(x[part] >= lowest[0]) & (x[part] <= highest[0])]

    def allowed(self, rows: Indices, columns: Indices) -> Bools:
        """Return which of (R,) and (C,) features may match, (R, C)."""
        return _within(self._places[rows], self._points2[columns], self._radius)

    def beside(self) -> "list[HomographyGuide]":
        """Return geometries that are moved away: in one of them nothing is right.

        What lies before or behind the plane is along one direction only.
        """
        points1, points2 = self.model.points
        steps = BANDS_BESIDE * self._band_px * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
        return [
            HomographyGuide(self.model.matrix, points1, points2 + step, self._band_px)
            for step in steps
        ]


Guide = EpipolarGuide | HomographyGuide  # what the geometry of a pair says about matches


@dataclass(frozen=True)
class _Pencil:
    """Features of image 2 of similar reach, by rising angles of their epipolar lines."""

    angles: Array  # (3 N,), those of a turn before and of one after included
    indices: Indices  # (N,) features
    reach: tuple[float, float]  # the largest of both reaches

    @classmethod
    def of(cls, indices: Indices, guide: EpipolarGuide) -> Self:
        angles = guide._angles2[indices]
        turns = np.concatenate([angles - np.pi, angles, angles + np.pi])
        first, second = (float(part[indices].max()) for part in guide._reach2)
        return cls(turns, indices, (first, second))

    def near(self, span: tuple[float, float], reach: list[float], band: float) -> Indices:
        """Return the features that those of image 1 with angles in a span may match.

        A residual of band * sqrt(square1 + square2) is allowed, which is r1 r2 times a sine.
        """
        sine = band * np.hypot(reach[0] * self.reach[1], reach[1] * self.reach[0])
        margin = np.arcsin(min(1.0, float(sine))) + ANGLE_ROUNDING
        low, high = span[0] - margin, span[1] + margin
        if high - low >= np.pi:
            return self.indices
        begin, end = np.searchsorted(self.angles, [low, high])
        return np.asarray(self.indices[np.arange(begin, end) % len(self.indices)])


def _sorted_within(sizes: Array, values: Array) -> tuple[Indices, Indices]:
    """Sort what is finite by whole sizes, then values; return the order and where sizes change."""
    usable = np.flatnonzero(np.isfinite(sizes) & np.isfinite(values))
    classes = np.floor(sizes[usable])
    order = np.lexsort((values[usable], classes))
    return usable[order], np.flatnonzero(np.diff(classes[order])) + 1


def _chunks(order: Indices, edges: Indices) -> Iterator[Indices]:
    """Cut a sequence into groups that do not reach over the edges."""
    for part in np.split(order, edges):
        for begin in range(0, len(part), GROUP_ROWS):
            yield part[begin : begin + GROUP_ROWS]


def _within(points1: Array, points2: Array, radius: float) -> Bools:
    """Tell which of (R, 2) and (C, 2) points are at most ``radius`` apart, (R, C)."""
    x, y = (points1[:, axis, None] - points2[:, axis] for axis in (0, 1))
    return np.asarray(x**2 + y**2 <= radius**2)


def frame_angles_deg(
    guide: Guide, shapes: tuple[Array, Array], indices: Indices, of: Indices
) -> Array:
    """Return (M,) angles between the frames of (M, 2) matches and the geometry.

    The sign of all directions that the geometry leaves open is that of most of the matches ``of``.
    """
    cosines, known = (
        guide.model.cosines(pairs[:, 0], pairs[:, 1], shapes) for pairs in (indices, of)
    )
    sign = common_sign(known) if guide.model.has_sign else 1.0
    return np.asarray(np.degrees(np.arccos(np.clip(cosines * sign, -1.0, 1.0))))


def guided_matches(
    first: GuidableImage,
    second: GuidableImage,
    guide: Guide,
    options: GuidedOptions,
    inliers: Indices,
) -> Indices:
    """Return the (M, 2) inliers of a pair and its guided matches, one to one, as (K, 2).

    They rise by features of image 1. All inliers, which the geometry was estimated from, stay.
    There are no others where the frames of the inliers (without any, of the guided matches) do not
    agree with the geometry (:data:`MIN_AGREEING`), or where too many are found beside it
    (:data:`MAX_ACCIDENTAL`). Frames without a direction (:attr:`GuidableImage.has_directions`) are
    not compared; of these images there are no guided matches without inliers.
    """
    has_directions = first.has_directions and second.has_directions
    if not (has_directions or len(inliers)):
        return inliers
    found = nearest_allowed(first, second, guide, options)
    trusted = inliers if len(inliers) else found

    def agrees(guide: Guide, matches: Indices) -> Bools:
        if not has_directions:
            return np.ones(len(matches), bool)
        shapes = np.asarray(first.shapes), np.asarray(second.shapes)
        return frame_angles_deg(guide, shapes, matches, trusted) <= options.max_angle_deg

    if len(trusted) and agrees(guide, trusted).mean() < MIN_AGREEING:
        return inliers
    found = found[agrees(guide, found)]
    limit = MAX_ACCIDENTAL * len(found)
    for beside in guide.beside():
        accidental = nearest_allowed(first, second, beside, options)
        accidental = accidental[agrees(beside, accidental)]
        if len(_without(accidental, found)) <= limit:
            break
    else:
        return inliers
    free = ~(np.isin(found[:, 0], inliers[:, 0]) | np.isin(found[:, 1], inliers[:, 1]))
    both = np.concatenate([inliers, found[free]])
    return np.asarray(both[np.argsort(both[:, 0], kind="stable")])


def _without(matches: Indices, others: Indices) -> Indices:
    """Return the (M, 2) matches that are not among others, in both of which features are unique."""
    partner = dict(others.tolist())
    is_other = [partner.get(row) != column for row, column in matches.tolist()]
    return np.asarray(matches[np.array(is_other, bool)])


def nearest_allowed(
    first: GuidableImage, second: GuidableImage, guide: Guide, options: GuidedOptions
) -> Indices:
    """Return the (M, 2) mutual nearest neighbours among the pairs of features that are allowed."""
    count1, count2 = len(first.descriptors), len(second.descriptors)
    forward, accepted = np.full(count1, -1), np.zeros(count1, bool)
    backward, highest = np.full(count2, -1), np.full(count2, -1.0, np.float32)
    for rows, columns in guide.groups():
        if not len(columns):
            continue
        similarity = first.descriptors[rows] @ second.descriptors[columns].T
        similarity[~guide.allowed(rows, columns)] = -1.0
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
        points2, others = second.points[columns], similarity[alike]
        others[_within(points2[best[alike]], points2, options.min_contrast_distance_px)] = -1.0
        # A second neighbour that is missing is an opposite one.
        ratios = distance_ratios(value[alike], others.max(axis=1))
        accepted[rows[alike]] = ratios < options.max_ratio
    kept = np.flatnonzero(accepted)
    kept = kept[backward[forward[kept]] == kept]
    return np.stack([kept, forward[kept]], axis=1)
