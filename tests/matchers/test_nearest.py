"""Matching against a plain loop, and what must not change it: order, chunks, empty images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from synthetic import unit_rows

from colmap_affrect.data import LocalFeatures
from colmap_affrect.geometry.affine import lafs_from_keypoints
from colmap_affrect.matchers import nearest
from colmap_affrect.matchers.base import ImageFeatures, MatcherContext, Matches
from colmap_affrect.matchers.nearest import NearestNeighbors, NearestOptions

RATIO_ERROR = 2e-3
"""Ratios are roots of differences of float32 cosines near 1: sqrt(1e-7) where a distance is 0."""

Features = tuple[NDArray[np.float32], NDArray[np.float64]]


def two_views(
    seed: int,
    count1: int,
    count2: int,
    size_px: float,
    noise: float,
    dimension: int = 16,
) -> tuple[Features, Features]:
    """Features of two images, some of which are the same points with noise.

    The images are crowded, so that neighbours within a few px and repeated matches occur.
    """
    rng = np.random.default_rng(seed)
    descriptors1 = rng.random((count1, dimension)) + 1e-3
    keypoints1 = rng.uniform(0, size_px, (count1, 2))
    source = rng.integers(0, count1, count2)
    same = rng.random(count2) < 0.7
    descriptors2 = rng.random((count2, dimension)) + 1e-3
    near = np.abs(
        descriptors1[source] + noise * rng.standard_normal((count2, dimension))
    )
    descriptors2[same] = near[same] + 1e-3
    keypoints2 = rng.uniform(0, size_px, (count2, 2))
    keypoints2[same] = keypoints1[source][same] + rng.normal(0, 1.5, (count2, 2))[same]
    return (unit_rows(descriptors1), keypoints1), (unit_rows(descriptors2), keypoints2)


def best_and_ratio(
    query: NDArray[np.floating], other: Features, min_distance_px: float
) -> tuple[int, float]:
    """Nearest descriptor, and its distance over that of the nearest one far enough from it.

    Where none is far enough, the largest distance of unit vectors stands in for it.
    """
    descriptors, keypoints = other
    distances = [
        float(np.linalg.norm(query - row)) for row in descriptors.astype(np.float64)
    ]
    best = min(range(len(distances)), key=distances.__getitem__)
    second = 2.0
    for index, distance in enumerate(distances):
        apart = float(np.hypot(*(keypoints[index] - keypoints[best])))
        if apart > min_distance_px:
            second = min(second, distance)
    return best, distances[best] / second


def slow_matches(
    first: Features, second: Features, options: NearestOptions
) -> list[tuple[int, int, float]]:
    """The matcher's definition as plain loops."""
    radius_px = options.min_contrast_distance_px
    matches = []
    for row, query in enumerate(first[0].astype(np.float64)):
        target, ratio = best_and_ratio(query, second, radius_px)
        back, back_ratio = best_and_ratio(
            second[0][target].astype(np.float64), first, radius_px
        )
        if back == row and max(ratio, back_ratio) < options.max_ratio:
            matches.append((row, target, max(ratio, back_ratio)))
    kept: list[tuple[int, int, float]] = []
    for row, target, ratio in sorted(matches, key=lambda match: match[2]):
        duplicate = any(
            np.hypot(*(first[1][row] - first[1][other])) <= options.duplicate_radius_px
            and np.hypot(*(second[1][target] - second[1][partner]))
            <= options.duplicate_radius_px
            for other, partner, _ in kept
        )
        if not duplicate:
            kept.append((row, target, ratio))
    return sorted(kept)


def run(first: Features, second: Features, options: NearestOptions) -> Matches:
    """Match two sets of (descriptors, keypoints)."""
    matcher = NearestNeighbors(options, MatcherContext())
    return matcher.match(
        *(matcher.prepare(image_of(*view)) for view in (first, second))
    )


def image_of(
    descriptors: NDArray[np.float32], keypoints: NDArray[np.float64]
) -> ImageFeatures:
    """Circles at (N, 2) px."""
    ones = np.ones(len(keypoints))
    lafs = lafs_from_keypoints(keypoints, ones, ones)
    return ImageFeatures(
        LocalFeatures(lafs, ones.astype(np.float32), descriptors), (99, 99), ""
    )


