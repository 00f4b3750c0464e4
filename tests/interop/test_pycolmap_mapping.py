"""Drop-ins on databases of any program: incremental_mapping and verify."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError
from colmap_affrect.interop import pycolmap_options

NUM_IMAGES = 6


def synthesize(path: Path, num_columns: int = 6, *, verified: bool = True) -> list[str]:
    """Make a database of exact matches; return the names of the images."""
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_frames_per_rig=NUM_IMAGES, num_points3D=150
    )
    with open_database(path) as database:
        pycolmap.synthesize_dataset(options, database)
        images = database.read_all_images()
        for image in images:
            points = np.asarray(database.read_keypoints(image.image_id))[:, :2]
            shapes = np.tile(np.float32([3.0, 0.2, 0.1, 2.0]), (len(points), 1))
            keypoints = np.concatenate([points, shapes], axis=1)[:, :num_columns]
            database.update_keypoints(
                image.image_id, np.ascontiguousarray(keypoints, np.float32)
            )
        if not verified:
            database.clear_two_view_geometries()
    return sorted(image.name for image in images)


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mapping") / "database.db"
    synthesize(path)
    return path


def registered(model: pycolmap.Reconstruction) -> list[str]:
    return sorted(model.image(image_id).name for image_id in model.reg_image_ids())


def test_models_are_written_as_by_pycolmap_and_callbacks_called(
    database: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine.txt").write_text("stays")
    calls: list[str] = []
    models = colmap_affrect.incremental_mapping(
        str(database), "", str(tmp_path),
        initial_image_pair_callback=lambda: calls.append("pair"),
        next_image_callback=lambda: calls.append("next"),
    )  # fmt: skip
    assert calls == ["pair", *["next"] * (NUM_IMAGES - 2)]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0", "mine.txt"]
    assert list(models) == [0]
    assert len(registered(models[0])) == NUM_IMAGES
    assert registered(pycolmap.Reconstruction(tmp_path / "0")) == registered(models[0])
    token = pycolmap.CancellationToken()
    other = tmp_path / "other"
    with pytest.raises(InterruptedError):
        colmap_affrect.incremental_mapping(
            database,
            "",
            other,
            next_image_callback=token.cancel,
            cancellation_token=token,
        )
    assert not other.exists()


def test_model_of_input_path_is_extended_into_output_path(
    database: Path, tmp_path: Path
) -> None:
    with open_database(database) as opened:
        names = sorted(image.name for image in opened.read_all_images())
    native = pycolmap.IncrementalPipelineOptions(
        image_names=names[:4], min_model_size=2
    )
    (tmp_path / "first").mkdir()
    pycolmap.incremental_mapping(database, tmp_path, tmp_path / "first", options=native)
    old = pycolmap.Reconstruction(tmp_path / "first" / "0")
    models = colmap_affrect.incremental_mapping(
        database,
        tmp_path,
        tmp_path / "out",
        {"fix_existing_frames": True},
        tmp_path / "first/0",
    )
    new = pycolmap.Reconstruction(tmp_path / "out")
    assert registered(new) == registered(models[0]) == names
    for image_id in old.reg_image_ids():
        assert (
            new.image(image_id).cam_from_world() == old.image(image_id).cam_from_world()
        )


def test_options_that_differ_from_the_defaults_of_pycolmap_are_carried_over() -> None:
    native = pycolmap.IncrementalPipelineOptions(
        random_seed=7, min_model_size=4, mapper=dict(init_min_num_inliers=44)
    )
    ours = pycolmap_options.mapper_options(native)
    assert ours.random_seed == 7
    assert ours.mapper_options == {
        "min_model_size": 4,
        "mapper.init_min_num_inliers": 44,
    }
    usual = pycolmap_options.mapper_options(pycolmap.IncrementalPipelineOptions())
    assert (usual.mapper_options, usual.random_seed) == ({}, 0)
    assert usual.preset_name == "sparse"
    asked = pycolmap_options.mapper_options({"min_model_size": 10, "random_seed": -1})
    assert (asked.mapper_options, asked.random_seed) == ({"min_model_size": 10}, 0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"min_model_siz": 3}, "^options: .*min_model_siz"),
        (3, "^options: int does not apply"),
        (
            pycolmap.IncrementalPipelineOptions(image_names=["a"]),
            "image_names=.*carried over",
        ),
    ],
)
def test_wrong_options_are_one_clear_line(
    database: Path, tmp_path: Path, options: Any, message: str
) -> None:
    with pytest.raises(OptionError, match=message) as error:
        colmap_affrect.incremental_mapping(database, "", tmp_path, options)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("num_columns", [2, 4])
def test_verify_and_mapping_take_keypoints_of_any_columns(
    tmp_path: Path, num_columns: int
) -> None:
    path = tmp_path / "database.db"
    names = synthesize(path, num_columns, verified=False)
    with open_database(path) as database:
        assert database.read_keypoints(1).shape[1] == num_columns
    colmap_affrect.verify_matches(path)
    models = colmap_affrect.incremental_mapping(path, "", tmp_path / "out")
    assert registered(models[0]) == names


def test_verify_takes_a_list_of_pairs(tmp_path: Path) -> None:
    path = tmp_path / "database.db"
    listed = tmp_path / "pairs.txt"
    names = synthesize(path, verified=False)
    listed.write_text(f"{names[2]} {names[0]}\n{names[1]} {names[3]}\n")
    colmap_affrect.verify_matches(path, listed)
    with open_database(path) as database:
        pair_ids, counts = database.read_two_view_geometry_num_inliers()
        assert database.num_matched_image_pairs() == NUM_IMAGES * (NUM_IMAGES - 1) / 2
    assert len(pair_ids) == 2
    assert min(counts) > 100
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "database.db",
        "pairs.txt",
    ]
    colmap_affrect.verify_matches(path)
    with open_database(path) as database:
        assert len(database.read_two_view_geometry_num_inliers()[0]) == 15
    listed.write_text("a b\n")
    with pytest.raises(AffrectError):
        colmap_affrect.verify_matches(path, listed)
    with open_database(
        path
    ) as database:  # at which the process would end inside COLMAP
        database.delete_matches(1, 2)
        database.write_matches(1, 2, np.array([[0, 0], [1, 10_000]], np.uint32))
    with pytest.raises(DatabaseError, match="matches of keypoints that do not exist"):
        colmap_affrect.verify_matches(path)


def content(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


@pytest.mark.long
def test_database_of_any_program_is_mapped_in_a_copy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    source = tmp_path / "source"
    out = tmp_path / "out"
    source.mkdir()
    names = synthesize(source / "any.db", 4)
    before = content(source)
    report = colmap_affrect.map_database(source / "any.db", out)
    assert report.registered_names == tuple(names)
    assert (report.status, report.num_pairs, report.num_verified_pairs) == (
        "ok",
        15,
        15,
    )
    assert "verified now" not in caplog.text
    assert content(source) == before
    assert (out / "report.json").exists()
    again = colmap_affrect.map_database(source / "any.db", out)
    assert again.stages[-1].num_kept == 1
    with open_database(source / "any.db") as database:
        database.clear_two_view_geometries()
    again = colmap_affrect.map_database(source / "any.db", out)
    assert "15 pairs have matches only" in caplog.text
    assert again.stages[0].num_done == 15


def test_databases_that_cannot_be_mapped_are_one_clear_line(tmp_path: Path) -> None:
    path = tmp_path / "any.db"
    synthesize(path)
    with open_database(path) as database:
        database.clear_two_view_geometries()
        database.clear_matches()
        database.clear_descriptors()
    with pytest.raises(
        DatabaseError, match=r"any\.db: has no matches, nor descriptors to match"
    ):
        colmap_affrect.map_database(path, tmp_path / "out")
    with pytest.raises(OptionError, match="no such file"):
        colmap_affrect.map_database(tmp_path / "no.db", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    with pytest.raises(OptionError, match="nowhere: no such folder"):
        colmap_affrect.map_database(
            path, tmp_path / "x", image_path=tmp_path / "nowhere"
        )
