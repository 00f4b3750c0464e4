"""A finished model takes in new images: ids, cameras, rigs and keypoints may differ."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from mapping_tasks import (
    NOTHING_KNOWN,
    SEED,
    mapper_of,
    synthesize,
    task_with_given_cameras,
)

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers import scored_models, snapshots
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.existing import Extension, read_existing
from colmap_affrect.mappers.mapping import map_database

NUM_IMAGES = 10
NUM_OLD = 5
SCENE = {"num_rigs": 2, "num_frames_per_rig": 5, "num_points3D": 200, "noise_px": 0.5}


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("extension") / "database.db"
    synthesize(path, **SCENE)
    return path


@pytest.fixture(scope="module")
def old(database: Path) -> pycolmap.Reconstruction:
    """A model of half of the images, moved, and of other ids than the database's."""
    native = mapper_of("incremental").native(NOTHING_KNOWN, SEED)
    with open_database(database) as opened:
        names = [image.name for image in opened.read_all_images()]
    native.image_names = names[1::2]
    native.extract_colors = False
    output = database.parent / "old"
    output.mkdir()
    model = pycolmap.incremental_mapping(
        database, database.parent, output, options=native
    )[0]
    assert model.num_reg_images() == NUM_OLD
    turn = pycolmap.Rotation3d(np.array([0.1, 0.7, -0.2]))
    model.transform(pycolmap.Sim3d(3.0, turn, np.array([50.0, -20.0, 7.0])))
    return with_other_ids(model)


def with_other_ids(
    model: pycolmap.Reconstruction, pixels: float = 0.0
) -> pycolmap.Reconstruction:
    """The same model, every image with a camera and ids of its own, keypoints moved by pixels."""
    new = pycolmap.Reconstruction()
    ids = {}
    for number, image_id in enumerate(sorted(model.reg_image_ids(), reverse=True)):
        image = model.image(image_id)
        camera = pycolmap.Camera(model.camera(image.camera_id).todict())
        camera.camera_id = 70 + number
        new.add_camera_with_trivial_rig(camera)
        points = np.array([point.xy for point in image.points2D]) + pixels
        ids[image_id] = 40 + 3 * number
        other = pycolmap.Image(image.name, points, camera.camera_id, ids[image_id])
        new.add_image_with_trivial_frame(other, image.cam_from_world())
    for point in model.points3D.values():
        track = [
            pycolmap.TrackElement(ids[e.image_id], e.point2D_idx)
            for e in point.track.elements
        ]
        new.add_point3D(point.xyz, pycolmap.Track(track), np.array([1, 2, 3], np.uint8))
    return new


def written(model: pycolmap.Reconstruction, folder: Path) -> Path:
    folder.mkdir()
    model.write(folder)
    return folder


def poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {image.name: image.cam_from_world().matrix() for image in images}


def center(pose: np.ndarray) -> np.ndarray:
    return -pose[:, :3].T @ pose[:, 3]


def cameras(model: pycolmap.Reconstruction) -> dict[str, list[float]]:
    images = [model.image(image_id) for image_id in model.reg_image_ids()]
    return {
        image.name: model.camera(image.camera_id).params.tolist() for image in images
    }


def extended(
    database: Path,
    old: pycolmap.Reconstruction,
    folder: Path,
    at: str = "old",
    **options: bool,
) -> tuple[pycolmap.Reconstruction, list[int]]:
    """Write a model into a folder and extend it; return the result and what progress showed."""
    shown: list[int] = []
    existing = read_existing(
        Extension(model_path=written(old, folder / at), **options), database
    )
    task = MappingTask(database, None, extend=existing)
    (model,) = map_database(
        mapper_of("incremental"), task, folder / "sparse", shown.append
    )
    assert len(model.registered_names) == NUM_IMAGES
    return pycolmap.Reconstruction(folder / "sparse" / "0"), shown


@pytest.mark.parametrize("pixels", [0.0, 0.3])
def test_old_poses_and_cameras_stay_to_the_bit(
    database: Path, old: pycolmap.Reconstruction, tmp_path: Path, pixels: float
) -> None:
    model, shown = extended(database, with_other_ids(old, pixels), tmp_path)
    assert shown == [NUM_OLD, *[1] * (NUM_IMAGES - NUM_OLD)]
    now = poses(model)
    before = poses(old)
    for name, pose in before.items():
        assert now[name].tobytes() == pose.tobytes(), name
        assert cameras(model)[name] == cameras(old)[name]
    assert model.num_points3D() > 150
    assert sorted(p.name for p in tmp_path.iterdir()) == ["old", "sparse"]