@given(
    st.integers(0, 100_000),
    st.integers(3, 45),
    st.integers(3, 45),
    st.sampled_from([15.0, 60.0, 400.0]),
    st.sampled_from([0.02, 0.1, 0.25]),
    st.sampled_from([0.75, 0.9, 1.0]),
    st.sampled_from([2.0, 10.0, 30.0]),
    st.sampled_from([0.5, 3.0]),
)
def test_match_features_equals_plain_loops(
    seed: int,
    count1: int,
    count2: int,
    size_px: float,
    noise: float,
    max_ratio: float,
    min_contrast_distance_px: float,
    duplicate_radius_px: float,
) -> None:
    first, second = two_views(seed, count1, count2, size_px, noise)
    options = NearestOptions(
        max_ratio=max_ratio,
        min_contrast_distance_px=min_contrast_distance_px,
        duplicate_radius_px=duplicate_radius_px,
    )
    expected = slow_matches(first, second, options)
    actual = run(first, second, options)
    assert actual.indices.tolist() == [[row, target] for row, target, _ in expected]
    assert_allclose(
        actual.scores, [1 - ratio for *_, ratio in expected], atol=RATIO_ERROR
    )


def spread(count: int) -> NDArray[np.float64]:
    """Keypoints 100 px apart in a row."""
    return np.stack([100.0 * np.arange(count), np.full(count, 7.0)], axis=1)


def test_match_features_rejects_the_same_descriptor_at_two_far_places() -> None:
    # Repeated structure, the same to the last bit: rounding must not make it look unique.
    rng = np.random.default_rng(8)
    descriptors = unit_rows(rng.random((60, 128)))
    first = (descriptors, spread(60))
    second = (np.concatenate([descriptors, descriptors]), spread(120))
    assert run(first, second, NearestOptions()).indices.tolist() == []


@pytest.mark.parametrize(
    ("ratio", "is_match"), [(0.2, True), (0.8, True), (0.9, False)]
)
def test_the_nearest_descriptor_is_a_match_that_is_a_seventh_nearer_than_others(
    ratio: float, *, is_match: bool
) -> None:
    """The distances of two others are as 0.3 times the ratio to 0.3."""
    angles = np.array([0.3 * ratio, -0.3])
    others = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    query = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    first = (query, spread(2))
    second = (others.astype(np.float32), spread(2))
    found = run(first, second, NearestOptions()).indices.tolist()
    assert ([0, 0] in found) == is_match


@pytest.mark.parametrize(("distance_px", "num"), [(1.5, 1), (2.5, 2), (15.0, 2)])
def test_matches_that_are_less_than_two_px_apart_in_both_images_are_one(
    distance_px: float, num: int
) -> None:
    descriptors = np.eye(3, dtype=np.float32)
    points = np.array([[0.0, 0.0], [distance_px, 0.0], [500.0, 0.0]])
    image = (descriptors, points)
    assert len(run(image, image, NearestOptions()).indices) == num + 1


NUM_SHAPED = 400  # features of an image with shapes of their own


def shaped_image(
    seed: int, *, related_to: ImageFeatures | None = None
) -> ImageFeatures:
    """Features with shapes of their own, perhaps those of another image, turned and enlarged."""
    rng = np.random.default_rng(seed)
    if related_to is None:
        lafs = np.empty((NUM_SHAPED, 2, 3))
        lafs[:, :, :2] = 4.0 * np.eye(2) + rng.uniform(-1.5, 1.5, (NUM_SHAPED, 2, 2))
        lafs[:, :, 2] = rng.uniform(0.0, 800.0, (NUM_SHAPED, 2))
        descriptors = unit_rows(rng.random((NUM_SHAPED, 16)) + 1e-3)
    else:
        turn = np.array([[0.9, -1.0], [1.0, 0.9]])
        lafs = turn @ related_to.features.lafs
        descriptors = related_to.features.descriptors
    responses = rng.permutation(np.arange(1, NUM_SHAPED + 1)).astype(np.float32)
    features = LocalFeatures(lafs, responses, descriptors)
    return ImageFeatures(features, (800, 800), "")


