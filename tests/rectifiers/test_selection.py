"""Which features of a photograph and of its warps stay, and where warps are masked."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from strategies import Array

from colmap_affrect.data import LocalFeatures, Rectification
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.geometry.lines import Explanation
from colmap_affrect.rectifiers.affine_warps import DenseShapesOptions
from colmap_affrect.rectifiers.execute import (
    _keep_strongest,
    _warped_mask,
    is_in_warp,
)
from colmap_affrect.rectifiers.line_planes import camera_matrix_of
from colmap_affrect.rectifiers.regions import Region


def features_at(points: Array, radii_px: Array, responses: Array) -> LocalFeatures:
    lafs = lafs_from_keypoints(points, radii_px, np.zeros(len(points)))
    descriptors = np.ones((len(points), 4), np.float32)
    return LocalFeatures(lafs, responses.astype(np.float32), descriptors)


def test_features_of_largest_responses_stay_of_all_warps_together() -> None:
    """The strongest one does not belong to its part of the image."""
    views = []
    for responses in ([5.0, 1.0, 9.0], [3.0, 4.0]):
        number = len(responses)
        views.append(
            features_at(np.zeros((number, 2)), np.ones(number), np.array(responses))
        )
    keep = [np.array([True, True, False]), np.array([True, True])]
    _keep_strongest(keep, views, 2)
    assert [kept.tolist() for kept in keep] == [[True, False, False], [False, True]]


@pytest.mark.parametrize(
    ("radius_px", "distance_px", "ratio", "is_same"),
    [
        (12.0, 0.8, 1.0, True),  # half a sigma of the feature is 1 px
        (12.0, 1.5, 1.0, False),
        (36.0, 1.5, 1.0, True),
        (12.0, 0.0, 1.2, True),
        (12.0, 0.0, 0.85, True),
        (12.0, 0.0, 1.5, False),
        (12.0, 0.0, 0.6, False),
    ],
)
def test_a_warp_has_a_feature_too_within_half_of_its_sigma_and_at_its_scale(
    radius_px: float, distance_px: float, ratio: float, *, is_same: bool
) -> None:
    """Another feature of the photograph is large, and far away."""
    points = np.array([[50.0, 40.0], [500.0, 400.0]])
    original = features_at(points, np.array([radius_px, 60.0]), np.ones(2))
    beside = np.array([[50.0 + distance_px, 40.0]])
    rectified = features_at(beside, np.array([ratio * radius_px]), np.ones(1))
    assert is_in_warp(original, rectified).tolist() == [is_same, False]


def test_a_warp_is_masked_outside_of_its_region_and_where_the_photograph_is() -> None:
    """The warp leaves an image of 100 x 60 px as it is; its region begins at (30, 10)."""
    region = np.ones((20, 60), bool)
    rectification = Rectification(
        np.eye(3), (100, 60), region, 1.0, 0.0, region_origin=(30, 10)
    )
    mask = np.ones((60, 100), bool)
    mask[:, 80:] = False
    mask[25:] = False
    found = _warped_mask(rectification, mask, (60, 100))
    inside = found > 0
    assert inside.shape == (60, 100)
    for x, y, expected in (
        (40, 15, True),
        (75, 15, True),
        (85, 15, False),
        (40, 27, False),
        (20, 15, False),
        (40, 5, False),
    ):
        assert inside[y, x] == expected


def test_a_warp_of_a_whole_photograph_is_masked_where_that_is() -> None:
    whole = Rectification(np.eye(3), (100, 60), None, 1.0, 0.0)
    mask = np.ones((60, 100), bool)
    mask[:, 80:] = False
    inside = _warped_mask(whole, mask, (60, 100)) > 0
    assert inside.tolist() == mask.tolist()


def test_a_camera_by_lines_has_its_axis_as_far_below_the_middle_as_lines_say() -> None:
    explanation = Explanation(1.5, 0.1, np.eye(3), np.zeros(0, np.int64), 9.0)
    expected = [[300.0, 0.0, 99.5], [0.0, 300.0, 49.5 + 20.0], [0.0, 0.0, 1.0]]
    assert_allclose(camera_matrix_of(explanation, (200, 100)), expected)


@pytest.mark.parametrize(("area_preserving", "area"), [(True, 1.0), (False, 0.25)])
def test_warps_keep_the_area_or_magnify_nothing_as_it_is_asked_for(
    area_preserving: bool, area: float
) -> None:
    region = Region(np.ones((30, 40), bool), (5, 7))
    options = DenseShapesOptions(area_preserving=area_preserving)
    item = options.warp(region, 4.0, 0.3, 2)
    linear = item.rectified_from_image[:2, :2]
    assert np.linalg.det(linear) == pytest.approx(area)
    assert np.linalg.svd(linear)[1] == pytest.approx([2.0 * area**0.5, 0.5 * area**0.5])