def test_the_model_that_is_extended_stays_until_all_images_are_scored(
    database: Path,
    old: pycolmap.Reconstruction,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "sparse").mkdir()
    monkeypatch.setattr(
        scored_models, "score_images", Mock(side_effect=KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        extended(database, old, tmp_path, "sparse/0")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sparse"]
    assert (
        poses(pycolmap.Reconstruction(tmp_path / "sparse" / "0")).keys()
        == poses(old).keys()
    )


def test_old_poses_may_move_and_stay_in_their_frame(
    database: Path, old: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    model, _ = extended(database, old, tmp_path, refine_existing=True)
    moved = [
        np.abs(poses(model)[name] - pose).max() for name, pose in poses(old).items()
    ]
    assert (
        1e-6 < max(moved) < 0.3
    )  # the cameras are some 20 units apart, 50 from the origin
    assert cameras(model) != {**cameras(model), **cameras(old)}


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_new_images_are_where_they_were_taken(
    database: Path, old: pycolmap.Reconstruction, tmp_path: Path, scale: float
) -> None:
    old = pycolmap.Reconstruction(old)
    old.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(), np.zeros(3)))
    model, _ = extended(database, old, tmp_path)
    native = mapper_of("incremental").native(NOTHING_KNOWN, SEED)
    native.extract_colors = False
    (tmp_path / "all").mkdir()
    whole = pycolmap.incremental_mapping(
        database, tmp_path, tmp_path / "all", options=native
    )[0]
    one = poses(model)
    other = poses(whole)
    first, *others = sorted(one)
    ratios: list[float] = []
    for name in others:
        rotations = [p[name][:, :3] @ p[first][:, :3].T for p in (one, other)]
        assert np.trace(rotations[0] @ rotations[1].T) > 3 - 1e-4
        steps = [
            np.linalg.norm(center(p[name]) - center(p[first])) for p in (one, other)
        ]
        ratios.append(float(steps[0] / steps[1]))
    assert max(ratios) < 1.01 * min(ratios)


def test_images_without_matches_stay_in_the_model(
    database: Path, old: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    path = tmp_path / "database.db"
    path.write_bytes(database.read_bytes())
    lonely = sorted(poses(old))[0]
    with open_database(path) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        for other in set(ids.values()) - {ids[lonely]}:
            opened.delete_matches(ids[lonely], other)
            opened.delete_two_view_geometry(ids[lonely], other)
    model, _ = extended(path, with_other_ids(old, 0.3), tmp_path)
    assert poses(model)[lonely].tobytes() == poses(old)[lonely].tobytes()


def test_rigs_get_the_poses_of_their_cameras(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, **SCENE | {"num_rigs": 1, "num_cameras_per_rig": 2})
    single = with_other_ids(truth)
    existing = read_existing(
        Extension(model_path=written(single, tmp_path / "old")), path
    )
    for name, pose in poses(existing.reconstruction).items():
        np.testing.assert_allclose(pose, poses(truth)[name], atol=1e-9)
    assert existing.reconstruction.num_reg_frames() == 5


def database_cameras(path: Path) -> list[str]:
    with open_database(path) as database:
        return [str(camera.todict()) for camera in database.read_all_cameras()]


def test_cameras_may_have_another_model_than_in_the_database(
    database: Path, old: pycolmap.Reconstruction, tmp_path: Path
) -> None:
    other = with_other_ids(old, 0.3)
    for camera in other.cameras.values():
        f, cx, cy, k = camera.params
        camera.model = pycolmap.CameraModelId.RADIAL
        camera.params = [f, cx, cy, k, 0.0]
    before = database_cameras(database)
    model, _ = extended(database, other, tmp_path)
    for name, pose in poses(old).items():
        assert poses(model)[name].tobytes() == pose.tobytes()
        assert cameras(model)[name] == cameras(other)[name]
    assert database_cameras(database) == before


def broken(old: pycolmap.Reconstruction, kind: str, folder: Path) -> Path:
    model = with_other_ids(old)
    first = model.image(model.reg_image_ids()[0])
    if kind == "name":
        first.name = "unknown.png"
    elif kind == "size":
        model.camera(first.camera_id).width += 7
    elif kind == "camera":
        model.camera(first.camera_id).params = [
            *model.camera(first.camera_id).params[:-1],
            0.3,
        ]
    elif kind == "empty":
        model = pycolmap.Reconstruction()
    path = written(model, folder)
    if kind == "damaged":
        (path / "images.bin").write_bytes((path / "images.bin").read_bytes()[:-9])
    return path


@pytest.mark.parametrize(("kind", "message"), [
    ("name", "1 of its 5 images, such as unknown.png, are not among the photographs"),
    ("size", r"is \d+ x \d+ px there and \d+ x \d+ px here"),
    ("camera", "have different cameras there and share one here"),
    ("empty", "has no images with poses"),
    ("damaged", r"damaged \(it ends within a record"),
])  # fmt: skip
def test_model_that_does_not_fit_is_one_clear_line(
    database: Path,
    old: pycolmap.Reconstruction,
    tmp_path: Path,
    kind: str,
    message: str,
) -> None:
    path = broken(old, kind, tmp_path / "old")
    with pytest.raises(AffrectError, match=message) as error:
        read_existing(Extension(model_path=path), database)
    assert "\n" not in str(error.value)
    with pytest.raises(AffrectError, match="not a COLMAP model"):
        read_existing(Extension(model_path=tmp_path), database)


def stop_after(number: int, token: pycolmap.CancellationToken) -> Any:
    count = 0

    def show(news: int) -> None:
        nonlocal count
        count += news
        if count >= number:
            token.cancel()

    return show


def test_mapping_that_was_stopped_goes_on_from_its_snapshot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, **SCENE)
    monkeypatch.setattr(snapshots, "SNAPSHOT_FRAMES", 2)
    token = pycolmap.CancellationToken()
    task = MappingTask(path, None, cancellation=token)
    with pytest.raises(KeyboardInterrupt):
        map_database(
            mapper_of("incremental"), task, tmp_path / "sparse", stop_after(8, token)
        )
    (folder,) = (tmp_path / "sparse.snapshots").iterdir()
    left = snapshots.largest_snapshot(folder)
    names = set(snapshots.registered_names(left))
    assert 4 <= len(names) < NUM_IMAGES
    assert (
        len([found for found in folder.iterdir() if found.is_dir()])
        <= snapshots.NUM_KEPT + 1
    )
    half = folder / "9999999999999"  # as a kill leaves the one that was being written
    half.mkdir()
    (half / "images.bin").write_bytes((left / "images.bin").read_bytes()[:-5])
    shown: list[int] = []
    (model,) = map_database(
        mapper_of("incremental"),
        MappingTask(path, None),
        tmp_path / "sparse",
        shown.append,
    )
    assert shown[0] == len(names)
    assert sum(shown) == len(model.registered_names) == NUM_IMAGES
    assert sorted(p.name for p in tmp_path.iterdir()) == ["database.db", "sparse"]


@pytest.mark.parametrize(
    ("num_images", "expected"), [(100, 100), (1000, 100), (5000, 500)]
)
def test_larger_sets_have_no_more_snapshots(num_images: int, expected: int) -> None:
    """What they cost then grows as the images do, not as their square."""
    assert snapshots.frames_between_snapshots(num_images) == expected


def test_snapshots_of_other_options_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    synthesize(path, **SCENE)
    task = MappingTask(path, None)
    folder = tmp_path / "sparse.snapshots"

    def fail(num_images: int, **options: Any) -> None:
        with snapshots.with_snapshots(
            task, mapper_of("incremental", **options).options, folder, num_images
        ) as it:
            assert (it.snapshot_path is None) == (num_images == 1)
            if it.snapshot_path and not options:
                (it.snapshot_path / "1").mkdir()
            raise OSError("full")

    monkeypatch.setattr(snapshots, "SNAPSHOT_FRAMES", 2)
    for num_images in (1, 10):
        assert not folder.exists()
        with pytest.raises(OSError, match="full"):
            fail(num_images)
    with snapshots.with_snapshots(
        task, mapper_of("incremental").options, folder, 10
    ) as it:
        assert (it.snapshot_path / "1").exists()
    assert not folder.exists()
    with pytest.raises(OSError, match="full"):
        fail(10)
    with pytest.raises(OSError, match="full"):
        fail(10, min_model_size=3)
    assert not folder.exists()


def test_snapshots_of_other_cameras_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are of the same pairs, with as many inliers."""
    path = tmp_path / "database.db"
    folder = tmp_path / "sparse.snapshots"
    synthesize(path, **SCENE)
    task = MappingTask(path, None)
    options = mapper_of("incremental").options
    monkeypatch.setattr(snapshots, "SNAPSHOT_FRAMES", 2)

    def is_gone_on_with(task: MappingTask) -> bool:
        found = []
        with (
            suppress(OSError),
            snapshots.with_snapshots(task, options, folder, 10) as it,
        ):
            found.append((it.snapshot_path / "1").exists())
            (it.snapshot_path / "1").mkdir(exist_ok=True)
            raise OSError("full")
        return found[0]

    assert [is_gone_on_with(task) for _ in range(2)] == [False, True]
    with open_database(path) as database:
        camera = database.read_all_cameras()[0]
        camera.params = camera.params * 1.01
        database.update_camera(camera)
    assert [is_gone_on_with(task) for _ in range(2)] == [False, True]
    assert not is_gone_on_with(task_with_given_cameras(path))
