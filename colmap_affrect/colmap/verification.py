"""Geometric verification of the raw matches of a pair by pycolmap, and its significance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.two_views import (
    Cameras,
    Keypoints,
    significance,
    telling_shapes,
)
from colmap_affrect.geometry.affine import homography_errors
from colmap_affrect.geometry.arrays import Array, Floats, Singles
from colmap_affrect.geometry.neighbors import num_consistent_matches
from colmap_affrect.geometry.parallax import text_line_matches
from colmap_affrect.options import MAX_SEED, PresetOptions, within

Matches = NDArray[np.integer]  # (M, 2), rows of the features of each image of a pair

# Of the inliers on a line of writing; where more are, they made it; judged
MAX_WRITTEN_SHARE = 0.15
# Raw matches that agree with their neighbours, below which a pair shows nothing in common: 256
# verified pairs of six scenes had 10 at least, 90 per cent of 374 others had fewer; measured
MIN_CONSISTENT = 4
# Samples that RANSAC draws at most for a pair that shows nothing in common; resource
NUM_TRIALS_IN_VAIN = 1000
# The same where no match at all agrees with its neighbours, as in 246 of 407 rejected pairs of
# seven scenes; each of 826 verified ones had seven that do; measured
NUM_TRIALS_OF_NOTHING = 100
# COLMAP's is 3. With 1, 361 right pairs of seven scenes are verified as before, with 99.95 per
# cent of their right inliers, in 0.8 of the time; measured
TRIALS_PER_NEEDED_TRIAL = 1.0
# COLMAP's. A sample without wrong matches is not yet an exact one, and few inliers do not make up
# for that: of 40 pairs with fewer than 60 it finds 0.7 per cent more of the right matches, of 66
# with more 0.03 per cent; measured
TRIALS_OF_FEW_INLIERS = 3.0
MAX_FEW_INLIERS = 60  # measured
# Raw matches. With fewer, inliers are many only where they are more than half: such pairs are
# searched by all samples at once, instead of by few and then by all. Of 300 verified pairs of four
# scenes none is lost, in 0.83 of the time; measured
MAX_FEW_MATCHES = 2 * MAX_FEW_INLIERS
# Largest of the shares of inliers that samples must suffice for: by it a hundred homographies
# are drawn, the fewest that COLMAP draws for any pair; theory
MAX_LEAST_SHARE = 0.5
# Raw matches; with more, a pair is searched in any case; resource
MAX_NUM_LOOKED_AT = 300


class VerificationOptions(PresetOptions):
    """Two-view geometry, by default the sparse preset (names as in pycolmap)."""

    max_error_px: Annotated[float, within(0.01, 1000.0)] = 3.0  # judged
    """Largest error of an inlier."""
    scale_max_error: bool = True
    """Whether ``max_error_px`` counts pixels of photographs as they were when features were
    extracted, shrunk to ``max_image_size_px`` of the recipe; else those of the files."""
    min_num_inliers: Annotated[int, within(5, 1_000_000)] = 15  # COLMAP's
    """Fewest inliers of a verified pair."""
    min_inlier_ratio: Annotated[float, within(0.0, 1.0)] = 0.0
    """Share of the raw matches; those that are wrong say little about the others."""
    min_significance: Annotated[float, within(0.0, 1e9)] = 5.0  # theory
    """Chance would need 10 to the power of this many pairs to have one that looks as good: by the
    number of its inliers among so many raw matches, and by the share of them whose local affine
    frames agree with the geometry. With 5, all pairs of 450 unrelated photographs have about one. 0
    accepts what COLMAP accepts."""
    max_num_trials: Annotated[int, within(1, 100_000_000)] = 10000  # COLMAP's
    """Most samples that RANSAC draws for a pair."""
    ransac_min_inlier_ratio: Annotated[float, within(0.0, 1.0)] = 0.10  # resource
    """Smallest share of inliers that RANSAC draws enough samples for."""
    random_seed: Annotated[int, within(-1, MAX_SEED)] = 0
    """Of the samples; -1: another one each time."""

    COLMAP: ClassVar[Mapping[str, Any]] = {
        "max_error_px": 4.0,
        "scale_max_error": False,
        "min_significance": 0.0,
        "ransac_min_inlier_ratio": 0.25,
    }


REJECTED = (
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
)


def two_view_options(options: VerificationOptions) -> pycolmap.TwoViewGeometryOptions:
    """Translate our options into pycolmap's."""
    return pycolmap.TwoViewGeometryOptions(
        min_num_inliers=options.min_num_inliers,
        min_inlier_ratio=options.min_inlier_ratio,
        ransac=dict(
            max_error=options.max_error_px,
            min_inlier_ratio=options.ransac_min_inlier_ratio,
            max_num_trials=options.max_num_trials,
            random_seed=options.random_seed,
        ),
    )


