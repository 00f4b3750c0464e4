"""Principal points that the user gives, right and wrong ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mapping_tasks import mapper_of, synthesize

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord
from colmap_affrect.colmap.database import open_database
from colmap_affrect.mappers import given_principal_points
from colmap_affrect.mappers.base import MappingTask
from colmap_affrect.mappers.given_principal_points import contradicted_principal_points
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.project.report import ModelSummary

SIZE = (1024, 768)
MIDDLE_PX = (512.0, 384.0)
PARAMS = [900.0, *MIDDLE_PX, 0.0]
ALL_GIVEN = CameraRecord(
    ("a",),
    "given",
    900.0,
    size=SIZE,
    given=("focal", "principal-point", "distortion"),
)


def write_database(path: Path) -> pycolmap.Reconstruction:
    """Write a verified database of six photographs; return the truth."""
    return synthesize(
        path, num_rigs=6, num_points3D=300, noise_px=0.4, camera_params=PARAMS
    )


def task_of(path: Path, model: pycolmap.Reconstruction, given: str) -> MappingTask:
    """Return a task whose cameras the user gives, all of them or without a part."""
    kept = tuple(part for part in ALL_GIVEN.given if part in given.split())
    records = {}
    for key in model.cameras:
        names = [i.name for i in model.images.values() if i.camera_id == key]
        records[key] = replace(ALL_GIVEN, names=tuple(names), given=kept)
    return MappingTask(path, None, cameras=records)


def move_principal_points(
    model: pycolmap.Reconstruction, down_longer_sides: float
) -> None:
    for camera in model.cameras.values():
        camera.principal_point_y += down_longer_sides * max(SIZE)


ALL = "focal principal-point distortion"


@pytest.mark.parametrize(("moved", "given", "is_named"), [
    (0.2, ALL, True),
    (-0.2, ALL, True),
    (0.2, "principal-point", True),
    (0.2, "focal", False),  # the user has not said it
    (0.08, ALL, True),
    (0.03, ALL, False),  # as near as that it often is
    (0.0, ALL, False),
])  # fmt: skip
def test_a_given_principal_point_far_off_is_named(
    tmp_path: Path, moved: float, given: str, *, is_named: bool
) -> None:
    path = tmp_path / "database.db"
    model = write_database(path)
    move_principal_points(model, moved)
    before = {key: camera.params.copy() for key, camera in model.cameras.items()}
    found = contradicted_principal_points(model, task_of(path, model, given))
    assert bool(found) == is_named
    for key, camera in model.cameras.items():
        assert (camera.params == before[key]).all()
    for one in found:
        assert one.given_px == pytest.approx(
            (MIDDLE_PX[0], MIDDLE_PX[1] + moved * max(SIZE))
        )
        assert one.fitting_px == pytest.approx(MIDDLE_PX, abs=40.0)
        assert one.turns_deg.keys() == {i.name for i in model.images.values()}


def test_a_wrong_focal_length_is_not_laid_to_the_principal_point(
    tmp_path: Path,
) -> None:
    path = tmp_path / "database.db"
    model = write_database(path)
    for camera in model.cameras.values():
        camera.focal_length *= 1.3
    assert not contradicted_principal_points(model, task_of(path, model, ALL))


@pytest.fixture
def adjusted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Have five photographs make a large set; say how many were adjusted each time."""
    numbers = list[int]()
    adjust = given_principal_points._adjust

    def recorded(model: pycolmap.Reconstruction, priors: Any) -> float:
        numbers.append(model.num_reg_images())
        return adjust(model, priors)

    monkeypatch.setattr(given_principal_points, "_adjust", recorded)
    monkeypatch.setattr(given_principal_points, "MAX_TRIAL_IMAGES", 4)
    return numbers


@pytest.mark.parametrize(("moved", "is_named"), [(0.2, True), (0.0, False)])
def test_of_a_large_set_a_part_is_adjusted_and_all_are_judged(
    tmp_path: Path, adjusted: list[int], moved: float, *, is_named: bool
) -> None:
    path = tmp_path / "database.db"
    model = write_database(path)
    move_principal_points(model, moved)
    before = {image.name: image.num_points3D for image in model.images.values()}
    found = contradicted_principal_points(model, task_of(path, model, ALL))
    assert set(adjusted) == {4}
    assert len(found) == is_named
    for one in found:
        assert one.turns_deg.keys() == before.keys()
        turns_deg = list(one.turns_deg.values())
        usual = pytest.approx(float(np.median(turns_deg)), rel=0.01)
        assert min(turns_deg) > 0.0
        assert sum(turn_deg == usual for turn_deg in turns_deg) >= 2  # not in the part
        assert one.fitting_px == pytest.approx(MIDDLE_PX, abs=60.0)
    assert {i.name: i.num_points3D for i in model.images.values()} == before


def test_of_a_large_set_each_given_point_is_judged_by_photographs_of_its_own(
    tmp_path: Path, adjusted: list[int]
) -> None:
    path = tmp_path / "database.db"
    model = write_database(path)
    wrong = sorted(model.cameras)[-2:]
    for key in wrong:
        model.cameras[key].principal_point_y += 0.2 * max(SIZE)
    (one,) = contradicted_principal_points(model, task_of(path, model, ALL))
    names = {i.name for i in model.images.values() if i.camera_id in wrong}
    assert one.turns_deg.keys() == names
    assert max(adjusted) == 4
    assert len(adjusted) <= 4 * given_principal_points.MAX_NUM_SAMPLES


def summary_with(path: Path, moved: float) -> ModelSummary:
    """Return the summary of the model of photographs whose principal point is given."""
    truth = write_database(path)
    with open_database(path) as database:
        for camera in database.read_all_cameras():
            camera.principal_point_y += moved * max(SIZE)
            database.update_camera(camera)
    task = task_of(path, truth, ALL)
    mapper = mapper_of("sparse")
    summaries = map_database(mapper, task, path.parent / "sparse", lambda _: None)
    return summaries[0]


@pytest.mark.long
def test_photographs_are_no_surer_than_a_wrong_principal_point_allows(
    tmp_path: Path,
) -> None:
    summary = summary_with(tmp_path / "database.db", 0.2)
    (one,) = summary.principal_point_contradictions
    assert max(one.turns_deg.values()) > 3.0
    told = {**summary.unsure, **summary.doubtful}
    for name, turn_deg in one.turns_deg.items():
        if turn_deg > 4.0:
            codes = [doubt.code for doubt in told[name]]
            assert codes == ["principal_point_contradicted"]  # else it is sure
    entry = ALL_GIVEN.to_report(1, summary)
    assert entry["fitting_principal_point_px"] is None  # of another photograph
    named = replace(ALL_GIVEN, names=tuple(one.turns_deg))
    entry = named.to_report(1, summary)
    assert entry["given_principal_point_px"] == list(one.given_px)
    assert entry["fitting_principal_point_px"] == list(one.fitting_px)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    for camera in model.cameras.values():
        assert camera.principal_point_y == one.given_px[1]


def test_a_right_principal_point_costs_nothing(tmp_path: Path) -> None:
    summary = summary_with(tmp_path / "database.db", 0.0)
    assert not summary.principal_point_contradictions
    assert not summary.doubtful
    assert not summary.unsure
