"""Guided matching: a verified pair is matched again, near its two-view geometry only.

A feature is compared with those near its epipolar line, or near the position that a homography
gives. Among so few of them many more matches pass the ratio test, which gives more tracks through
three images.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

import numpy as np

from colmap_affrect.geometry import epipolar
from colmap_affrect.geometry.affine import project
from colmap_affrect.geometry.arrays import Array, Bools, Indices, Singles, rows_in
from colmap_affrect.geometry.two_views import homogeneous
from colmap_affrect.matchers.base import distance_ratios
from colmap_affrect.options import Options, within

DISPLACEMENT_BANDS = 6.0
"""Displacement, in half widths of the band, of the geometry whose matches are all accidental: the
bands of both do not overlap, and image content is still similar there; theory."""
MAX_ACCIDENTAL_SHARE = 0.5
"""Accidental matches for each guided match, above which guided matches prove nothing; judged."""
HOMOGRAPHY_BANDS = 2.0
"""Radius, in half widths of the band, around the position that a homography gives: planes are
never quite plane; judged."""
GROUP_SIZE = 48
"""Features of image 1 compared at once: with more, products take longer, with fewer Python does;
resource."""
# Cosine that stands in for a second neighbour where there is none; numeric
SECOND_IS_OPPOSITE = -1.0
TINY = np.finfo(float).tiny


class GuidedOptions(Options):
    """Guided matching: which pairs, and what counts as a match."""

    enabled: Literal["auto", "always", "never"] = "auto"
    """``auto``: pairs of images that are missing or hang on few tracks through three images;
    ``always``: all verified pairs, which costs accuracy where guided matches outweigh others."""
    # COLMAP's abs_pose_min_num_inliers
    min_num_tracks: Annotated[int, within(0, 1_000_000)] = 30
    """An image with fewer features in tracks through three images or more needs guided matches:
    mapping registers images by such features."""
    # Same as VerificationOptions.max_error_px
    band_px: Annotated[float, within(0.1, 1000.0)] = 3.0
    """Half width of the band around epipolar lines (Sampson's distance); of images that are shrunk
    for extraction in pixels of the shrunk ones."""
    min_cosine: Annotated[float, within(-1.0, 1.0)] = 0.75  # judged
    """Smallest cosine of the descriptors of a match."""
    max_ratio: Annotated[float, within(0.1, 1.0)] = 0.8  # paper
    """Largest ratio of first to second descriptor distance, the second one inside the band."""
    min_contrast_distance_px: Annotated[float, within(0.1, 1000.0)] = 10.0  # paper
    """The second neighbour must be this far from the first (FGINN)."""
    # Same as two_views.MAX_FRAME_ANGLE_DEG
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
    """Return the inliers of a pair together with its guided matches, one to one.

    All inliers stay. No guided match is added where a displaced geometry, of which all matches are
    accidental, has too many of them (:data:`MAX_ACCIDENTAL_SHARE`).

    Args:
        descriptors: (N, D) float32 rows of unit length of both images.
        shapes: (N, 2, 2) linear parts of the LAFs, up to a factor; None without orientations.
        model: geometry of the pair, with the points of all features; those with NaN match nothing.
        inliers: (M, 2) features that are matched already.
        options: what counts as a match.

    Returns:
        (K, 2) features of image 1 and 2, rising in the first column.
    """
    sign = 1.0
    if shapes and model.has_sign:
        cosines = model.cosines(inliers[:, 0], inliers[:, 1], shapes)
        sign = epipolar.common_sign(cosines)

    def match(geometry: epipolar.PairModel) -> Indices:
        matches = match_near_geometry(descriptors, geometry, options)
        if not shapes:
            return matches
        cosines = sign * geometry.cosines(matches[:, 0], matches[:, 1], shapes)
        is_consistent = cosines >= np.cos(np.radians(options.max_angle_deg))
        return np.asarray(matches[is_consistent])

    found = match(model)
    accidental_counts = []
    for displaced in _displaced_geometries(model, options.band_px):
        is_accidental = ~rows_in(match(displaced), found)
        accidental_counts.append(np.count_nonzero(is_accidental))
    if min(accidental_counts) > MAX_ACCIDENTAL_SHARE * len(found):
        return inliers
    is_taken1 = np.isin(found[:, 0], inliers[:, 0])
    is_taken2 = np.isin(found[:, 1], inliers[:, 1])
    added = found[~(is_taken1 | is_taken2)]
    matches = np.concatenate([inliers, added])
    order = np.argsort(matches[:, 0], kind="stable")
    return np.asarray(matches[order])


def match_near_geometry(
    descriptors: tuple[Singles, Singles],
    model: epipolar.PairModel,
    options: GuidedOptions,
) -> Indices:
    """Return mutual nearest neighbours among the features that a geometry allows to match.

    Args:
        descriptors: (N, D) float32 rows of unit length of both images.
        model: geometry of the pair, with the points of all features; those with NaN match nothing.
        options: width of the band, smallest cosine and ratio test (FGINN).

    Returns:
        (M, 2) features of image 1 and 2, rising in the first column.
    """
    descriptors1, descriptors2 = descriptors
    points2 = model.points[1]
    nearest2 = np.full(len(descriptors1), -1)
    is_distinctive = np.zeros(len(descriptors1), bool)
    nearest1 = _NearestOfFirst.none(len(points2))
    for features1, is_allowed in _allowed_groups(model, options.band_px):
        features2 = np.flatnonzero(is_allowed.any(axis=0))
        if not len(features2):
            continue
        cosines = descriptors1[features1] @ descriptors2[features2].T
        cosines[~is_allowed[:, features2]] = SECOND_IS_OPPOSITE
        nearest1.update(features1, features2, cosines)
        best = cosines.argmax(axis=1)
        nearest2[features1] = features2[best]
        distinctive = _distinctive_rows(cosines, best, points2[features2], options)
        is_distinctive[features1[distinctive]] = True
    kept1 = np.flatnonzero(is_distinctive)
    is_mutual = nearest1.features[nearest2[kept1]] == kept1
    kept1 = kept1[is_mutual]
    return np.stack([kept1, nearest2[kept1]], axis=1)


@dataclass
class _NearestOfFirst:
    """The most similar feature of image 1 so far, for each feature of image 2."""

    features: Indices  # (N,) of image 1; -1: none yet
    cosines: Singles  # (N,) of their descriptors

    @classmethod
    def none(cls, num_features: int) -> Self:
        cosines = np.full(num_features, -1.0, np.float32)
        return cls(np.full(num_features, -1), cosines)

    def update(self, features1: Indices, features2: Indices, cosines: Singles) -> None:
        """Take in the cosines of some features of both images.

        Args:
            features1: (R,) of image 1.
            features2: (C,) of image 2.
            cosines: (R, C) of their descriptors.
        """
        best = cosines.argmax(axis=0)
        best_cosines = cosines[best, np.arange(len(features2))]
        known_cosines = self.cosines[features2]
        # Among equal ones the first feature counts, whatever the order of groups.
        is_earlier = features1[best] < self.features[features2]
        is_better = best_cosines > known_cosines
        is_better |= (best_cosines == known_cosines) & is_earlier
        self.cosines[features2[is_better]] = best_cosines[is_better]
        self.features[features2[is_better]] = features1[best[is_better]]


def _distinctive_rows(
    cosines: Singles, best: Indices, points2: Array, options: GuidedOptions
) -> Indices:
    """Return which of R features are similar to their nearest neighbour, and to no other.

    Args:
        cosines: (R, C) of the descriptors of R features of image 1 and C of image 2.
        best: (R,) column of the nearest neighbour of each.
        points2: (C, 2) px.
        options: smallest cosine and ratio test.
    """
    best_cosines = cosines[np.arange(len(best)), best]
    rows = np.flatnonzero(best_cosines > options.min_cosine)
    other_cosines = cosines[rows]
    x, y = points2.T
    nearest = best[rows]
    distances = (x[nearest, None] - x) ** 2
    distances += (y[nearest, None] - y) ** 2
    np.sqrt(distances, out=distances)
    other_cosines[distances <= options.min_contrast_distance_px] = SECOND_IS_OPPOSITE
    ratios = distance_ratios(best_cosines[rows], other_cosines.max(axis=1))
    return np.asarray(rows[ratios < options.max_ratio])


def _displaced_geometries(
    model: epipolar.PairModel, band_px: float
) -> list[epipolar.PairModel]:
    """Return geometries whose points of image 2 are moved away: one of them has no true matches.

    They are moved across most epipolar lines. Of a homography they are moved along both axes: what
    lies before or behind its plane is displaced along one direction only.
    """
    points1, points2 = model.points
    directions = np.eye(2)
    if isinstance(model, epipolar.EpipolarModel):
        _, lines2 = epipolar.epipolar_lines(model.fundamental, points1, points2)
        normals = lines2[:, :2]
        normals = normals[np.isfinite(normals).all(axis=1)]
        lengths = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.maximum(lengths, TINY)
        _, eigenvectors = np.linalg.eigh(normals.T @ normals)
        directions = eigenvectors[:, 1:].T
    displacements = DISPLACEMENT_BANDS * band_px * directions
    return [
        replace(model, points=(points1, points2 + shift)) for shift in displacements
    ]


def _allowed_groups(
    model: epipolar.PairModel, band_px: float
) -> Iterator[tuple[Indices, Bools]]:
    """Yield groups of features of image 1, and which features of image 2 they may match.

    The features of a group have similar epipolar lines or positions, so that they may match few.

    Args:
        model: geometry of the pair, with the points of all features.
        band_px: half width of the band around epipolar lines.

    Yields:
        (R,) features of image 1, each in one group, and (R, N) which of image 2 are allowed.
    """
    if isinstance(model, epipolar.HomographyModel):
        return _groups_near_positions(model, HOMOGRAPHY_BANDS * band_px)
    return _groups_near_lines(model, band_px)


def _groups_near_positions(
    model: epipolar.HomographyModel, radius_px: float
) -> Iterator[tuple[Indices, Bools]]:
    points1, points2 = model.points
    with np.errstate(divide="ignore", invalid="ignore"):
        positions = project(model.matrix, points1)
    x2, y2 = np.ascontiguousarray(points2.T)
    # In the same memory for all groups: making and leaving it takes longer than the sums.
    squares_x = np.empty((GROUP_SIZE, len(points2)))
    squares_y = np.empty_like(squares_x)
    for group in _groups_by(positions[:, 1]):
        x = np.subtract(positions[group, 0, None], x2, out=squares_x[: len(group)])
        y = np.subtract(positions[group, 1, None], y2, out=squares_y[: len(group)])
        x *= x
        y *= y
        x += y
        yield group, x <= radius_px**2


def _groups_near_lines(
    model: epipolar.EpipolarModel, band_px: float
) -> Iterator[tuple[Indices, Bools]]:
    """Compare Sampson's distance with the band, without a division for each pair of features."""
    points1, points2 = model.points
    lines1, lines2 = epipolar.epipolar_lines(model.fundamental, points1, points2)
    squares1 = (lines1[:, :2] ** 2).sum(axis=1)
    squares2 = (lines2[:, :2] ** 2).sum(axis=1)
    homogeneous2 = homogeneous(points2)
    _, singular_values, axes = np.linalg.svd(model.fundamental)
    coordinates = homogeneous(points1) @ axes[:2].T * singular_values[:2]
    pencil_angles = np.arctan2(coordinates[:, 0], coordinates[:, 1]) % np.pi
    columns2 = np.ascontiguousarray(homogeneous2.T)
    # In the same memory for all groups: making and leaving it takes longer than the sums.
    all_limits = np.empty((GROUP_SIZE, len(points2)))
    all_products = np.empty_like(all_limits)
    for group in _groups_by(pencil_angles):
        limits = all_limits[: len(group)]
        np.add(squares2[group, None], squares1, out=limits)
        limits *= band_px**2
        products = np.matmul(lines2[group], columns2, out=all_products[: len(group)])
        products *= products
        yield group, products <= limits


def _groups_by(values: Array) -> list[Indices]:
    """Return groups of neighbours in the order of values."""
    order = np.argsort(values)
    return np.split(order, range(GROUP_SIZE, len(values), GROUP_SIZE))
