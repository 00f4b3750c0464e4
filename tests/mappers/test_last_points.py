"""Last points of a model are found meanwhile, and anew where images were taken out of it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers import last_points
from colmap_affrect.mappers.base import MappedModel
from colmap_affrect.mappers.last_points import LastPoints


class Adding:
    """Adds a point to models, and keeps in which threads."""

    def __init__(self) -> None:
        self.threads = list[int]()

    def __call__(self, model: pycolmap.Reconstruction) -> None:
        self.threads.append(threading.get_ident())
        model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track())


@pytest.fixture
def several_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(last_points, "available_cores", lambda: 2)


@pytest.fixture
def model(tmp_path: Path) -> pycolmap.Reconstruction:
    path = tmp_path / "database.db"
    return synthesize(path, num_rigs=4, num_points3D=30)


@pytest.mark.usefixtures("several_cores")
def test_points_are_found_while_a_model_stays_as_it_is(
    model: pycolmap.Reconstruction,
) -> None:
    adding = Adding()
    mapped = MappedModel(model, add_last_points=adding)
    points = LastPoints()
    points.begin([mapped])
    finished = points.added_to(mapped)
    assert model.num_points3D() == 30
    assert finished.num_points3D() == 31
    assert len(adding.threads) == 1
    assert adding.threads[0] != threading.get_ident()


@pytest.mark.usefixtures("several_cores")
def test_adjustments_that_normalize_quaternions_change_nothing(
    model: pycolmap.Reconstruction,
) -> None:
    """Scoring begins some; points would be found once more."""
    random = np.random.default_rng(0)
    for frame_id in model.reg_frame_ids():
        quaternion = model.frames[frame_id].rig_from_world.params[:4]
        quaternion[:] = random.normal(size=4)
    adding = Adding()
    mapped = MappedModel(model, add_last_points=adding)
    points = LastPoints()
    points.begin([mapped])
    for frame_id in model.reg_frame_ids():
        model.frames[frame_id].rig_from_world.rotation.normalize()
    assert points.added_to(mapped) is not model
    assert len(adding.threads) == 1


def without_an_image(model: pycolmap.Reconstruction) -> None:
    model.deregister_frame(model.reg_frame_ids()[0])


def with_another_pose(model: pycolmap.Reconstruction) -> None:
    model.frames[model.reg_frame_ids()[-1]].rig_from_world.params[5] += 1e-12


def with_another_camera(model: pycolmap.Reconstruction) -> None:
    model.cameras[max(model.cameras)].params[0] += 1e-9


def without_a_point(model: pycolmap.Reconstruction) -> None:
    model.delete_point3D(max(model.point3D_ids()))


@pytest.mark.usefixtures("several_cores")
@pytest.mark.parametrize(
    "change",
    [without_an_image, with_another_pose, with_another_camera, without_a_point],
)
def test_points_are_found_anew_for_a_model_that_was_changed(
    model: pycolmap.Reconstruction, change: Callable[[pycolmap.Reconstruction], None]
) -> None:
    adding = Adding()
    mapped = MappedModel(model, add_last_points=adding)
    points = LastPoints()
    points.begin([mapped])
    change(model)
    num_points = model.num_points3D()
    finished = points.added_to(mapped)
    assert finished is model
    assert model.num_points3D() == num_points + 1
    assert adding.threads[-1] == threading.get_ident()


@pytest.mark.usefixtures("several_cores")
def test_what_fails_meanwhile_fails_where_points_are_asked_for(
    model: pycolmap.Reconstruction,
) -> None:
    def fail(_: pycolmap.Reconstruction) -> None:
        raise OSError("no photograph")

    mapped = MappedModel(model, add_last_points=fail)
    points = LastPoints()
    points.begin([mapped])
    with pytest.raises(OSError, match="no photograph"):
        points.added_to(mapped)


@pytest.mark.parametrize(("num_cores", "max_images"), [(1, 100), (2, 3)])
def test_large_models_and_single_cores_wait_for_the_end(
    model: pycolmap.Reconstruction,
    monkeypatch: pytest.MonkeyPatch,
    num_cores: int,
    max_images: int,
) -> None:
    monkeypatch.setattr(last_points, "available_cores", lambda: num_cores)
    monkeypatch.setattr(last_points, "MAX_IMAGES", max_images)
    adding = Adding()
    mapped = MappedModel(model, add_last_points=adding)
    points = LastPoints()
    points.begin([mapped])
    assert points.added_to(mapped) is model
    assert adding.threads == [threading.get_ident()]


def test_models_of_other_mappers_have_no_last_points(
    model: pycolmap.Reconstruction,
) -> None:
    points = LastPoints()
    points.begin([])
    points.begin([MappedModel(model)])
    assert points.added_to(MappedModel(model)) is model
