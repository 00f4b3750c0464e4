"""The last adjustment of models: what goes, what stays, what moves."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import inlier_matches
from colmap_affrect.mappers import attempts
from colmap_affrect.mappers.attempts import map_database
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.incremental import IncrementalOptions
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
        camera.params[3] = 0.0
    begun = copy.deepcopy(dict(model.cameras))
    for camera in model.cameras.values():
        camera.params[3] = start
    adjust_last(model, {}, {}, starts=begun)
    ends = [camera.params[3] for camera in model.cameras.values()]
    assert ends == ([0.0] if true == 0.0 else pytest.approx([true], abs=0.05))


def test_a_model_without_points_is_left_as_it_is(model: pycolmap.Reconstruction) -> None:
    begun = copy.deepcopy(dict(model.cameras))
    for point_id in list(model.point3D_ids()):
        model.delete_point3D(point_id)
    assert adjust_last(model, {}, {}, starts=begun) == 0
    assert model.num_reg_images() == LAST


class RefiningTooMuch:
    """Has a true model, and gives its cameras another distortion than the database has."""

    def __init__(self, model: pycolmap.Reconstruction, options: dict[str, bool]) -> None:
        self.model = copy.deepcopy(model)
        self.options = IncrementalOptions(mapper_options=options)

    def map(self, *_: object) -> list[MappedModel]:
        for camera in self.model.cameras.values():
            camera.params[0] *= 1.01
            camera.params[3] += 0.01
        return [MappedModel(self.model)]


def task_of(path: Path, model: pycolmap.Reconstruction) -> MappingTask:
    """Of cameras that nobody knows, as another program's database has them."""
    names = {image.camera_id: image.name for image in model.images.values()}
    records = {
        key: CameraRecord((name,), "guess", 1280.0, 600.0, 2400.0) for key, name in names.items()
    }
    return MappingTask(path, None, cameras=records)


@pytest.mark.parametrize(
    ("options", "is_refined"),
    [({}, (True, False)), ({"ba_refine_focal_length": False}, (False, False)),
     ({"ba_refine_extra_params": False}, (True, True))],
)  # fmt: skip
def test_distortion_is_held_at_its_start_and_what_is_not_to_be_refined_stays(
    tmp_path: Path, options: dict[str, bool], is_refined: tuple[bool, bool]
) -> None:
    synthetic = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=LAST)
    synthetic.camera_params = [1280.0, 512.0, 384.0, 0.05]
    pycolmap.set_random_seed(1)
    with open_database(tmp_path / "database.db") as database:
        true = pycolmap.synthesize_dataset(synthetic, database)
        pycolmap.synthesize_noise(
            pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), true, database
        )
    mapper, task = RefiningTooMuch(true, options), task_of(tmp_path / "database.db", true)
    map_database(mapper, task, tmp_path / "sparse", lambda _: None)
    (camera,) = pycolmap.Reconstruction(tmp_path / "sparse" / "0").cameras.values()
    focal_moved = camera.params[0] != 1280.0 * 1.01
    assert (focal_moved, camera.params[3] != 0.05) == is_refined
    if is_refined[1]:
        assert camera.params[3] == pytest.approx(0.06)


def test_large_models_whose_cameras_nobody_knows_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempts, "LARGE_MODEL", LAST)
    with open_database(tmp_path / "database.db") as database:
        pycolmap.set_random_seed(1)
        true = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=LAST), database
        )
    mapper = RefiningTooMuch(true, {})
    map_database(mapper, task_of(tmp_path / "database.db", true), tmp_path / "s", lambda _: None)
    (camera,) = pycolmap.Reconstruction(tmp_path / "s" / "0").cameras.values()
    assert camera.params[0] == 1280.0 * 1.01


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