def matched_rows(
    first: ImageFeatures, second: ImageFeatures, *, may_give_up: bool
) -> list[list[int]]:
    options = NearestOptions(max_ratio=1.0, min_contrast_distance_px=1.0)
    context = MatcherContext({}, "cpu", may_give_up=may_give_up)
    matcher = NearestNeighbors(options, context)
    found = matcher.match(matcher.prepare(first), matcher.prepare(second))
    return found.indices.tolist()


@pytest.fixture
def few_looked_at(monkeypatch: pytest.MonkeyPatch) -> int:
    """A tenth of the features of an image, by which a pair may be given up."""
    num = NUM_SHAPED // 10
    monkeypatch.setattr(nearest, "NUM_LOOKED_AT", num)
    return num


def test_pair_with_nothing_in_common_is_matched_by_the_largest_features_alone(
    few_looked_at: int,
) -> None:
    first = shaped_image(1)
    second = shaped_image(2)
    every = matched_rows(first, second, may_give_up=False)
    some = matched_rows(first, second, may_give_up=True)
    assert 5 < len(some) <= few_looked_at < len(every)
    for image, rows in zip((first, second), np.transpose(some), strict=True):
        areas = np.linalg.det(image.features.lafs[:, :, :2])
        assert np.count_nonzero(areas > areas[rows].min()) < few_looked_at
    alone = [largest_of(image, few_looked_at) for image in (first, second)]
    of_largest = matched_rows(alone[0], alone[1], may_give_up=False)
    assert len(some) == len(of_largest)


def largest_of(image: ImageFeatures, num: int) -> ImageFeatures:
    """The image with its largest features alone."""
    known = image.features
    areas = np.linalg.det(known.lafs[:, :, :2])
    rows = np.sort(np.argsort(-areas)[:num])
    features = LocalFeatures(
        known.lafs[rows], known.responses[rows], known.descriptors[rows]
    )
    return replace(image, features=features)


@pytest.mark.usefixtures("few_looked_at")
def test_pair_whose_largest_features_agree_is_matched_as_a_whole() -> None:
    first = shaped_image(1)
    second = shaped_image(2, related_to=first)
    every = matched_rows(first, second, may_give_up=False)
    assert len(every) > 0.9 * NUM_SHAPED
    assert matched_rows(first, second, may_give_up=True) == every


@pytest.mark.parametrize(("num_agreeing", "is_given_up"), [(1, True), (2, False)])
def test_pair_is_given_up_where_less_than_two_matches_agree_with_their_neighbours(
    monkeypatch: pytest.MonkeyPatch,
    few_looked_at: int,
    num_agreeing: int,
    *,
    is_given_up: bool,
) -> None:
    monkeypatch.setattr(nearest, "num_consistent_matches", lambda *_: num_agreeing)
    first = shaped_image(1)
    second = shaped_image(2, related_to=first)
    found = matched_rows(first, second, may_give_up=True)
    assert (len(found) <= few_looked_at) == is_given_up


def test_pair_is_looked_at_by_half_of_its_features_at_most() -> None:
    first = shaped_image(1)
    second = shaped_image(2)
    some = matched_rows(first, second, may_give_up=True)
    alone = [largest_of(image, NUM_SHAPED // 2) for image in (first, second)]
    of_half = matched_rows(alone[0], alone[1], may_give_up=False)
    assert 40 < len(some) == len(of_half) <= NUM_SHAPED // 2


@pytest.mark.usefixtures("few_looked_at")
def test_pair_whose_frames_tell_nothing_is_matched_as_a_whole() -> None:
    images = []
    for seed in (1, 2):
        image = shaped_image(seed)
        circles = image.features.lafs.copy()
        circles[:, :, :2] = 4.0 * np.eye(2)
        images.append(replace(image, features=replace(image.features, lafs=circles)))
    every = matched_rows(images[0], images[1], may_give_up=False)
    assert matched_rows(images[0], images[1], may_give_up=True) == every
