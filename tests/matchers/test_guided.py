"""Guided matching against comparing everything with everything, and what frames say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from colmap_affrect.geometry.affine import project, transform_frames
from colmap_affrect.matchers import guided as module
from colmap_affrect.matchers.guided import (
    EpipolarGuide,
    GuidableImage,
    Guide,
    GuidedOptions,
    HomographyGuide,
    guided_matches,
    nearest_allowed,
)

OPTIONS = GuidedOptions()
CAMERA = np.array([[500.0, 0, 310], [0, 480, 260], [0, 0, 1]])
HOMOGRAPHY = np.array([[0.7, -0.25, 190.0], [0.2, 0.9, 40.0], [2e-4, -1e-4, 1.0]])


def fundamental(translation: tuple[float, float, float]) -> np.ndarray:
    """Of two cameras, the second one turned by 17 degrees."""
    x, y, z = translation
    angle = np.deg2rad(17)
    rotation = np.array(
        [[np.cos(angle), 0.1, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    inverse = np.linalg.inv(CAMERA)
    return inverse.T @ essential @ inverse


def random_images(seed: int, counts: tuple[int, int] = (600, 450)) -> list[GuidableImage]:
    """Few different descriptors, so that many features are alike; some copies of others."""
    rng = np.random.default_rng(seed)
    words = rng.normal(size=(40, 8))
    images = []
    for count, size in zip(counts, ((640, 480), (900, 350)), strict=True):
        descriptors = words[rng.integers(0, 40, count)] + 0.25 * rng.normal(size=(count, 8))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        descriptors[1], points = descriptors[0], rng.uniform(0, size, (count, 2))
        images.append(GuidableImage(descriptors.astype(np.float32), points))
    return images


def compared_with_everything(first: GuidableImage, second: GuidableImage, guide: Guide) -> list:
    rows, columns = np.arange(len(first.points)), np.arange(len(second.points))
    similarity = first.descriptors @ second.descriptors.T
    similarity[~guide.allowed(rows, columns)] = -1
    best = similarity.argmax(axis=1)
    found = []
    for row, column in enumerate(best):
        far = np.linalg.norm(second.points - second.points[column], axis=1) > 10
        others = similarity[row][far].max(initial=-1)
        ratio = np.sqrt((1 - similarity[row, column]) / max(1e-6, 1 - others))
        mutual = similarity[:, column].argmax() == row
        if similarity[row, column] > 0.75 and ratio < 0.8 and mutual:
            found.append((row, column))
    return found


@pytest.mark.parametrize(
    "translation", [(1, 0.2, 0.1), (0.1, 0.05, 1), (0.3, 1, 0)], ids=["beside", "ahead", "above"]
)
def test_epipolar_bands_miss_nothing(translation: tuple[float, float, float]) -> None:
    first, second = random_images(3)
    guide = EpipolarGuide(fundamental(translation), first.points, second.points, 3.0)
    found = nearest_allowed(first, second, guide, OPTIONS)
    assert len(found) > 20
    assert_array_equal(found, compared_with_everything(first, second, guide))


def test_bands_are_those_of_sampsons_distance() -> None:
    from colmap_affrect.geometry.epipolar import sampson_errors

    first, second = random_images(4)
    matrix = fundamental((1, 0.2, 0.1))
    guide = EpipolarGuide(matrix, first.points, second.points, 7.0)
    allowed = guide.allowed(np.arange(600), np.arange(450))
    rows, columns = (index.ravel() for index in np.indices(allowed.shape))
    errors = sampson_errors(matrix, first.points[rows], second.points[columns])
    assert_array_equal(allowed.ravel(), errors <= 7.0)


def test_homography_misses_nothing() -> None:
    first, second = random_images(6, (900, 2000))
    guide = HomographyGuide(HOMOGRAPHY, first.points, second.points, 10.0)
    found = nearest_allowed(first, second, guide, OPTIONS)
    assert len(found) > 20
    assert_array_equal(found, compared_with_everything(first, second, guide))
    errors = project(HOMOGRAPHY, first.points[found[:, 0]]) - second.points[found[:, 1]]
    assert np.linalg.norm(errors, axis=1).max() <= 20.0


def test_points_without_a_place_match_nothing() -> None:
    first, second = random_images(3)
    first.points[5:300], second.points[7:90] = np.nan, np.nan
    for guide in (
        EpipolarGuide(fundamental((1, 0.2, 0.1)), first.points, second.points, 3.0),
        HomographyGuide(HOMOGRAPHY, first.points, second.points, 10.0),
    ):
        found = nearest_allowed(first, second, guide, OPTIONS)
        assert len(found)
        assert np.isfinite(first.points[found[:, 0]]).all()
        assert np.isfinite(second.points[found[:, 1]]).all()


def plane_pair(wrong: int = 0) -> tuple[GuidableImage, GuidableImage, list[Guide]]:
    """200 features of a plane seen by two cameras; the frames of the first ones turned by 50."""
    rng = np.random.default_rng(8)
    translation, normal, angle = np.array([0.5, 0.1, -0.2]), np.array([0.3, -0.1, 1.0]), 0.3
    rotation = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )
    inverse = np.linalg.inv(CAMERA)
    homography = CAMERA @ (rotation + np.outer(translation, normal) / 3) @ inverse
    x, y, z = translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = inverse.T @ cross @ rotation @ inverse
    points = rng.uniform((0, 0), (640, 480), (200, 2))
    shapes = np.eye(2) * 5 + rng.normal(size=(200, 2, 2))
    frames = transform_frames(homography, np.concatenate([shapes, points[:, :, None]], axis=2))
    turn = np.array([[np.cos(0.9), -np.sin(0.9)], [np.sin(0.9), np.cos(0.9)]])
    frames[:wrong, :, :2] = turn @ frames[:wrong, :, :2]
    descriptors = rng.normal(size=(200, 64))
    descriptors = (descriptors / np.linalg.norm(descriptors, axis=1)[:, None]).astype(np.float32)
    order = rng.permutation(200)
    first = GuidableImage(descriptors[order], points[order], shapes[order])
    second = GuidableImage(descriptors, frames[:, :, 2], frames[:, :, :2])
    guides: list[Guide] = [
        EpipolarGuide(matrix, first.points, second.points, 3.0),
        # of either sign: homographies have none
        HomographyGuide(-homography, first.points, second.points, 3.0),
    ]
    return first, second, guides


@pytest.mark.parametrize("kind", [0, 1], ids=["epipolar", "homography"])
def test_frames_that_turn_otherwise_match_nothing(kind: int) -> None:
    first, second, guides = plane_pair(wrong=60)
    exact = nearest_allowed(first, second, guides[kind], OPTIONS)
    assert len(exact) == 200
    inliers = exact[exact[:, 1] >= 150]
    found = guided_matches(first, second, guides[kind], OPTIONS, inliers)
    assert (found[:, 1] >= 60).all()
    assert len(found) == 140
    assert_array_equal(np.sort(found[:, 0]), found[:, 0])
    free = GuidedOptions(max_angle_deg=180)
    assert len(guided_matches(first, second, guides[kind], free, inliers)) == 200
    without = [replace(image, shapes=None) for image in (first, second)]
    assert len(guided_matches(*without, guides[kind], OPTIONS, inliers)) == 200


def test_pair_whose_frames_contradict_its_geometry_keeps_what_it_has() -> None:
    first, second, guides = plane_pair(wrong=60)
    exact = nearest_allowed(first, second, guides[0], OPTIONS)
    inliers = exact[exact[:, 1] < 70]
    rng = np.random.default_rng(1)
    angles = rng.uniform(0, 2 * np.pi, 200)
    turns = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=1)
    random = replace(second, shapes=turns.reshape(-1, 2, 2))
    assert_array_equal(guided_matches(first, random, guides[0], OPTIONS, inliers), inliers)


def test_circles_have_no_directions() -> None:
    first, second, guides = plane_pair(wrong=60)
    circles = np.random.default_rng(2).uniform(1, 9, 200)[:, None, None] * np.eye(2)
    first, second = (replace(image, shapes=circles) for image in (first, second))
    assert not first.has_directions
    in_two_views = np.where(np.arange(200)[:, None, None] % 2, circles, circles @ [[2, 1], [0, 1]])
    assert not replace(first, shapes=in_two_views).has_directions
    nothing = np.zeros((0, 2), int)
    assert not len(guided_matches(first, second, guides[0], OPTIONS, nothing))
    some = nearest_allowed(first, second, guides[0], OPTIONS)[:1]
    assert len(guided_matches(first, second, guides[0], OPTIONS, some)) == 200


def test_inliers_stay_and_matches_are_one_to_one() -> None:
    first, second, guides = plane_pair()
    exact = nearest_allowed(first, second, guides[0], OPTIONS)
    inliers = exact[:40].copy()
    inliers[[0, 1], 1] = inliers[[1, 0], 1]  # an older match says otherwise
    found = guided_matches(first, second, guides[0], OPTIONS, inliers)
    assert {*map(tuple, inliers)} <= {*map(tuple, found)}
    assert len(found) == 200 == len(np.unique(found[:, 0])) == len(np.unique(found[:, 1]))


@pytest.mark.parametrize("kind", [0, 1], ids=["epipolar", "homography"])
def test_beside_a_geometry_its_own_matches_are_not_found(kind: int) -> None:
    first, second, guides = plane_pair()
    assert len(nearest_allowed(first, second, guides[kind], OPTIONS)) == 200
    for beside in guides[kind].beside():
        assert not len(nearest_allowed(first, second, beside, OPTIONS))
        moved = beside.model.points[1] - second.points
        assert np.ptp(moved, axis=0) == pytest.approx(0.0, abs=1e-9)
        assert np.linalg.norm(moved[0]) == pytest.approx(18.0)


@pytest.mark.parametrize("kind", [0, 1], ids=["epipolar", "homography"])
def test_where_as_much_is_found_beside_a_geometry_nothing_is_proven(
    kind: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = random_images(4, (2000, 2500))
    geometries = [
        EpipolarGuide(fundamental((1, 0.2, 0.1)), first.points, second.points, 6.0),
        HomographyGuide(HOMOGRAPHY, first.points, second.points, 6.0),
    ]
    inliers = np.array([[3, 7], [9, 1]])
    assert_array_equal(guided_matches(first, second, geometries[kind], OPTIONS, inliers), inliers)
    monkeypatch.setattr(module, "MAX_ACCIDENTAL", 2.0)
    assert len(guided_matches(first, second, geometries[kind], OPTIONS, inliers)) > 20
