"""OpenCV's SIFT: RootSIFT descriptors, DoG keypoints for networks, order, mask, odd images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import blobs, texture

from colmap_affrect.data import GrayImage, LocalFeatures
from colmap_affrect.features.sift import DogOptions, RootSift, SiftOptions, detect_dog
from colmap_affrect.geometry.conventions import MEASUREMENT_SIGMAS

FLOAT32_ROUNDING = 1e-6

CENTER_PX = 0.05
"""OpenCV refines centres by a parabola; with its precise upscaling it is this near."""

DOG_SIGMA = 2 ** (-1 / 6)
"""OpenCV gives a difference of Gaussians the sigma of the narrower one; of two that are a third
of an octave apart, the middle answers to a blob of its size."""

SCALE_BAND = 0.03
"""Relative: scales are interpolated between levels a third of an octave apart."""


def rootsift(
    image: GrayImage, mask: np.ndarray | None = None, **options: Any
) -> LocalFeatures:
    return RootSift(SiftOptions(**options)).detect((image, mask))


def dog(
    image: GrayImage, mask: np.ndarray | None = None, **options: Any
) -> LocalFeatures:
    return detect_dog(image, DogOptions(**options), mask)


@pytest.fixture(scope="module")
def image() -> GrayImage:
    """A textured image that is not square."""
    return texture((210, 140), seed=7)


def test_rootsift_orders_by_response_and_keeps_the_largest_responses_times_scales(
    image: GrayImage,
) -> None:
    everything = rootsift(image)
    assert (np.diff(everything.responses) <= 0.0).all()
    assert (everything.responses > 0.0).all()
    some = rootsift(image, max_num_features=37)
    strengths = everything.responses * everything.scales
    kept = strengths >= np.sort(strengths)[-37]
    assert len(some) == kept.sum() == 37
    assert not kept[:37].all(), "neither those of the largest responses"
    assert not (everything.scales[kept].min() >= everything.scales[~kept]).all(), (
        "nor scales"
    )
    assert_array_equal(some.responses, everything.responses[kept])
    assert_array_equal(some.lafs, everything.lafs[kept])


def test_dog_finds_each_location_of_rootsift_once(image: GrayImage) -> None:
    found = dog(image)
    oriented = rootsift(image)
    assert len(found) > 100
    assert len(oriented) > len(found), "some locations have several orientations"
    locations = np.column_stack([found.keypoints, found.scales])
    assert len(np.unique(locations, axis=0)) == len(found)
    expected = np.column_stack([oriented.keypoints, oriented.scales])
    assert_allclose(
        np.unique(np.round(locations, 6), axis=0),
        np.unique(np.round(expected, 6), axis=0),
    )


def test_dog_of_a_round_blob_gives_one_upright_circle_of_six_sigma() -> None:
    center = [60.25, 50.5]
    sigma_px = 6.0
    found = dog(blobs((121, 101), [center], sigma_px * np.eye(2)))
    assert len(found) == 1
    assert_allclose(found.keypoints[0], center, atol=CENTER_PX)
    assert_allclose(
        found.scales[0], MEASUREMENT_SIGMAS * DOG_SIGMA * sigma_px, rtol=SCALE_BAND
    )
    assert_allclose(found.lafs[0, :, :2], found.scales[0] * np.eye(2), rtol=1e-12)


def test_descriptors_are_roots_of_shares_of_those_of_opencv(image: GrayImage) -> None:
    sift = cv2.SIFT.create(contrastThreshold=0.013, enable_precise_upscale=True)
    keypoints, rows = sift.detectAndCompute(image, None)
    order = np.argsort([-keypoint.response for keypoint in keypoints], kind="stable")
    shares = rows[order] / rows[order].sum(axis=1, keepdims=True)
    assert_allclose(rootsift(image).descriptors, np.sqrt(shares), atol=FLOAT32_ROUNDING)
