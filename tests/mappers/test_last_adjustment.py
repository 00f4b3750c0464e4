"""The last adjustment of models: what goes, what stays, what moves."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import inlier_matches
from colmap_affrect.mappers.last_adjustment import Matches, adjust_last, exactly_held

LAST = 5
"""The image some of whose matches are said to be guided."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[pycolmap.Reconstruction, Matches]:
    """A true model of five images whose keypoints have noise, and the inliers of its pairs."""
    path = tmp_path_factory.mktemp("exact") / "database.db"
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=LAST, num_points3D=150
    )
    pycolmap.set_random_seed(1)
    with open_database(path) as database:
        model = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3)
        pycolmap.synthesize_noise(noise, model, database)
    return model, inlier_matches(path, 1)


@pytest.fixture
def model(scene: tuple[pycolmap.Reconstruction, Matches]) -> pycolmap.Reconstruction:
    return copy.deepcopy(scene[0])


@pytest.fixture
def verified(scene: tuple[pycolmap.Reconstruction, Matches]) -> Matches:
    return scene[1]


def said_to_be_guided(verified: Matches, every: int) -> Matches:
    """The matches of each so many-th keypoint of the last image."""
    assert all(first < second for first, second in verified)
    return {
        pair: rows[rows[:, 1] % every == 0] for pair, rows in verified.items() if pair[1] == LAST
    }


def seen(model: pycolmap.Reconstruction) -> set[int]:
    """The keypoints of the last image that see a point."""
    return set(model.images[LAST].get_observation_point2D_idxs())


def test_guided_observations_go_where_exact_ones_hold_all_images(
    model: pycolmap.Reconstruction, verified: Matches
) -> None:
    guided = said_to_be_guided(verified, 2)
    expected = {index for index in seen(model) if index % 2 == 0}
    assert len(expected) > 30
    assert adjust_last(model, verified, guided, constant_cameras=model.cameras) == len(expected)
    assert not seen(model) & expected
    assert len(seen(model)) > 30
    assert model.num_reg_images() == LAST
    assert adjust_last(model, verified, guided, constant_cameras=model.cameras) == 0


def test_guided_observations_stay_where_an_image_needs_them(
    model: pycolmap.Reconstruction, verified: Matches
) -> None:
    before = seen(model)
    guided = said_to_be_guided(verified, 1)
    assert adjust_last(model, verified, guided, constant_cameras=model.cameras) == 0
    assert len(seen(model)) > 0.9 * len(before)
    assert model.num_reg_images() == LAST


def centers(model: pycolmap.Reconstruction) -> np.ndarray:
    return np.array([model.images[i].projection_center() for i in sorted(model.reg_image_ids())])


def test_matches_that_are_off_hardly_move_the_model(
    model: pycolmap.Reconstruction, verified: Matches
) -> None:
    """A fifth of the observations of an image, all off by 3 px to the same side."""
    true = centers(model)
    for index in sorted(seen(model))[::5]:
        model.images[LAST].points2D[index].xy += np.array([3.0, 0.0])
    assert adjust_last(model, verified, {}, constant_cameras=model.cameras) == 0
    scale = np.linalg.norm(true - true.mean(axis=0), axis=1).mean()
    aligned = pycolmap.estimate_sim3d(centers(model), true)
    errors = np.linalg.norm(
        np.array([aligned * center for center in centers(model)]) - true, axis=1
    )
    assert errors.max() < 0.002 * scale


def test_constant_cameras_stay_and_no_others(
    model: pycolmap.Reconstruction, verified: Matches
) -> None:
    before = {number: camera.params.copy() for number, camera in model.cameras.items()}
    constant = sorted(before)[::2]
    adjust_last(model, verified, {}, constant_cameras=constant)
    same = {i for i, camera in model.cameras.items() if np.array_equal(camera.params, before[i])}
    assert same == set(constant)


@pytest.mark.parametrize(("true", "start"), [(0.0, 0.03), (0.3, 0.2)])
def test_lenses_do_not_distort_unless_points_tell_so(true: float, start: float) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=LAST)
    pycolmap.set_random_seed(1)
    options.camera_params = [1280.0, 512.0, 384.0, true]
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), model)
    for camera in model.cameras.values():
        camera.params[3] = start
    adjust_last(model, {}, {})
    ends = [camera.params[3] for camera in model.cameras.values()]
    assert ends == ([0.0] if true == 0.0 else pytest.approx([true], abs=0.05))


def track(point: int, *images: int) -> list[list[int]]:
    keys = [(image << 32) + point for image in images]
    return [[keys[0], key] for key in keys[1:]]


def test_images_are_held_by_exact_tracks_through_three() -> None:
    ties = [tie for point in range(40) for tie in track(point, 1, 2, 3)]
    ties += [tie for point in range(40, 75) for tie in track(point, 3, 5, 4, 2)]
    ties += [tie for point in range(100, 200) for tie in track(point, 5, 6)]  # two views only
    ties += [tie for point in range(200, 220) for tie in track(point, 7, 1, 2)]  # too few
    ties += [tie for point in range(300, 340) for tie in track(point, 8, 9, 10)]  # elsewhere
    assert exactly_held(np.array(ties)) == {1, 2, 3, 4, 5}
    assert exactly_held(np.zeros((0, 2), np.int64)) == set()