@dataclass(frozen=True)
class Side:
    """One image of a pair: its camera and (N, 2, 4 or 6) keypoints as in the database."""

    camera: pycolmap.Camera
    keypoints: Singles


def estimate_geometry(
    sides: tuple[Side, Side],
    matches: Matches,
    options: VerificationOptions,
    extracted_px: int | None = None,
) -> pycolmap.TwoViewGeometry:
    """Return the two-view geometry of raw matches; an empty one if it is rejected.

    Matches of writing are left out where they are many.

    Args:
        sides: the two images, that of the smaller id first.
        matches: (M, 2) numbers of keypoints.
        options: of verification.
        extracted_px: longest side that photographs were shrunk to before extraction, if any.
    """
    cameras = (sides[0].camera, sides[1].camera)
    chosen = options.changed(max_error_px=max_error_px(cameras, options, extracted_px))
    matched1 = sides[0].keypoints[matches[:, 0]]
    matched2 = sides[1].keypoints[matches[:, 1]]
    matched = (matched1, matched2)
    geometry = _significant_geometry(cameras, matched, chosen)
    if geometry is None:
        return pycolmap.TwoViewGeometry()
    inliers = np.asarray(geometry.inlier_matches)[:, 0]
    if options.min_significance:
        written = text_line_matches(
            _positions(matched1)[inliers],
            _positions(matched2)[inliers],
            sizes=(_size(cameras[0]), _size(cameras[1])),
        )
        if written.mean() > MAX_WRITTEN_SHARE:
            scene = np.delete(matches, inliers[written], axis=0)
            return estimate_geometry(sides, scene, options, extracted_px)
    geometry.inlier_matches = matches.astype(np.uint32)[inliers]
    return geometry


def _significant_geometry(
    cameras: Cameras, keypoints: Keypoints, options: VerificationOptions
) -> pycolmap.TwoViewGeometry | None:
    """Return the two-view geometry of keypoints, of which those of a row match.

    Pairs with few inliers are searched by more samples. The inliers are rows, twice. None where
    there are too few of them, or chance made them.
    """
    search = _search_options(keypoints, options)
    has_few_matches = len(keypoints[0]) < MAX_FEW_MATCHES
    if has_few_matches and options.min_significance:
        search.ransac.dyn_num_trials_multiplier = TRIALS_OF_FEW_INLIERS
        return _searched_geometry(cameras, keypoints, options, search)
    geometry = _searched_geometry(cameras, keypoints, options, search)
    if geometry is None or not options.min_significance:
        return geometry
    if len(geometry.inlier_matches) >= MAX_FEW_INLIERS:
        return geometry
    # With a seed: the same samples, and others after them
    search.ransac.dyn_num_trials_multiplier = TRIALS_OF_FEW_INLIERS
    return _searched_geometry(cameras, keypoints, options, search) or geometry


def _searched_geometry(
    cameras: Cameras,
    keypoints: Keypoints,
    options: VerificationOptions,
    search: pycolmap.TwoViewGeometryOptions,
) -> pycolmap.TwoViewGeometry | None:
    """Return what one search finds, as :func:`_significant_geometry` does."""
    num_matches = len(keypoints[0])
    rows = _twice(np.arange(num_matches, dtype=np.uint32))
    points = (_positions(keypoints[0]), _positions(keypoints[1]))
    geometry = pycolmap.estimate_two_view_geometry(
        cameras[0], points[0], cameras[1], points[1], rows, search
    )
    min_num_inliers = max(
        options.min_num_inliers, options.min_inlier_ratio * num_matches
    )
    # Of a geometry that it rejects the estimator returns the inliers all the same.
    if geometry.config in REJECTED or len(geometry.inlier_matches) < min_num_inliers:
        return None

    def is_chance(found: pycolmap.TwoViewGeometry) -> bool:
        of_chance = significance(found, cameras, keypoints, options.max_error_px)
        return of_chance < options.min_significance

    if not options.min_significance or not is_chance(geometry):
        return geometry
    planar = _planar_geometry(geometry, points, options)
    if len(planar.inlier_matches) < min_num_inliers or is_chance(planar):
        return None
    return planar


