"""What is kept beside a model."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import SUMMARY, read_given_model
from colmap_affrect.errors import StoreError
from colmap_affrect.mappers.mapping import (
    Findings,
    copy_with_keypoints,
    read_models,
    read_summary,
    write_summary,
)
from colmap_affrect.mappers.other_cameras import OtherCameras
from colmap_affrect.project.reasons import Doubt
from colmap_affrect.project.report import (
    Bridge,
    ModelSummary,
    PrincipalPointContradiction,
)

MODEL = ModelSummary(
    registered_names=("a.jpg", "č.jpg"),
    num_points3D=120,
    mean_track_length=2.25,
    mean_reprojection_error_px=0.512,
    doubtful={
        "č.jpg": (Doubt("few_three_view_points", {"num": 9}), Doubt("few_matches"))
    },
    probabilities={"a.jpg": 0.98, "č.jpg": 0.4},
    bridges={"č.jpg": Bridge("a.jpg", 32, 36, 0.031)},
    taken_out={"d.jpg": (Doubt("no_parallax", {"share": 0.9}),)},
    focals_px={"a.jpg": 812.5, "č.jpg": 900.0},
    one_view=(("a.jpg", "č.jpg"),),
    principal_point_contradictions=(
        PrincipalPointContradiction((320.0, 368.0), (322.0, 243.0), {"a.jpg": 3.5}),
    ),
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pycolmap.set_random_seed(1)
    path = tmp_path / "sparse" / "0"
    path.mkdir(parents=True)
    pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(num_points3D=20)
    ).write(path)
    write_summary(MODEL, path)
    return path


def test_a_summary_reads_back(folder: Path) -> None:
    assert read_summary(folder) == MODEL


def test_a_model_that_has_changed_is_refused_but_its_copy_is_not(
    folder: Path, tmp_path: Path
) -> None:
    model = pycolmap.Reconstruction(folder)
    model.cameras[1].focal_length += 1
    model.write(folder)
    for read in (read_summary, read_given_model):
        with pytest.raises(
            StoreError, match=r"copy it to a folder of its own without summary\.json"
        ):
            read(folder)
    shutil.copytree(folder, copy := tmp_path / "copy", ignore=lambda *_: [SUMMARY])
    assert (
        read_given_model(copy).cameras[1].focal_length == model.cameras[1].focal_length
    )
    (folder / "points3D.bin").unlink()
    with pytest.raises(StoreError, match="is not as it was written"):
        read_summary(folder)


@pytest.mark.parametrize("content", ['{"model": [1]}', "", "[]"])
def test_a_damaged_summary_is_one_clear_line(folder: Path, content: str) -> None:
    (folder / SUMMARY).write_text(content)
    with pytest.raises(
        StoreError, match=r"summary\.json: damaged .*; if you have edited"
    ):
        read_summary(folder)
    assert read_given_model(folder).num_points3D() == 20


def test_a_copy_with_more_keypoints_keeps_what_mapping_goes_on_with(
    tmp_path: Path,
) -> None:
    path = tmp_path / "sparse" / "0"
    path.mkdir(parents=True)
    options = pycolmap.SyntheticDatasetOptions(num_points3D=20)
    with open_database(tmp_path / "database.db") as database:
        pycolmap.synthesize_dataset(options, database).write(path)
    other = OtherCameras(1.5, {"a.jpg": 7.0}, are_shared=True)
    write_summary(MODEL, path, Findings(other, 0.4))
    copied = tmp_path / "copied" / "0"
    copied.parent.mkdir()
    copy_with_keypoints(path, copied, tmp_path / "database.db")
    for folder in (path.parent, copied.parent):
        (found,) = read_models(folder)
        assert found.reconstruction.num_points3D() == 20
        assert (found.bridges, found.hypotheses) == (MODEL.bridges, MODEL.hypotheses)
        assert (found.other_cameras, found.share_as_modelled) == (other, 0.4)
