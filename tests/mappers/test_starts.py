"""Focal lengths to start from, cameras that run away, and cameras that the user gave."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from mapping_tasks import ALL_GIVEN, WHOLE

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers import attempts
from colmap_affrect.mappers import starts as module
from colmap_affrect.mappers.attempts import MAX_HOLDING_ATTEMPTS, map_database
from colmap_affrect.mappers.base import MAPPERS, Bridge, MappedModel, MapperOptions, MappingTask
from colmap_affrect.mappers.doubts import FOCAL_DOUBT
from colmap_affrect.mappers.incremental import IncrementalOptions
from colmap_affrect.mappers.starts import (
    MAX_EXCESS,
    Start,
    holding,
    is_within,
    rival_focals_px,
    runaways,
    started,
    starts,
)
from colmap_affrect.mappers.summaries import read_summary
from colmap_affrect.project.report import ModelSummary

TRUE_FOCAL, NUM_IMAGES = 1280.0, 4
VAGUE = CameraRecord(("a",), "guess", 1000.0, 500.0, 2000.0, size=(1024, 768))
KNOWN = CameraRecord(("b",), "pairs", 1300.0, 1200.0, 1400.0, size=(1024, 768))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pycolmap.Reconstruction]:
    """A verified database of images with a camera each, and the truth."""
    path = tmp_path_factory.mktemp("scene") / "database.db"
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=NUM_IMAGES,
        num_frames_per_rig=1,
        num_points3D=150,
        camera_has_prior_focal_length=True,
    )
    pycolmap.set_random_seed(3)
    with open_database(path) as database:
        truth = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5)
        pycolmap.synthesize_noise(noise, truth, database)
    return path, truth


def records(
    scene: tuple[Path, pycolmap.Reconstruction], record: CameraRecord
) -> dict[int, CameraRecord]:
    names = {image.camera_id: image.name for image in scene[1].images.values()}
    return {key: replace(record, names=(name,)) for key, name in names.items()}


def task_of(cameras: dict[int, CameraRecord]) -> MappingTask:
    return MappingTask(Path("database.db"), None, cameras=cameras)


def test_vague_cameras_start_from_both_sides_and_known_ones_from_what_is_known() -> None:
    wider = replace(VAGUE, focal_px=900.0, low_px=900.0, high_px=1600.0)
    no_vote = replace(VAGUE, low_px=None, high_px=None)
    task = task_of({1: VAGUE, 2: KNOWN, 3: wider, 4: no_vote})
    first, straight, low, high, long = starts(task)
    assert (first, straight) == (Start(), Start(distortion_held=True))
    assert low.focals_px == {1: pytest.approx(500.0 * 2**0.5)}
    assert high.focals_px == {1: pytest.approx(1000.0 * 2**0.5), 3: pytest.approx(1200.0)}
    assert long.focals_px == {key: pytest.approx(2.4 * 1024) for key in (1, 3)}
    assert all(start.distortion_held for start in (low, high, long))
    assert starts(task_of({2: KNOWN, 4: no_vote})) == [Start()]
    assert starts(task_of({})) == [Start()]


def test_a_start_changes_a_copy_of_the_database(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    task = MappingTask(scene[0], None, snapshot_path=tmp_path)
    straight = started(task, Start(distortion_held=True), tmp_path / "started.db")
    assert (straight.database_path, straight.distortion_held) == (task.database_path, True)
    before = scene[0].read_bytes()
    for focal in (700.0, 900.0):  # the second one replaces the first
        moved = started(task, Start({2: focal}), tmp_path / "started.db")
        assert moved.snapshot_path is None
        with open_database(moved.database_path) as database:
            focals = [camera.focal_length for camera in database.read_all_cameras()]
        assert focals == [TRUE_FOCAL, focal, TRUE_FOCAL, TRUE_FOCAL]
    assert scene[0].read_bytes() == before


def test_cameras_far_beyond_their_interval_ran_away(
    scene: tuple[Path, pycolmap.Reconstruction],
) -> None:
    low, high = KNOWN.low_px or 0.0, KNOWN.high_px or 0.0
    assert is_within(high * MAX_EXCESS, KNOWN)
    assert not is_within(1.01 * high * MAX_EXCESS, KNOWN)
    assert is_within(low / MAX_EXCESS, KNOWN)
    assert not is_within(0.99 * low / MAX_EXCESS, KNOWN)
    assert is_within(1e9, replace(KNOWN, low_px=None))
    guess = replace(KNOWN, source="guess", low_px=300.0, high_px=400.0)
    assert is_within(2.4 * 1024 * MAX_EXCESS, guess)
    assert not is_within(2.41 * 1024 * MAX_EXCESS, guess)
    assert is_within(300.0 / MAX_EXCESS, guess)
    assert is_within(0.7 * 1024 / MAX_EXCESS, replace(guess, low_px=900.0))
    assert is_within(3000.0 * MAX_EXCESS, replace(guess, high_px=3000.0))
    cameras = {1: KNOWN, 2: replace(KNOWN, low_px=300.0, high_px=400.0), 3: guess, 99: VAGUE}
    assert runaways(scene[1], replace(task_of(cameras))) == {2}


class Recorder:
    """A mapper that returns a model as it is told, and records its tasks."""

    def __init__(self, answer: Callable[[MappingTask], list[MappedModel]], num: int = 1) -> None:
        self.options: MapperOptions = IncrementalOptions(max_num_attempts=num)
        self.answer = answer
        self.focals: list[list[float]] = []
        self.held: list[set[int]] = []

    def map(self, task: MappingTask, *_: object) -> list[MappedModel]:
        with open_database(task.database_path) as database:
            self.focals.append([c.focal_length for c in database.read_all_cameras()])
        self.held.append(set(task.held))
        return self.answer(task)


def mapped(
    scene: tuple[Path, pycolmap.Reconstruction],
    tmp_path: Path,
    mapper: object,
    cameras: dict[int, CameraRecord],
) -> None:
    map_task(mapper, MappingTask(scene[0], None, cameras=cameras), tmp_path)


def map_task(mapper: object, task: MappingTask, tmp_path: Path) -> list[ModelSummary]:
    summaries = map_database(mapper, task, tmp_path / "sparse", lambda _: None)
    assert not (tmp_path / "sparse.partial").exists()
    return summaries


def without(
    scene: tuple[Path, pycolmap.Reconstruction], num: int, **focals: float
) -> list[MappedModel]:
    """Return the truth, some images missing, with other focal lengths of cameras c1, c2, ..."""
    model = pycolmap.Reconstruction(scene[1])
    for image_id in sorted(model.reg_image_ids())[NUM_IMAGES - num :]:
        model.deregister_frame(model.images[image_id].frame_id)
    for name, focal in focals.items():
        model.cameras[int(name[1:])].focal_length = focal
    return [MappedModel(model)]


def test_unknown_cameras_are_started_from_all_sides_unless_all_images_are_tied_well(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = {**records(scene, replace(KNOWN, focal_px=TRUE_FOCAL)), 2: VAGUE}
    tied = Recorder(lambda _: without(scene, 0))
    mapped(scene, tmp_path, tied, cameras)
    assert len(tied.focals) == 1
    monkeypatch.setattr(attempts, "MIN_NUM_TRACKS", 1_000)
    mapper = Recorder(lambda _: without(scene, 0))
    mapped(scene, tmp_path, mapper, cameras)
    assert [focals[1] for focals in mapper.focals] == pytest.approx(
        [1280.0, 1280.0, 707.1, 1414.2, 2457.6], abs=0.1
    )
    assert {focals[0] for focals in mapper.focals} == {TRUE_FOCAL}
    known = Recorder(lambda _: without(scene, 0), num=3)
    mapped(scene, tmp_path, known, records(scene, KNOWN))
    assert len(known.focals) == 1
    missing = Recorder(lambda _: without(scene, 1), num=3)
    mapped(scene, tmp_path, missing, records(scene, KNOWN))
    assert len(missing.focals) == 3


def test_rivals_agree_as_well_with_the_pairs_and_differ_by_more_than_a_step() -> None:
    best, worse = {"a": 1000.0, "b": 500.0, "c": 800.0}, {"a": 100.0}
    rival, other = {"a": 1300.0, "b": 550.0}, {"a": 900.0, "b": 500.0}
    attempts = [(0.96, worse), (1.0, best), (0.98, rival), (0.97, other)]
    assert rival_focals_px(attempts) == {"a": (900.0, 1300.0)}


def test_focal_lengths_that_pairs_cannot_tell_apart_are_kept_beside_the_model(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempts, "MIN_NUM_TRACKS", 1_000)
    monkeypatch.setattr(module, "MIN_SHARE_OF_RIVAL", 0.0)
    focals = iter([1280.0, 1360.0, 1150.0, 1200.0, 1250.0])
    mapper = Recorder(lambda _: without(scene, 0, c2=next(focals)))
    cameras = {**records(scene, replace(KNOWN, focal_px=TRUE_FOCAL)), 2: VAGUE}
    mapped(scene, tmp_path, mapper, cameras)
    (name,) = (image.name for image in scene[1].images.values() if image.camera_id == 2)
    read = read_summary(tmp_path / "sparse" / "0")
    assert read
    assert read.rival_focals_px == {name: (1150.0, 1360.0)}


def test_cameras_of_another_model_are_held_and_what_it_says_of_them_holds(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempts, "MIN_NUM_TRACKS", 1_000)
    (model,) = (found.reconstruction for found in without(scene, 1, c1=1100.0, c2=1200.0))
    inside = {model.images[image_id].camera_id for image_id in model.reg_image_ids()}
    names = {image.camera_id: image.name for image in scene[1].images.values()}
    told_by = ModelSummary(
        tuple(sorted(names[key] for key in inside)), 1, 2.0, 0.5,
        doubtful={names[1]: f"held by only 9 points; {FOCAL_DOUBT}"},
        rival_focals_px={names[2]: (1000.0, 1300.0)},
    )  # fmt: skip
    task = MappingTask(scene[0], None, snapshot_path=tmp_path, cameras=records(scene, VAGUE))
    held = holding(task, model, told_by, tmp_path / "held.db")
    assert (held.held, held.snapshot_path) == (inside, None)
    (outside,) = names.keys() - inside
    assert all(set(start.focals_px) <= {outside} for start in starts(held))
    mapper = Recorder(lambda _: without(scene, 0))
    (summary,) = map_task(mapper, held, tmp_path)
    assert {(focals[0], focals[1]) for focals in mapper.focals} == {(1100.0, 1200.0)}
    assert FOCAL_DOUBT in summary.doubtful[names[1]]
    assert not any(FOCAL_DOUBT in summary.doubtful.get(names[key], "") for key in inside - {1})
    assert summary.rival_focals_px[names[2]] == (1000.0, 1300.0)


def test_what_is_known_of_cameras_without_images_is_not_held_nor_shared(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    vague = replace(VAGUE, may_be_shared=True)
    task = MappingTask(scene[0], None, cameras=records(scene, vague))
    shared, *_ = starts(task)
    found = started(task, shared, tmp_path / "started.db")
    with open_database(found.database_path) as database:
        (camera,) = database.read_all_cameras()
        names = [image.name for image in database.read_all_images()]
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    for number, name in enumerate(sorted(names)[:-1], 1):
        image = pycolmap.Image(name, camera_id=camera.camera_id, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    held = holding(task, model, ModelSummary((), 1, 2.0, 0.5), tmp_path / "held.db")
    assert held.held == {camera.camera_id}
    assert len(held.cameras) == 2
    for number, start in enumerate(starts(held)):
        assert not start.records
        started(held, start, tmp_path / f"{number}.db")


def test_a_camera_that_ran_away_is_held(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    def answer(task: MappingTask) -> list[MappedModel]:
        return without(scene, 0) if 3 in task.held else without(scene, 1, c3=9e5)

    mapper = Recorder(answer)
    mapped(scene, tmp_path, mapper, records(scene, KNOWN))
    assert mapper.held == [set(), {3}]
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert model.cameras[3].focal_length == TRUE_FOCAL
    assert model.num_reg_images() == NUM_IMAGES


def test_attempts_to_hold_cameras_end(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path
) -> None:
    """Other ones run away each time."""

    def answer(task: MappingTask) -> list[MappedModel]:
        free = sorted({1, 2, 3} - task.held)
        return without(scene, 1, **{f"c{free[0]}": 9e5} if free else {})

    mapper = Recorder(answer)
    mapped(scene, tmp_path, mapper, records(scene, KNOWN))
    assert len(mapper.held) == 1 + MAX_HOLDING_ATTEMPTS
    assert mapper.held[-1] == {1, 2}


def test_images_that_the_last_adjustment_leaves_without_points_are_taken_out(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose_points(model: pycolmap.Reconstruction, *_: object, **__: object) -> None:
        image = model.images[max(model.reg_image_ids())]
        for index in image.get_observation_point2D_idxs()[3:]:
            model.delete_observation(image.image_id, index)

    monkeypatch.setattr(attempts, "adjust_last", lose_points)
    name = scene[1].images[min(scene[1].reg_image_ids())].name
    bridge = Bridge(("a", name), (name,), 20, 20, 0.01)
    mapper = Recorder(lambda _: [replace(m, bridges=(bridge,)) for m in without(scene, 0)])
    mapped(scene, tmp_path, mapper, records(scene, KNOWN))
    model = read_summary(tmp_path / "sparse" / "0")
    assert model
    assert len(model.registered_names) == NUM_IMAGES - 1
    assert list(model.taken_out.values()) == ["held by only 3 points"]


def test_large_models_are_mapped_once(
    scene: tuple[Path, pycolmap.Reconstruction], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempts, "LARGE_MODEL", NUM_IMAGES)
    mapper = Recorder(lambda _: without(scene, 0))
    mapped(scene, tmp_path, mapper, {**records(scene, KNOWN), 2: VAGUE})
    assert len(mapper.focals) == 1


GIVEN = CameraRecord(("a",), "given", 1300.0, size=(1024, 768), given=("focal",))
FREE = replace(GIVEN, source="exif", given=())


@pytest.mark.parametrize("mapper", MAPPERS.names())
@pytest.mark.parametrize(
    ("cameras", "kept", "distortion_kept"),
    [
        ([GIVEN] * 4, {1, 2, 3, 4}, set()),
        ([GIVEN, FREE, WHOLE, FREE], {1, 3}, {1, 3}),
        ([FREE] * 4, set(), set()),
    ],
    ids=["focals", "mixed", "none"],
)
def test_given_parts_of_cameras_stay(
    scene: tuple[Path, pycolmap.Reconstruction],
    tmp_path: Path,
    mapper: str,
    cameras: list[CameraRecord],
    kept: set[int],
    distortion_kept: set[int],
) -> None:
    """One whose focal length is given has its distortion refined if all are of that kind."""
    path = tmp_path / "database.db"
    path.write_bytes(scene[0].read_bytes())
    with open_database(path) as database:
        for camera in database.read_all_cameras():
            camera.params = [1300.0, *camera.params[1:3], 0.0]
            database.update_camera(camera)
    task = MappingTask(path, None, cameras=dict(enumerate(cameras, 1)))
    options = MAPPERS.options({"name": mapper})
    map_database(MAPPERS.make(options), task, tmp_path / "sparse", lambda _: None)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert model.num_reg_images() == NUM_IMAGES
    params = {key: camera.params for key, camera in model.cameras.items()}
    assert {key for key, values in params.items() if values[0] == 1300.0} == kept
    assert {key for key, values in params.items() if values[3] == 0.0} == distortion_kept


@pytest.mark.parametrize("name", MAPPERS.names())
def test_report_says_what_of_cameras_is_not_refined(name: str) -> None:
    def held(task: MappingTask, **options: object) -> set[str]:
        differs = MAPPERS.make(MAPPERS.options({"name": name, **options})).differences(task)
        return {key.split("refine_")[1] for key, value in differs.items() if "refine_" in key}

    assert held(task_of({1: GIVEN, 2: WHOLE})) == {"focal_length"}
    assert held(ALL_GIVEN) == {"focal_length", "extra_params"}
    assert held(task_of({1: GIVEN, 2: FREE})) == held(task_of({})) == set()
    assert held(ALL_GIVEN, keep_given_intrinsics=False) == set()
    assert held(replace(task_of({1: FREE}), distortion_held=True)) == {"extra_params"}


def test_given_focal_lengths_are_refined_where_that_is_asked_for() -> None:
    task = task_of({1: GIVEN, 2: FREE})
    assert task.constant_cameras(IncrementalOptions()) == {1}
    assert task.constant_cameras(IncrementalOptions(keep_given_intrinsics=False)) == set()
    assert replace(task, held=frozenset({2})).constant_cameras(IncrementalOptions()) == {1, 2}
    assert not task_of({}).keeps_focal_lengths(IncrementalOptions())
