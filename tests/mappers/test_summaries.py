"""What is kept beside a model."""

from __future__ import annotations

from pathlib import Path

import pytest

from colmap_affrect.colmap import pycolmap
from colmap_affrect.mappers.summaries import FILE_NAME, read_summary, write_summary
from colmap_affrect.project.report import Arrival, ModelSummary

SUMMARY = ModelSummary(
    registered_names=("a.jpg", "č.jpg"),
    num_points3D=120,
    mean_track_length=2.25,
    mean_reprojection_error_px=0.512,
    doubtful={"č.jpg": "held by only 9 points"},
    doubts=("no parallax",),
    arrivals={"a.jpg": Arrival("tracks"), "č.jpg": Arrival("bridged", "a.jpg", 32, 36, 0.031)},
    taken_out={"d.jpg": "held by only 3 points"},
    focals_px={"a.jpg": 812.5, "č.jpg": 900.0},
    rival_focals_px={"a.jpg": (700.0, 900.0)},
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    pycolmap.set_random_seed(1)
    pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(num_points3D=20)).write(tmp_path)
    write_summary(SUMMARY, tmp_path)
    return tmp_path


def test_a_summary_reads_back(folder: Path) -> None:
    assert read_summary(folder) == SUMMARY


def test_a_model_that_has_changed_has_no_summary(folder: Path) -> None:
    model = pycolmap.Reconstruction(folder)
    model.cameras[1].focal_length += 1
    model.write(folder)
    assert read_summary(folder) is None
    (folder / "points3D.bin").unlink()
    assert read_summary(folder) is None


def test_a_damaged_summary_is_none(folder: Path) -> None:
    (folder / FILE_NAME).write_text('{"model": [1]}')
    assert read_summary(folder) is None
    (folder / FILE_NAME).unlink()
    assert read_summary(folder) is None
