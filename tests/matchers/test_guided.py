"""Guided matching against comparing everything with everything."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from colmap_affrect.geometry.affine import project, rotation, transform_lafs
from colmap_affrect.geometry.epipolar import EpipolarModel, HomographyModel, PairModel
from colmap_affrect.matchers.guided import (
    GuidedOptions,
    guided_matches,
    match_near_geometry,
)

HOMOGRAPHY = np.array([[0.7, -0.25, 190.0], [0.2, 0.9, 40.0], [2e-4, -1e-4, 1.0]])
OPTIONS = GuidedOptions()
NONE = np.zeros((0, 2), int)
CAMERA = np.array([[500.0, 0, 310], [0, 480, 260], [0, 0, 1]])


def fundamental(translation: tuple[float, float, float]) -> np.ndarray:
    """Of two cameras, the second one turned by 17 degrees."""
    x, y, z = translation
    angle = np.deg2rad(17)
    rotation = np.array(
        [
            [np.cos(angle), 0.1, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
    )
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
    inverse = np.linalg.inv(CAMERA)
    return inverse.T @ essential @ inverse


Arrays = tuple[np.ndarray, np.ndarray]


def random_pair(
    seed: int, counts: tuple[int, int] = (600, 450)
) -> tuple[Arrays, Arrays]:
    """Descriptors and points: few different ones, so that many features are alike; some copies."""
    rng = np.random.default_rng(seed)
    words = rng.normal(size=(40, 8))
    found = []
    for count, size in zip(counts, ((640, 480), (900, 350)), strict=True):
        descriptors = words[rng.integers(0, 40, count)] + 0.25 * rng.normal(
            size=(count, 8)
        )
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        descriptors[1] = descriptors[0]
        found.append((descriptors.astype(np.float32), rng.uniform(0, size, (count, 2))))
    descriptors, points = zip(*found, strict=True)
    return descriptors, points


def compared_with_everything(
    descriptors: Arrays, points2: np.ndarray, allowed: np.ndarray
) -> list[tuple[int, int]]:
    similarity = descriptors[0] @ descriptors[1].T
    similarity[~allowed] = -1
    found = []
    for row, column in enumerate(similarity.argmax(axis=1)):
        far = np.linalg.norm(points2 - points2[column], axis=1) > 10
        others = similarity[row][far].max(initial=-1)
        ratio = np.sqrt((1 - similarity[row, column]) / max(1e-6, 1 - others))
        mutual = similarity[:, column].argmax() == row
        if similarity[row, column] > 0.75 and ratio < 0.8 and mutual:
            found.append((row, column))
    return found


@pytest.mark.parametrize(
    "translation",
    [(1, 0.2, 0.1), (0.1, 0.05, 1), (0.3, 1, 0)],
    ids=["beside", "ahead", "above"],
)
def test_bands_miss_nothing(translation: tuple[float, float, float]) -> None:
    descriptors, points = random_pair(3)
    model = EpipolarModel(fundamental(translation), points)
    found = match_near_geometry(descriptors, model, OPTIONS)
    assert len(found) > 20
    errors = model.errors(*(index.ravel() for index in np.indices((600, 450))))
    allowed = errors.reshape(600, 450) <= 3.0
    assert_array_equal(found, compared_with_everything(descriptors, points[1], allowed))


def test_positions_of_a_homography_miss_nothing() -> None:
    descriptors, points = random_pair(6, (900, 2000))
    model = HomographyModel(HOMOGRAPHY, points)
    found = match_near_geometry(descriptors, model, GuidedOptions(band_px=10.0))
    assert len(found) > 20
    errors = np.linalg.norm(project(HOMOGRAPHY, points[0])[:, None] - points[1], axis=2)
    assert_array_equal(
        found, compared_with_everything(descriptors, points[1], errors <= 20.0)
    )


def test_points_without_a_position_match_nothing() -> None:
    descriptors, (points1, points2) = random_pair(3)
    points1[5:300] = np.nan
    points2[7:90] = np.nan
    points = points1, points2
    epipolar = EpipolarModel(fundamental((1, 0.2, 0.1)), points)
    for model in (epipolar, HomographyModel(HOMOGRAPHY, points)):
        found = match_near_geometry(descriptors, model, GuidedOptions(band_px=6.0))
        assert len(found)
        assert np.isfinite(points1[found[:, 0]]).all()
        assert np.isfinite(points2[found[:, 1]]).all()


def plane() -> tuple[Arrays, HomographyModel]:
    """200 features of a plane that two photographs see, with descriptors of their own."""
    rng = np.random.default_rng(8)
    descriptors = rng.normal(size=(200, 64))
    points1 = rng.uniform(0, (640, 480), (200, 2))
    descriptors = descriptors / np.linalg.norm(descriptors, axis=1)[:, None]
    same = descriptors.astype(np.float32)
    return (same, same), HomographyModel(
        HOMOGRAPHY, (points1, project(HOMOGRAPHY, points1))
    )


def test_inliers_stay_and_matches_are_one_to_one() -> None:
    descriptors, model = plane()
    inliers = np.array([[0, 1], [1, 0], [7, 7]])  # older matches say otherwise
    found = guided_matches(descriptors, None, model, inliers, OPTIONS)
    assert {*map(tuple, inliers)} <= {*map(tuple, found)}
    assert (
        len(found) == 200 == len(np.unique(found[:, 0])) == len(np.unique(found[:, 1]))
    )
    assert_array_equal(np.sort(found[:, 0]), found[:, 0])
    nothing = HomographyModel(HOMOGRAPHY, (model.points[0], model.points[1][:0]))
    assert not len(
        guided_matches(
            (descriptors[0], descriptors[1][:0]), None, nothing, NONE, OPTIONS
        )
    )


def test_features_that_are_matched_already_match_no_others() -> None:
    """The features of image 2 are in another order than those of image 1."""
    (descriptors, _), model = plane()
    order = np.random.default_rng(2).permutation(200)
    column_of = np.argsort(order)
    points1, points2 = model.points
    shuffled = HomographyModel(HOMOGRAPHY, (points1, points2[order]))
    inliers = np.array([[0, column_of[1]], [2, column_of[5]]])
    found = guided_matches(
        (descriptors, descriptors[order]), None, shuffled, inliers, OPTIONS
    )
    others = np.setdiff1d(np.arange(200), [0, 1, 2, 5])
    expected = np.concatenate([inliers, np.stack([others, column_of[others]], axis=1)])
    assert_array_equal(found, expected[np.argsort(expected[:, 0])])


@pytest.mark.parametrize("kind", [EpipolarModel, HomographyModel])
def test_where_as_much_is_found_beside_a_geometry_nothing_is_proven(
    kind: type[PairModel],
) -> None:
    descriptors, points = random_pair(4, (2000, 2500))
    model = kind(
        HOMOGRAPHY if kind is HomographyModel else fundamental((1, 0.2, 0.1)), points
    )
    options = GuidedOptions(band_px=6.0)
    inliers = np.array([[3, 7], [9, 1]])
    assert len(match_near_geometry(descriptors, model, options)) > 20
    assert_array_equal(
        guided_matches(descriptors, None, model, inliers, options), inliers
    )


def test_accidental_matches_are_counted_near_the_geometry() -> None:
    descriptors, (points1, points2) = random_pair(4, (2000, 2500))
    # A surface of 120 px that repeats itself: farther away there is nothing.
    surface = (points1 / (640.0, 480.0) * 120.0, points2 / (900.0, 350.0) * 120.0)
    model = HomographyModel(np.eye(3), surface)
    assert len(match_near_geometry(descriptors, model, OPTIONS)) > 20
    assert_array_equal(guided_matches(descriptors, None, model, NONE, OPTIONS), NONE)


@pytest.mark.parametrize(
    ("num_across", "num_down", "is_proven"),
    [
        (300, 0, True),  # what lies behind the plane is displaced along one axis only
        (0, 300, True),
        (40, 40, True),  # a fifth of what is found near the homography
        (300, 300, False),
    ],
)
def test_accidental_matches_along_both_axes_are_half_of_those_that_prove_nothing(
    num_across: int, num_down: int, *, is_proven: bool
) -> None:
    """Beside 200 features of a plane others match that are 18 px beside it, or below it."""
    random = np.random.default_rng(8)
    num = 200 + num_across + num_down
    points1 = random.uniform(0, (640, 480), (num, 2))
    points2 = points1.copy()
    points2[200 : 200 + num_across] -= (18.0, 0.0)
    points2[200 + num_across :] -= (0.0, 18.0)
    descriptors = random.normal(size=(num, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    both = descriptors.astype(np.float32), descriptors.astype(np.float32)
    model = HomographyModel(np.eye(3), (points1, points2))
    found = guided_matches(both, None, model, NONE, OPTIONS)
    assert len(found) == (200 if is_proven else 0)


def shapes_of_plane(model: HomographyModel) -> Arrays:
    """Shapes of LAFs on the plane, of which the first 60 are rotated in image 2."""
    shapes1 = np.eye(2) + 0.2 * np.random.default_rng(3).normal(size=(200, 2, 2))
    lafs = np.concatenate([shapes1, model.points[0][:, :, None]], axis=2)
    shapes2 = transform_lafs(HOMOGRAPHY, lafs)[:, :, :2]
    shapes2[:60] = rotation(0.9) @ shapes2[:60]
    return shapes1, shapes2


def test_lafs_that_rotate_otherwise_match_nothing() -> None:
    descriptors, model = plane()
    found = guided_matches(descriptors, shapes_of_plane(model), model, NONE, OPTIONS)
    assert_array_equal(found, np.stack([np.arange(60, 200)] * 2, axis=1))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_lafs_that_map_epipolar_lines_to_others_match_nothing(sign: float) -> None:
    descriptors, model = plane()
    epipole = np.array([[0.0, -1.0, 300.0], [1.0, 0.0, -9000.0], [-300.0, 9000.0, 0.0]])
    epipolar = EpipolarModel(sign * epipole @ HOMOGRAPHY, model.points)
    inliers = np.stack([np.arange(100, 130)] * 2, axis=1)
    shapes = shapes_of_plane(model)
    # A pair of lines has no direction: right matches have the sign of most inliers.
    cosines = epipolar.cosines(inliers[:, 0], inliers[:, 1], shapes)
    assert (cosines < 0.0).all()
    found = guided_matches(descriptors, shapes, epipolar, inliers, OPTIONS)
    assert_array_equal(found, np.stack([np.arange(60, 200)] * 2, axis=1))


@pytest.mark.parametrize("kind", [EpipolarModel, HomographyModel])
def test_models_of_smaller_images_are_those_of_their_points(
    kind: type[PairModel],
) -> None:
    matrix = HOMOGRAPHY if kind is HomographyModel else fundamental((1, 0.2, 0.1))
    _, points = random_pair(3)
    model = kind(matrix, points)
    rows = np.arange(100)
    smaller = model.scaled(2.0, 3.0)
    assert_array_equal(smaller.points[1], points[1] / 3.0)
    near = model.errors(rows, rows)
    small = smaller.errors(rows, rows)
    assert np.allclose(small, near / 3.0) or np.all(
        (small > near / 3.1) & (small < near / 1.9)
    )
