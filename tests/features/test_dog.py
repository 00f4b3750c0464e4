"""DoG keypoints for learned features: one per location, circles of 6 sigma, order, mask."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import blobs, texture

from colmap_affrect.conventions import MEASUREMENT_SIGMAS
from colmap_affrect.features.dog import detect_dog
from colmap_affrect.features.rootsift import RootSift
from colmap_affrect.options import DogOptions, SiftOptions
from colmap_affrect.types import GrayImage

CENTER_PX = 0.05
"""OpenCV refines centres by a parabola; with its precise upscaling it is this near."""

DOG_SIGMA = 2 ** (-1 / 6)
"""OpenCV gives a difference of Gaussians the sigma of the narrower one; of two that are a third
of an octave apart, the middle answers to a blob of its size."""

SCALE_BAND = 0.03
"""Relative: scales are interpolated between levels a third of an octave apart."""


@pytest.fixture(scope="module")
def image() -> GrayImage:
    """A textured image that is not square."""
    return texture((210, 140), seed=7)


def test_detect_dog_finds_each_location_of_rootsift_once(image: GrayImage) -> None:
    found = detect_dog(image, DogOptions())
    oriented = RootSift(SiftOptions()).detect((image, None))
    assert len(found) > 100
    assert len(oriented) > len(found), "some locations have several orientations"
    locations = np.column_stack([found.keypoints, found.scales])
    assert len(np.unique(locations, axis=0)) == len(found)
    expected = np.column_stack([oriented.keypoints, oriented.scales])
    assert_allclose(
        np.unique(np.round(locations, 6), axis=0), np.unique(np.round(expected, 6), axis=0)
    )


def test_detect_dog_of_a_round_blob_gives_one_upright_circle_of_six_sigma() -> None:
    center, sigma_px = [60.25, 50.5], 6.0
    found = detect_dog(blobs((121, 101), [center], sigma_px * np.eye(2)), DogOptions())
    assert len(found) == 1
    assert_allclose(found.keypoints[0], center, atol=CENTER_PX)
    assert_allclose(found.scales[0], MEASUREMENT_SIGMAS * DOG_SIGMA * sigma_px, rtol=SCALE_BAND)
    assert_allclose(found.lafs[0, :, :2], found.scales[0] * np.eye(2), rtol=1e-12)


def test_detect_dog_orders_by_falling_response_and_keeps_the_strongest(image: GrayImage) -> None:
    everything = detect_dog(image, DogOptions())
    assert (np.diff(everything.responses) <= 0.0).all()
    assert (everything.responses > 0.0).all()
    some = detect_dog(image, DogOptions(max_num_features=37))
    assert_array_equal(some.lafs, everything.lafs[:37])
    assert_array_equal(some.responses, everything.responses[:37])


def test_detect_dog_leaves_description_to_others(image: GrayImage) -> None:
    found = detect_dog(image, DogOptions())
    assert found.descriptors.shape == (len(found), 0)


def test_detect_dog_with_a_mask_keeps_keypoints_where_it_is_not_zero(image: GrayImage) -> None:
    mask = np.zeros(image.shape, np.uint8)
    mask[30:90, 100:180] = 255
    masked = detect_dog(image, DogOptions(), mask)
    columns, rows = np.rint(masked.keypoints).astype(int).T
    assert len(masked) > 10
    assert (mask[rows, columns] > 0).all()


def test_detect_dog_with_an_empty_mask_or_a_flat_image_finds_nothing(image: GrayImage) -> None:
    assert len(detect_dog(image, DogOptions(), np.zeros(image.shape, np.uint8))) == 0
    assert len(detect_dog(np.full((90, 70), 128, np.uint8), DogOptions())) == 0


@pytest.mark.parametrize("size", [(1, 1), (300, 1), (1, 300), (7, 200), (8, 8), (9, 300), (33, 17)])
def test_detect_dog_of_tiny_and_thin_images_does_not_fail(size: tuple[int, int]) -> None:
    found = detect_dog(texture(size, seed=1)[: size[1], : size[0]], DogOptions())
    assert found.inside(size).all()
    assert found.descriptors.shape == (len(found), 0)
    if min(size) < 8:
        assert len(found) == 0
