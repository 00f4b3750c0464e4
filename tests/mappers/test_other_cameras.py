"""Other cameras that points do not exclude: how likely they are, and where photographs stand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord, with_shared_cameras
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers import hypotheses, own_cameras
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.other_cameras import OtherCameras, pose_turns_deg
from colmap_affrect.mappers.own_cameras import (
    one_camera,
    trial_with_own_cameras,
    with_per_image_cameras,
)
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.reliability import score_images
from colmap_affrect.mappers.reliability_features import features_of
from colmap_affrect.mappers.search import Search
from colmap_affrect.mappers.some_tracks import SOME_TRACKS


def task_of(path: Path, truth: pycolmap.Reconstruction) -> MappingTask:
    """Nothing is known of the cameras, which are all of one size."""
    records = {}
    for image in truth.images.values():
        size = image.camera.width, image.camera.height
        records[image.camera_id] = CameraRecord(
            (image.name,), "guess", 1.15 * max(size), size=size
        )
    return MappingTask(path, None, cameras=records, may_share=True)


def mapped(task: MappingTask, folder: Path) -> MappedModel:
    (found,) = mapper_of("sparse").map(task, folder, 0, lambda _: None)
    return found


def task_names(task: MappingTask) -> list[str]:
    """Return the names of all photographs."""
    return [name for record in task.cameras.values() for name in record.names]


def enlarged(path: Path, truth: pycolmap.Reconstruction) -> pycolmap.Image:
    """Enlarge the first photograph, and return it."""
    image = truth.images[min(truth.reg_image_ids())]
    middle = np.array([image.camera.width, image.camera.height]) / 2.0
    with open_database(path) as database:
        keypoints = database.read_keypoints(image.image_id)
        keypoints[:, :2] = (keypoints[:, :2] - middle) * 1.3 + middle
        database.update_keypoints(image.image_id, keypoints)
    return image


def with_an_enlarged_image(folder: Path) -> tuple[MappingTask, pycolmap.Image]:
    path = folder / "database.db"
    truth = synthesize(path, num_rigs=3, num_points3D=60, noise_px=0.5)
    return task_of(path, truth), enlarged(path, truth)


def test_log_odds_of_any_size_are_a_probability() -> None:
    turns_deg = {"a.jpg": 7.0}
    for log_odds, probability in ((-math.inf, 0.0), (0.0, 0.5), (2.0, 0.881), (1e6, 1)):
        pose = OtherCameras(log_odds, turns_deg).pose_of("a.jpg")
        assert pose.probability == pytest.approx(probability, abs=0.001)
        assert pose.turn_deg == 7.0
    assert OtherCameras(0.0, turns_deg).pose_of("b.jpg").turn_deg == 0.0


def test_a_pose_turns_by_what_it_does_beside_most_others(tmp_path: Path) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=5, num_points3D=50)
    changed = pycolmap.Reconstruction(truth)
    image = changed.images[max(changed.reg_image_ids())]
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.2, 0.0])), np.zeros(3))
    image.frame.set_cam_from_world(image.camera_id, turn * image.cam_from_world())
    found = pose_turns_deg(truth, changed)
    assert found.pop(image.name) == pytest.approx(np.degrees(0.2), rel=1e-4)
    assert max(found.values()) < 1e-3


def test_photographs_of_one_camera_stay_where_they_are_with_own_ones(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=3, num_points3D=80, noise_px=0.5)
    task = task_of(path, truth)
    found = mapped(task, tmp_path)
    assert found.other_cameras is not None
    assert abs(found.other_cameras.log_odds) < 5.0
    assert max(found.other_cameras.turns_deg.values()) < 2.0
    assert {
        name: of_image.with_other_cameras
        for name, of_image in features_of(found, task).items()
    } == {name: found.other_cameras.pose_of(name) for name in task_names(task)}
    known = mapped(MappingTask(path, None, cameras=task.cameras), tmp_path)
    assert known.other_cameras is None  # nothing was taken for shared


def test_an_enlarged_photograph_stands_elsewhere_with_a_camera_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # So that cameras stay shared
    monkeypatch.setattr(hypotheses, "MIN_SCORE_GAIN", 1e9)
    task, image = with_an_enlarged_image(tmp_path)
    found = mapped(task, tmp_path)
    assert found.other_cameras is not None
    assert found.other_cameras.log_odds > 3.0
    assert found.other_cameras.turns_deg[image.name] > 3.0
    without = replace(found, other_cameras=None)
    assert (
        score_images(found, task)[image.name].probability
        < 0.7 * score_images(without, task)[image.name].probability
    )


@pytest.mark.long
def test_that_cameras_may_be_shared_is_kept_by_models_that_go_on(
    tmp_path: Path,
) -> None:
    task, image = with_an_enlarged_image(tmp_path)
    found = mapped(task, tmp_path)
    assert found.other_cameras is not None
    assert found.other_cameras.are_shared
    assert found.other_cameras.turns_deg[image.name] > 3.0
    again = mapped(replace(task, previous_models=[found]), tmp_path)
    assert again.other_cameras == found.other_cameras


def test_cameras_of_their_own_are_as_likely_as_the_score_pays_for_their_number(
    tmp_path: Path,
) -> None:
    """Three focal lengths more: half the logarithm of the number of cells each, about 7 nats."""
    model = synthesize(tmp_path / "own.db", num_rigs=4, num_points3D=100)
    shared = synthesize(
        tmp_path / "one.db", num_rigs=1, num_frames_per_rig=4, num_points3D=100
    )
    hardly = one_camera(model, shared, 3.0)
    clearly = one_camera(model, shared, 30.0)
    assert hardly.log_odds - clearly.log_odds == pytest.approx(27.0)
    assert 3.0 < hardly.log_odds < 8.0
    assert hardly.are_shared
    assert hardly.turns_deg == pose_turns_deg(model, shared)


def test_pairs_that_a_hypothesis_leaves_out_make_own_cameras_no_less_likely(
    tmp_path: Path,
) -> None:
    """Both models are scored by the same pairs."""
    path = tmp_path / "database.db"
    truth = synthesize(path, num_rigs=4, num_points3D=100, noise_px=0.4)
    task = task_of(path, truth)
    mapper = mapper_of("sparse")
    graph = PairGraph.read(path)
    native = mapper.native(task, 0)
    per_image = mapper._search(task, graph, native, lambda _: None)
    cameras = with_shared_cameras(task.cameras)
    sharing = replace(task, cameras=cameras)
    shared = mapper._search(
        sharing, graph.with_cameras(cameras), native, lambda _: None
    )
    model = shared.best(shared.graph)[0].reconstruction
    first, second, third, _ = sorted(model.reg_image_ids())
    some = graph.without({(first, second), (first, third)})
    found = with_per_image_cameras(per_image, some, shared, model)
    assert found.other is not None
    assert abs(found.other.log_odds) < 3.0


def test_own_cameras_are_tried_once_while_a_model_gets_the_points_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = synthesize(tmp_path / "database.db", num_rigs=5, num_points3D=2500)
    num_points = list[int]()

    def trial(
        per_image: Search, thin: PairGraph, model: pycolmap.Reconstruction
    ) -> pycolmap.Reconstruction:
        num_points.append(model.num_points3D())
        return trial_with_own_cameras(per_image, thin, model)

    monkeypatch.setattr(hypotheses, "trial_with_own_cameras", trial)
    monkeypatch.setattr(own_cameras, "trial_with_own_cameras", None)
    model = mapped(task_of(tmp_path / "database.db", truth), tmp_path)
    assert SOME_TRACKS in model.hypotheses
    (num_some,) = num_points
    assert 0 < num_some < model.reconstruction.num_points3D() / 2
