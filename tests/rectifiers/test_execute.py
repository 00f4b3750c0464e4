"""Features of rectifying warps: where they lie in the image, which are kept, what they gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from strategies import Array
from synthetic import blobs, texture

from colmap_affrect.data import LocalFeatures, Mask, Rectification, RectificationPlan
from colmap_affrect.features.sift import RootSift, SiftOptions
from colmap_affrect.geometry.affine import (
    ellipse_extents,
    fit_canvas,
    lafs_from_keypoints,
    rectifying_affine,
)
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS, is_inside
from colmap_affrect.rectifiers.execute import extract_rectified, is_in_warp

KEYPOINT_ERROR_PX = 0.1
BIAS_PX = 0.05
"""Mean error of a warp's keypoints, which the map's own error (centroids) bounds."""

MAPS = [(1.0, 0.0), (2.51, 2.6), (5.8, 2.1)]
"""(tilt, angle) of the rectifying maps under test, up to the largest of the paper."""

SIZE = (420, 330)

SIGMA_PX = 4.6
"""Of blobs in warps. At 1.6 * 2^(k/3), e.g. 4.03, SIFT's search for the extremum swings between
two octaves and gives up."""


PROFILE = RootSift(SiftOptions())


def one_warp(
    tilt: float, angle_rad: float, size: tuple[int, int], region: Mask | None = None
) -> RectificationPlan:
    """Plan with one warp of a region, or of the whole image."""
    width, height = size
    region = np.ones((height, width), bool) if region is None else region
    rows, columns = np.nonzero(region)
    matrix, canvas = fit_canvas(
        rectifying_affine(tilt, angle_rad),
        np.column_stack([columns, rows]).astype(float),
        16.0,
    )
    return RectificationPlan(
        size, (Rectification(matrix, canvas, region, tilt, angle_rad),)
    )


def of_warps(features: LocalFeatures) -> LocalFeatures:
    """The features that do not come from the image itself."""
    return features.select(features.rectification_ids > 0)


def keypoint_errors(features: LocalFeatures, centers: Array) -> Array:
    """Error of the keypoint next to each centre, (N, 2) px."""
    distances = np.linalg.norm(features.keypoints[:, None] - centers[None], axis=2)
    return np.asarray(features.keypoints[distances.argmin(axis=0)] - centers)


@pytest.mark.parametrize(("tilt", "angle_rad"), MAPS)
def test_extract_rectified_finds_blobs_of_a_tilted_plane_with_their_place_and_ellipse(
    tilt: float, angle_rad: float
) -> None:
    # Round blobs of a tilted plane: ellipses in the image that the map makes round.
    shape = np.linalg.inv(rectifying_affine(tilt, angle_rad))
    rng = np.random.default_rng(round(10 * tilt))
    xs, ys = np.meshgrid([90.0, 210.0, 330.0], [80.0, 165.0, 250.0])
    centers = np.stack([xs.ravel(), ys.ravel()], axis=1) + rng.uniform(-4, 4, (9, 2))
    image = blobs(SIZE, centers, SIGMA_PX * shape)
    features = of_warps(
        extract_rectified(image, one_warp(tilt, angle_rad, SIZE), PROFILE, 5000)
    )
    errors = keypoint_errors(features, centers)
    assert np.linalg.norm(errors, axis=1).max() < KEYPOINT_ERROR_PX
    assert np.abs(errors.mean(axis=0)).max() < BIAS_PX
    # A A^T does not depend on the orientation; a tenth in scale is a fifth here.
    expected = SIGMA_PX**2 * shape @ shape.T
    for center in centers:
        nearest = np.linalg.norm(features.keypoints - center, axis=1).argmin()
        found = features.lafs[nearest, :, :2] / MEASUREMENT_SIGMAS
        covariance = found @ found.T
        assert_allclose(covariance, expected, atol=0.25 * np.abs(expected).max())
        shape_only = covariance / np.linalg.det(covariance) ** 0.5
        assert_allclose(
            shape_only, expected / np.linalg.det(expected) ** 0.5, atol=1e-6
        )


def test_extract_rectified_rejects_ellipses_that_reach_beyond_the_image() -> None:
    tilt = 3.0
    angle_rad = 0.7
    shape = 3.0 * np.linalg.inv(rectifying_affine(tilt, angle_rad))
    reach = MEASUREMENT_SIGMAS * ellipse_extents(shape[None])[0]
    # A fifth more than the reach is well inside, a fifth less well out, on all four sides.
    width, height = SIZE
    inside = np.array([[1.2 * reach[0], 120.3], [width - 1.2 * reach[0], 190.6],
                       [150.2, 1.2 * reach[1]], [260.7, height - 1.2 * reach[1]]])  # fmt: skip
    outside = np.array([[0.6 * reach[0], 230.4], [width - 0.6 * reach[0], 80.1],
                        [310.2, 0.6 * reach[1]], [90.7, height - 0.6 * reach[1]]])  # fmt: skip
    image = blobs(SIZE, np.concatenate([inside, outside]), shape)
    features = of_warps(
        extract_rectified(image, one_warp(tilt, angle_rad, SIZE), PROFILE, 5000)
    )
    errors = np.linalg.norm(keypoint_errors(features, inside), axis=1)
    assert errors.max() < KEYPOINT_ERROR_PX
    assert np.linalg.norm(keypoint_errors(features, outside), axis=1).min() > 3.0


def test_extract_rectified_replaces_features_of_the_image_that_a_warp_found_again() -> (
    None
):
    image = texture(SIZE, seed=25, finest_sigma_px=2.5)
    original = PROFILE.detect((image, None))
    # A map next to the identity finds nearly all of them again.
    plan = replace(one_warp(1.01, 0.3, SIZE), replaces_original=True)
    union = extract_rectified(image, plan, PROFILE, 100_000)
    kept = union.select(union.rectification_ids == 0)
    rectified = of_warps(union)
    deep = is_inside(
        original.keypoints, SIZE, 1.5 * ellipse_extents(original.lafs[:, :, :2])
    )
    places = {tuple(laf.ravel()) for laf in kept.lafs}
    gone = np.array([tuple(laf.ravel()) not in places for laf in original.lafs])
    assert np.count_nonzero(gone[deep]) > 0.8 * np.count_nonzero(deep)
    # None is lost without another one in its place.
    for laf in original.lafs[gone]:
        assert np.linalg.norm(rectified.keypoints - laf[:, 2], axis=1).min() < 4.0


def test_extract_rectified_keeps_the_features_of_the_image_unless_the_plan_says_otherwise() -> (
    None
):
    image = texture(SIZE, seed=25, finest_sigma_px=2.5)
    original = PROFILE.detect((image, None))
    plan = one_warp(1.01, 0.3, SIZE)
    kept = extract_rectified(image, plan, PROFILE, 100_000)
    assert_allclose(kept.lafs[kept.rectification_ids == 0], original.lafs)
    left = np.zeros((SIZE[1], SIZE[0]), bool)
    left[:, :150] = True
    partly = extract_rectified(
        image, replace(plan, original_region=left), PROFILE, 100_000
    )
    of_image = partly.select(partly.rectification_ids == 0)
    assert (np.rint(of_image.keypoints[:, 0]) < 150).all()
    assert len(of_image) == np.count_nonzero(np.rint(original.keypoints[:, 0]) < 150)
    alone = extract_rectified(image, plan, PROFILE, 100_000, with_original=False)
    assert_allclose(alone.lafs, kept.lafs[kept.rectification_ids == 1])
    assert (alone.rectification_ids == 1).all()


@pytest.mark.parametrize(("offset_sigmas", "is_same"), [(0.3, True), (1.0, False)])
def test_a_feature_of_a_warp_is_the_same_within_half_a_sigma(
    offset_sigmas: float, is_same: bool
) -> None:
    sigma_px = 2.0
    radii = np.array([MEASUREMENT_SIGMAS * sigma_px])
    angles = np.zeros(1)
    found = []
    for x in (50.0, 50.0 + offset_sigmas * sigma_px):
        lafs = lafs_from_keypoints(np.array([[x, 40.0]]), radii, angles)
        descriptors = np.zeros((1, 128), np.float32)
        found.append(LocalFeatures(lafs, np.ones(1, np.float32), descriptors))
    assert is_in_warp(*found).tolist() == [is_same]
