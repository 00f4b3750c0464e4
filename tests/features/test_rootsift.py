"""Feature profile ``rootsift``: descriptors, order, mask and degenerate images."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import blobs, texture

from colmap_affrect.features.rootsift import RootSift, root_normalized
from colmap_affrect.options import SiftOptions
from colmap_affrect.types import GrayImage, LocalFeatures

FLOAT32_ROUNDING = 1e-6

DESCRIPTOR_SIZE = 128


def detect(image: GrayImage, mask: np.ndarray | None = None, **options: float) -> LocalFeatures:
    return RootSift(SiftOptions(**options)).detect((image, mask))


@pytest.fixture(scope="module")
def image() -> GrayImage:
    """A textured image that is not square."""
    return texture((210, 140), seed=7)


def test_detect_describes_by_roots_of_shares(image: GrayImage) -> None:
    features = detect(image)
    assert len(features) > 100
    assert features.descriptors.shape == (len(features), DESCRIPTOR_SIZE)
    assert features.descriptors.dtype == np.float32
    assert features.descriptors.min() >= 0.0
    assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1.0, atol=FLOAT32_ROUNDING)


def test_detect_orders_by_falling_response_and_keeps_the_strongest(
    image: GrayImage,
) -> None:
    everything = detect(image)
    assert (np.diff(everything.responses) <= 0.0).all()
    assert (everything.responses > 0.0).all()
    some = detect(image, max_num_features=37)
    strengths = everything.responses * everything.scales
    kept = strengths >= np.sort(strengths)[-37]
    assert len(some) == kept.sum() == 37
    assert not kept[:37].all(), "neither those of the largest responses"
    assert not (everything.scales[kept].min() >= everything.scales[~kept]).all(), "nor scales"
    assert_array_equal(some.responses, everything.responses[kept])
    assert_array_equal(some.lafs, everything.lafs[kept])


def test_detect_twice_gives_the_same_features(image: GrayImage) -> None:
    first, second = (detect(image) for _ in range(2))
    np.testing.assert_array_equal(first.lafs, second.lafs)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


def test_detect_frames_are_similarities_inside_the_image(image: GrayImage) -> None:
    features = detect(image)
    shapes = features.lafs[:, :, :2] / features.scales[:, None, None]
    assert_allclose(shapes @ np.swapaxes(shapes, 1, 2), np.tile(np.eye(2), (len(shapes), 1, 1)),
                    atol=1e-9)  # fmt: skip
    assert features.inside((210, 140)).all()
    assert features.keypoints[:, 0].max() > 140, "x is not bound by the height"


def test_detect_with_a_mask_keeps_the_features_where_it_is_not_zero(
    image: GrayImage,
) -> None:
    mask = np.zeros(image.shape, np.uint8)
    mask[30:90, 100:180] = 255
    masked = detect(image, mask)
    everything = detect(image)
    columns, rows = np.rint(masked.keypoints).astype(int).T
    assert len(masked) > 10
    assert (mask[rows, columns] > 0).all()
    deep = (np.abs(everything.keypoints - [139.5, 59.5]) < [38, 28]).all(axis=1)
    assert len(masked) >= np.count_nonzero(deep)


def test_detect_with_an_empty_mask_finds_nothing(image: GrayImage) -> None:
    assert len(detect(image, np.zeros(image.shape, np.uint8))) == 0


@pytest.mark.parametrize("size", [(1, 1), (300, 1), (1, 300), (7, 200), (8, 8), (9, 300), (33, 17)])
def test_detect_of_tiny_and_thin_images_does_not_fail(size: tuple[int, int]) -> None:
    features = detect(texture(size, seed=1)[: size[1], : size[0]])
    assert features.inside(size).all()
    assert features.descriptors.shape == (len(features), DESCRIPTOR_SIZE)
    if min(size) < 8:
        assert len(features) == 0


def test_detect_of_a_flat_image_finds_nothing() -> None:
    assert len(detect(np.full((90, 70), 128, np.uint8))) == 0


def test_detect_keeps_every_orientation_of_one_location() -> None:
    # A round blob has a flat histogram of directions, hence several peaks.
    features = detect(blobs((121, 101), [[60.0, 50.0]], 6.0 * np.eye(2)))
    near = np.linalg.norm(features.keypoints - [60.0, 50.0], axis=1) < 0.5
    assert np.count_nonzero(near) >= 2


def test_detect_with_a_lower_contrast_threshold_finds_more(image: GrayImage) -> None:
    faint = (128 + (image.astype(float) - 128) * 0.25).astype(np.uint8)
    low = detect(faint, contrast_threshold=0.005)
    high = detect(faint, contrast_threshold=0.04)
    assert len(low) > 1.5 * len(high)


def test_root_normalized_takes_roots_of_shares() -> None:
    assert_allclose(
        root_normalized(np.array([[1.0, 0.0, 3.0], [9.0, 16.0, 0.0]])),
        np.sqrt([[0.25, 0.0, 0.75], [0.36, 0.64, 0.0]]),
        atol=FLOAT32_ROUNDING,
    )


def test_root_normalized_of_a_row_of_zeros_stays_zero() -> None:
    assert root_normalized(np.zeros((2, 4), np.float32)).tolist() == [[0.0] * 4] * 2


def test_detect_without_features_keeps_the_layout(image: GrayImage) -> None:
    some, none = detect(image), detect(np.full(image.shape, 9, np.uint8))
    assert len(none) == 0
    for name in ("lafs", "responses", "descriptors", "rectification_ids"):
        assert getattr(none, name).dtype == getattr(some, name).dtype
        assert getattr(none, name).shape[1:] == getattr(some, name).shape[1:]


def test_describe_returns_what_detect_has_described(image: GrayImage) -> None:
    profile = RootSift(SiftOptions(max_num_features=20))
    views = [(image, None), (image[:4], None), (image[20:, 40:], None)]
    detected = [profile.detect(view) for view in views]
    described = profile.describe([view[0] for view in views], detected)
    assert [len(features) for features in described] == [20, 0, 20]
    for before, after in zip(detected, described, strict=True):
        np.testing.assert_array_equal(after.lafs, before.lafs)
        assert after.descriptors.shape == (len(before), profile.descriptor_size)
