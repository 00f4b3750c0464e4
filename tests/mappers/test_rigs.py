"""Rigs: models of them take little work, and what the caller holds stays as it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pyceres
import pytest
from mapping_tasks import mapper_of, synthesize

import colmap_affrect
from colmap_affrect.colmap import model_files, pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import all_see_long_tracks, num_long_tracks
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers import focal_observability, reliability_features, rigs
from colmap_affrect.mappers.adjustment import EarlyStop
from colmap_affrect.mappers.base import MappedModel, MappingTask
from colmap_affrect.mappers.focal_observability import (
    MAX_NUM_OBSERVATIONS,
    focal_growths,
    with_fewer_points,
)
from colmap_affrect.mappers.hypotheses import ALL_PAIRS
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.mappers.pair_graph import PairGraph
from colmap_affrect.mappers.rigs import COLMAP_MODEL
from colmap_affrect.mappers.search import first_pairs
from colmap_affrect.mappers.sparse import SparseMapper, SparseOptions

SIZE = (1024, 768)


def synthesize_rig(path: Path, **options: Any) -> pycolmap.Reconstruction:
    """Make a verified database of one rig of three cameras and four frames."""
    given = {
        "num_rigs": 1,
        "num_cameras_per_rig": 3,
        "num_frames_per_rig": 4,
        **options,
    }
    return synthesize(path, num_points3D=100, **given)


def unknown_cameras(path: Path) -> dict[int, CameraRecord]:
    """Return records of cameras of which nothing is known."""
    with open_database(path) as database:
        cameras = database.read_all_cameras()
    record = CameraRecord(("a",), "guess", 1280.0, size=SIZE)
    return {camera.camera_id: replace(record) for camera in cameras}


def test_pairs_of_a_rig_with_itself_tell_no_rotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "database.db"
    model = synthesize_rig(path)
    measured = list[Any]()

    def share(*given: Any) -> float:
        measured.append(given)
        return 0.25

    monkeypatch.setattr(reliability_features, "pure_rotation_ratio", share)
    found = reliability_features.features_of(
        MappedModel(model), MappingTask(path, None)
    )
    assert len(found) == 12
    assert {features.pure_rotation_ratio for features in found.values()} == {0.25}
    num_frames = 4
    assert num_frames <= len(measured) <= 2 * num_frames


def test_rig_is_no_mirrored_copy_and_photographs_may_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = list[Any]()

    def share(*given: Any) -> float:
        compared.append(given)
        return 0.0

    monkeypatch.setattr(reliability_features, "mirrored_share", share)
    for name, num_cameras in (("rig", 3), ("photographs", 1)):
        path = tmp_path / f"{name}.db"
        model = synthesize_rig(path, num_cameras_per_rig=num_cameras)
        task = MappingTask(path, None)
        reliability_features.features_of(MappedModel(model), task)
        assert bool(compared) == (name == "photographs")


def test_rigs_are_models_of_colmap_where_these_are_certain(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize_rig(path)
    task = MappingTask(path, None, cameras=unknown_cameras(path))
    (model,) = map_database(
        mapper_of("sparse"), task, tmp_path / "sparse", lambda _: None
    )
    assert model.hypotheses == (COLMAP_MODEL,)
    assert len(model.registered_names) == 12


@pytest.mark.parametrize("why", ["none", "two", "error", "not certain"])
def test_rigs_are_searched_for_where_colmap_is_not_certain(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    path = tmp_path / "database.db"
    true = synthesize_rig(path)

    def by_colmap(*_: Any) -> list[MappedModel]:
        if why == "error":
            raise AffrectError("COLMAP ended")
        model = true
        if why == "not certain":
            model = pycolmap.Reconstruction(true)
            model.deregister_frame(max(model.reg_frame_ids()))
        number = {"none": 0, "two": 2}.get(why, 1)
        return number * [MappedModel(model)]

    monkeypatch.setattr(rigs.IncrementalMapper, "map", by_colmap)
    task = MappingTask(path, None, cameras=unknown_cameras(path))
    found = SparseMapper(SparseOptions()).map(task, tmp_path, 0, lambda _: None)
    assert [mapped.hypotheses[0] for mapped in found] == [ALL_PAIRS]
    assert found[0].reconstruction.num_reg_images() == 12


def test_models_with_enough_long_tracks_are_told_from_others(tmp_path: Path) -> None:
    model = synthesize_rig(tmp_path / "database.db")
    images = sorted(model.reg_image_ids())
    counts = num_long_tracks(model, {})
    least = min(counts[image_id] for image_id in images)
    assert least > 50
    assert all_see_long_tracks(model, images, least)
    assert not all_see_long_tracks(model, images, least + 1)
    assert all_see_long_tracks(model, [], least + 1)


def test_points_are_not_gone_through_where_an_image_has_too_few(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = synthesize_rig(tmp_path / "database.db")
    images = sorted(model.reg_image_ids())
    most = max(model.images[image_id].num_points3D for image_id in images)
    monkeypatch.setattr(model_files, "_long_tracks", None)
    assert not all_see_long_tracks(model, images, most + 1)


@pytest.mark.parametrize(("mapper", "most"), [("incremental", 1.6e5), ("sparse", 4e5)])
def test_rig_is_mapped_and_judged_with_few_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mapper: str, most: float
) -> None:
    path = tmp_path / "database.db"
    synthesize_rig(path)
    evaluated = 0  # residuals, in all steps
    solve = pyceres.solve

    def counting(options: Any, problem: Any, summary: Any) -> None:
        nonlocal evaluated
        solve(options, problem, summary)
        steps = summary.num_successful_steps + summary.num_unsuccessful_steps
        evaluated += steps * problem.num_residuals()

    monkeypatch.setattr(pyceres, "solve", counting)
    task = MappingTask(path, None, cameras=unknown_cameras(path))
    (model,) = map_database(
        mapper_of(mapper), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 12
    assert min(model.probabilities.values()) > 0.9
    assert 0 < evaluated < most


def test_image_of_a_rig_that_sees_next_to_nothing_is_as_sure_as_the_others(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    synthesize_rig(path)
    with open_database(path) as database:
        blind = {i.image_id for i in database.read_all_images() if i.camera_id == 2}
        for pair_id in database.read_two_view_geometry_num_inliers()[0]:
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            if blind.intersection(ids):
                database.delete_two_view_geometry(*ids)
    task = MappingTask(path, None)
    (model,) = map_database(
        mapper_of("incremental"), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 12
    assert min(model.probabilities.values()) > 0.9
    assert not model.taken_out


def test_first_pairs_are_of_two_frames_as_long_as_there_are_any(tmp_path: Path) -> None:
    synthesize_rig(tmp_path / "database.db")
    graph = PairGraph.read(tmp_path / "database.db")
    images = graph.cache.images
    frames = [
        {images[i].frame_id for i in p.ids} for p in first_pairs(graph.pairs, graph)
    ]
    sizes = [len(frame) for frame in frames]
    assert len(sizes) == len(graph.pairs)
    assert sizes == sorted(sizes, reverse=True)
    assert {*sizes} == {1, 2}


def test_one_frame_of_a_wide_rig_is_a_model(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize_rig(path, num_frames_per_rig=1, sensor_from_rig_translation_stddev=1.0)
    task = MappingTask(path, None)
    (model,) = map_database(
        mapper_of("sparse"), task, tmp_path / "sparse", lambda _: None
    )
    assert len(model.registered_names) == 3


def test_trials_have_few_observations_of_a_rig_and_all_others_of_single_cameras(
    tmp_path: Path,
) -> None:
    rig = synthesize(
        tmp_path / "rig.db", num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=4,
        num_points3D=600,
    )  # fmt: skip
    single = synthesize(tmp_path / "single.db", num_rigs=12, num_points3D=600)
    num_all = rig.compute_num_observations()
    assert num_all == single.compute_num_observations() > 2 * MAX_NUM_OBSERVATIONS
    assert with_fewer_points(single).compute_num_observations() == num_all
    assert 0 < with_fewer_points(rig).compute_num_observations() <= MAX_NUM_OBSERVATIONS


def test_few_observations_of_a_rig_tell_its_focal_lengths_nearly_as_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.db"
    model = synthesize_rig(path)
    noise = pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5)
    pycolmap.synthesize_noise(noise, model)
    task = MappingTask(path, None, cameras=unknown_cameras(path))
    few = focal_growths(model, task)
    monkeypatch.setattr(focal_observability, "NUM_OBSERVATIONS_PER_IMAGE", 10_000)
    of_all = focal_growths(model, task)
    assert len(few) == 3
    for camera_id, growth in of_all.items():
        assert 0.5 * growth < few[camera_id] < 2.0 * growth


def test_what_is_not_to_be_refined_stays_as_the_database_has_it(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    synthesize_rig(path, noise_px=0.5)
    with open_database(path) as database:
        rigs = {rig.rig_id: rig for rig in database.read_all_rigs()}
    held = dict.fromkeys(
        ["ba_refine_sensor_from_rig", "ba_refine_focal_length", "ba_refine_principal_point",
         "ba_refine_extra_params"],
        False,
    )  # fmt: skip
    found = colmap_affrect.incremental_mapping(path, tmp_path, tmp_path / "out", held)
    assert found[0].num_reg_images() == 12
    for camera in found[0].cameras.values():
        assert camera.params.tolist() == [1280.0, 512.0, 384.0, 0.05]
    (rig,) = found[0].rigs.values()
    for sensor, pose in rig.non_ref_sensors.items():
        known = rigs[rig.rig_id].non_ref_sensors[sensor]
        assert pose.matrix() == pytest.approx(known.matrix(), abs=1e-9)


class Step:
    """What Ceres tells of a step."""

    step_is_successful = True

    def __init__(self, iteration: int, cost: float, change: float) -> None:
        self.iteration = iteration
        self.cost = cost
        self.cost_change = change


@pytest.mark.parametrize(
    ("changes", "num_steps"),
    [
        (
            [500.0, 100.0, 1.0, 1.0],
            3,
        ),  # nothing that is left brings it near to the other cost
        ([500.0, 400.0, 30.0, 0.01, 0.01, 0.01], 6),  # it hardly gets nearer any more
        ([500.0, 400.0, 30.0, 0.01, 0.5, 0.01], 6),  # only some steps bring little
        (
            [500.0, 400.0, 30.0, 0.1, 0.1, 0.1, 0.1, 0.1],
            8,
        ),  # they still bring it nearer
    ],
)
def test_trial_ends_once_its_cost_tells_enough(
    changes: list[float], num_steps: int
) -> None:
    early_stop = EarlyStop(other_cost=100.0, enough=2.0, max_iterations=100)
    cost = 1100.0 if num_steps == 3 else 1050.0
    taken = 0
    for number, change in enumerate(changes, 1):
        cost -= change
        taken += 1
        if early_stop(Step(number, cost, change)) == pyceres.CallbackReturnType(2):
            break
    assert taken == num_steps