def _search_options(
    keypoints: Keypoints, options: VerificationOptions
) -> pycolmap.TwoViewGeometryOptions:
    """Return pycolmap's options for a pair, so that the search ends when it is sure enough.

    COLMAP draws several times as many samples as its confidence asks for, and those of few
    matches for a smaller share of inliers than any pair is verified with.
    """
    num_matches = len(keypoints[0])
    search = two_view_options(_without_vain_trials(keypoints, options))
    if options.min_significance and num_matches:
        least_share = min(options.min_num_inliers / num_matches, MAX_LEAST_SHARE)
        search.ransac.min_inlier_ratio = max(
            search.ransac.min_inlier_ratio, least_share
        )
        search.ransac.dyn_num_trials_multiplier = TRIALS_PER_NEEDED_TRIAL
    return search


def _without_vain_trials(
    keypoints: Keypoints, options: VerificationOptions
) -> VerificationOptions:
    """Return the options, with fewer trials for a pair that shows nothing in common.

    Those pairs take all trials, which is most of the time of verification: a geometry with many
    inliers ends the search by itself.
    """
    num_matches = len(keypoints[0])
    is_looked_at = options.min_num_inliers <= num_matches <= MAX_NUM_LOOKED_AT
    if not (is_looked_at and options.min_significance):
        return options
    num_consistent = num_consistent_keypoints(keypoints)
    if num_consistent is None or num_consistent >= MIN_CONSISTENT:
        return options
    most = NUM_TRIALS_IN_VAIN if num_consistent else NUM_TRIALS_OF_NOTHING
    return options.changed(max_num_trials=min(options.max_num_trials, most))


def num_consistent_keypoints(keypoints: Keypoints) -> int | None:
    """Return how many matches agree with matches beside them.

    Args:
        keypoints: of both images, (N, 2, 4 or 6), of which those of a row match.

    Returns:
        Their number; None where the keypoints have no shapes that tell it.
    """
    first = telling_shapes(keypoints[0])
    second = telling_shapes(keypoints[1])
    if first is None or second is None:
        return None
    frames1 = np.concatenate([first, _positions(keypoints[0])[:, :, None]], axis=2)
    frames2 = np.concatenate([second, _positions(keypoints[1])[:, :, None]], axis=2)
    return num_consistent_matches(frames1, frames2)


def _positions(keypoints: Floats) -> Array:
    """Return the (N, 2) positions of (N, 2, 4 or 6) keypoints."""
    return keypoints[:, :2].astype(np.float64)


def _size(camera: pycolmap.Camera) -> tuple[int, int]:
    """Return (width, height) of the images of a camera in px."""
    return camera.width, camera.height


def _twice(rows: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return (N,) rows as (N, 2) matches of each with itself."""
    return np.stack([rows, rows], axis=1)


def _planar_geometry(
    geometry: pycolmap.TwoViewGeometry,
    points: tuple[Array, Array],
    options: VerificationOptions,
) -> pycolmap.TwoViewGeometry:
    """Return the homography of the inliers of an epipolar geometry, with all matches it explains.

    Of few matches on a plane it can be significant where epipolar lines, which also hold wrong
    matches by chance, are not.
    """
    rows = np.asarray(geometry.inlier_matches, np.int64)[:, 0]
    found: Any = pycolmap.estimate_homography_matrix(
        points[0][rows], points[1][rows], two_view_options(options).ransac
    )
    planar = pycolmap.TwoViewGeometry()
    if found is None:
        return planar
    planar.config = pycolmap.TwoViewGeometryConfiguration.PLANAR_OR_PANORAMIC
    planar.H = found["H"]
    with np.errstate(all="ignore"):  # points on the horizon are no inliers
        inliers = np.flatnonzero(
            homography_errors(planar.H, *points) <= options.max_error_px
        )
    planar.inlier_matches = _twice(inliers.astype(np.uint32))
    return planar


def max_error_px(
    cameras: Sequence[pycolmap.Camera],
    options: VerificationOptions,
    extracted_px: int | None,
) -> float:
    """Return the largest error of an inlier of a pair, in px of the stored images.

    Args:
        cameras: of the two images; the mean of their thresholds counts.
        options: of verification.
        extracted_px: longest side that photographs were shrunk to before extraction, if any.
    """
    if not (options.scale_max_error and extracted_px):
        return options.max_error_px
    scales = [max(camera.width, camera.height) / extracted_px for camera in cameras]
    return options.max_error_px * float(np.mean(np.maximum(scales, 1.0)))
