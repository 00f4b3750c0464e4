"""Tilts, metrics of frames and their logarithms against decompositions, and covers of shapes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import (
    Array,
    affine_shapes,
    classes,
    compose_affine,
    scales,
    tilt_distance,
    turns,
)

from colmap_affrect.geometry.tilts import (
    IDENTITY_LABEL,
    NUM_AT_ONCE,
    UNCOVERED_LABEL,
    _in_balls,
    are_individual_shapes,
    ball_threshold,
    cosh_distances,
    cover_shapes,
    covering_grid,
    log_metrics,
    metrics_from_log,
    metrics_from_tilts,
    nearest_centers,
    rectifying_metrics,
    tilts_from_metrics,
    unit_metrics,
)

ARCCOSH_ROUNDING = 1e-6
"""arccosh(1 + e) = sqrt(2 e): rounding of 1e-13 in cosh d is 5e-7 in d."""

RADIUS = 1.7
MAX_TILT = 5.8

Class = tuple[float, float]


def transition_tilt(matrix1: Array, matrix2: Array) -> float:
    """Ratio of the singular values of M1 M2^-1: the definition of the transition tilt."""
    singular = np.linalg.svd(matrix1 @ np.linalg.inv(matrix2), compute_uv=False)
    return float(singular[0] / singular[1])


def random_classes(seed: int, count: int, max_tilt: float) -> tuple[Array, Array]:
    """Classes whose log tilts and angles are uniform."""
    rng = np.random.default_rng(seed)
    return max_tilt ** rng.random(count), np.pi * rng.random(count)


@given(classes(), classes(), scales, scales, turns, turns)
def test_tilt_distance_is_the_log_of_the_transition_tilt_by_svd(
    class1: Class, class2: Class, scale1: float, scale2: float, psi1: float, psi2: float
) -> None:
    matrix1 = compose_affine(scale1, psi1, *class1)
    matrix2 = compose_affine(scale2, psi2, *class2)
    expected = transition_tilt(matrix1, matrix2)
    assert_allclose(
        np.exp(tilt_distance(*class1, *class2)), expected, rtol=ARCCOSH_ROUNDING
    )


def test_unit_metrics_hold_s11_s22_s12_of_the_gram_matrix() -> None:
    matrix = np.array([[2.0, 1.0], [0.0, 3.0]])
    # M^T M = [[4, 2], [2, 10]], det M = 6.
    assert_allclose(unit_metrics(matrix), [4 / 6, 10 / 6, 2 / 6])


@given(affine_shapes())
def test_tilts_from_metrics_name_the_class_of_the_map(matrix: Array) -> None:
    tilt, angle = tilts_from_metrics(unit_metrics(matrix))
    singular = np.linalg.svd(matrix, compute_uv=False)
    assert_allclose(tilt, singular[0] / singular[1], rtol=ARCCOSH_ROUNDING)
    assert 0.0 <= angle < np.pi
    same_class = compose_affine(1.0, 0.0, tilt, angle)
    assert_allclose(transition_tilt(matrix, same_class), 1.0, atol=1e-5)


@pytest.mark.parametrize(("tilt", "half_width_deg"), [(2.0, 20.97), (3.9507, 8.35)])
def test_ball_of_1_7_has_the_angular_half_width_of_the_paper(
    tilt: float, half_width_deg: float
) -> None:
    accuracy_deg = 0.005  # the oracle has two decimals
    inside = tilt_distance(tilt, np.deg2rad(half_width_deg - accuracy_deg), tilt, 0.0)
    outside = tilt_distance(tilt, np.deg2rad(half_width_deg + accuracy_deg), tilt, 0.0)
    assert inside < np.log(RADIUS) < outside


def test_covering_grid_and_identity_cover_the_disc_up_to_5_8() -> None:
    tilts, angles = np.meshgrid(
        np.geomspace(1.0, MAX_TILT, 160), np.linspace(0.0, np.pi, 257), indexing="ij"
    )
    labels = nearest_centers(
        metrics_from_tilts(tilts.ravel(), angles.ravel()), covering_grid(), RADIUS
    )
    assert np.count_nonzero(labels == UNCOVERED_LABEL) == 0


@given(
    st.integers(0, 10_000),
    st.integers(1, 60),
    st.floats(0.5, 1.0),
    st.integers(0, 6),
    st.floats(1.2, 2.5),
)
def test_cover_shapes_covers_the_share_asked_for_or_reaches_a_limit(
    seed: int, count: int, covered_frac: float, max_num_centers: int, radius: float
) -> None:
    tilts, angles = random_classes(seed, count, MAX_TILT)
    metrics = metrics_from_tilts(tilts, angles)
    limits = {"covered_frac": covered_frac, "max_num_centers": max_num_centers}
    cover = cover_shapes(
        metrics, np.ones(count), radius=radius, max_tilt=MAX_TILT, **limits
    )
    references = [(1.0, 0.0), *cover.centers]
    distances = np.array(
        [[tilt_distance(t, a, *reference) for reference in references]
         for t, a in zip(tilts, angles, strict=True)]
    )  # fmt: skip
    covered = distances.min(axis=1) < np.log(radius)
    np.testing.assert_array_equal(cover.labels != UNCOVERED_LABEL, covered)
    chosen = np.where(cover.labels == IDENTITY_LABEL, 0, cover.labels + 1)[covered]
    assert_allclose(
        distances[covered, chosen],
        distances[covered].min(axis=1),
        atol=ARCCOSH_ROUNDING,
    )
    assert len(cover.centers) <= max_num_centers
    reachable = cosh_distances(metrics, metrics_from_tilts(*covering_grid().T))
    hopeless = ~covered & (reachable.min(axis=1) >= ball_threshold(radius))
    enough = np.count_nonzero(covered) >= covered_frac * count - 1e-6
    stuck = np.count_nonzero(hopeless) == np.count_nonzero(~covered)
    assert enough or len(cover.centers) == max_num_centers or stuck


def cover_with_defaults(
    tilts: list[float], angles: list[float], weights: list[float]
) -> Array:
    """Centres that cover all votes with at most 8 balls of 1.7."""
    cover = cover_shapes(
        metrics_from_tilts(tilts, angles),
        np.array(weights),
        radius=RADIUS,
        max_tilt=MAX_TILT,
        covered_frac=1.0,
        max_num_centers=8,
    )
    return cover.centers


def test_cover_shapes_takes_the_heaviest_votes_first() -> None:
    centers = cover_with_defaults([3.0, 3.0, 3.0], [0.5, 0.5, 2.0], [1.0, 1.0, 5.0])
    assert len(centers) == 2
    assert tilt_distance(*centers[0], 3.0, 2.0) < np.log(RADIUS)
    assert tilt_distance(*centers[1], 3.0, 0.5) < np.log(RADIUS)


@pytest.mark.parametrize(("tilts", "angles", "weights"), [
    ([1.0, 1.4, 1.69], [0.0, 0.9, 2.5], [1.0, 1.0, 1.0]),
    ([5.9, 7.0, 1.0], [0.5, 0.5, 0.0], [9.0, 9.0, 1.0]),
    ([], [], []),
], ids=["near the identity", "beyond the largest tilt", "nothing"])  # fmt: skip
def test_cover_shapes_needs_no_center(
    tilts: list[float], angles: list[float], weights: list[float]
) -> None:
    assert len(cover_with_defaults(tilts, angles, weights)) == 0


SINGLE = 1e-5
"""Relative: logarithms are kept in single precision."""


def matrices(metrics: Array) -> Array:
    """Symmetric (..., 2, 2) matrices of (..., 3) entries (S11, S22, S12)."""
    s11, s22, s12 = np.moveaxis(metrics, -1, 0)
    return np.stack([np.stack([s11, s12], -1), np.stack([s12, s22], -1)], -2)


@given(affine_shapes())
def test_rectifying_metrics_are_those_of_the_inverse(shape: Array) -> None:
    expected = unit_metrics(np.linalg.inv(shape))
    assert_allclose(rectifying_metrics(shape), expected, rtol=1e-9, atol=1e-9)


@given(classes(), st.floats(1e-3, 1e3))
def test_log_metrics_are_matrix_logarithms_whatever_the_scale(
    shape: Class, scale: float
) -> None:
    metric = metrics_from_tilts(*shape)
    values, vectors = np.linalg.eigh(matrices(metric))
    expected = vectors @ np.diag(np.log(values)) @ vectors.T
    l11, l12 = log_metrics(scale * metric)
    assert_allclose([[l11, l12], [l12, -l11]], expected, atol=SINGLE)


def test_log_metrics_of_stripes_and_of_nothing_are_finite() -> None:
    stripes, nothing = log_metrics(np.array([[5.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    assert_allclose(nothing, 0.0)
    assert np.isfinite(stripes).all()
    tilt, _ = tilts_from_metrics(metrics_from_log(stripes))
    assert 40.0 < tilt < 50.0


def test_circles_that_a_warp_made_ellipses_are_no_shapes_of_their_own() -> None:
    ellipses = np.tile(np.diag([2.0, 0.5]), (100, 1, 1))
    radii = np.linspace(3.0, 30.0, 100)[:, None, None]
    rounding = 1.5e-5 * np.random.default_rng(1).uniform(-1.0, 1.0, (100, 2, 2))
    assert not are_individual_shapes(radii * (ellipses + rounding))


@pytest.mark.parametrize(("share", "expected"), [(0.3, False), (0.8, True)])
def test_most_shapes_that_were_measured_one_by_one_differ(
    share: float, expected: bool
) -> None:
    shapes = np.tile(np.diag([2.0, 0.5]), (1000, 1, 1))
    num_measured = int(share * 1000)
    # Steps of 3e-4 of shapes of unit area.
    shapes[:num_measured, 1, 0] = 3e-4 * np.arange(num_measured)
    assert are_individual_shapes(shapes) == expected


def test_blocks_of_metrics_change_no_ball() -> None:
    random = np.random.default_rng(0)
    num = 2 * NUM_AT_ONCE + 5
    metrics = metrics_from_tilts(
        random.uniform(1.0, 6.0, num), random.uniform(0.0, np.pi, num)
    )
    centers = metrics_from_tilts(*covering_grid().T)
    threshold = ball_threshold(1.7)
    in_ball = _in_balls(centers, metrics, threshold)
    assert 0 < in_ball[:, -5:].sum() < in_ball[:, -5:].size
    np.testing.assert_array_equal(in_ball, cosh_distances(centers, metrics) < threshold)


def test_shapes_without_a_tilt_are_covered_from_the_start() -> None:
    """Of a hundred shapes 97 or 90 are not tilted, and 95 are to be covered."""
    for num_tilted, num_centers in ((3, 0), (10, 1)):
        tilts = np.repeat([1.0, 4.0], [100 - num_tilted, num_tilted])
        cover = cover_shapes(
            metrics_from_tilts(tilts, np.full(100, 0.5)),
            np.ones(100),
            radius=RADIUS,
            max_tilt=5.8,
            covered_frac=0.95,
            max_num_centers=8,
        )
        assert len(cover.centers) == num_centers
