"""Databases of other people and of other versions of COLMAP are copied, never opened.

Those of COLMAP 3.8 are written from newer ones.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from command import Call
from damaged import execute
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import (
    copy_database,
    copy_without_features,
    newest_schema_version,
    open_copy,
    schema_version,
)
from colmap_affrect.colmap.image_import import import_images
from colmap_affrect.colmap.old_databases import MAPPER_OPTIONS, export_database
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.images.photographs import CameraOptions

GPS = np.array([47.5, 8.25, 400.0])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of the installed pycolmap with two rigs; the second image has GPS."""
    path = tmp_path_factory.mktemp("new") / "new.db"
    pycolmap.set_random_seed(5)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=150,
        camera_has_prior_focal_length=True,
    )  # fmt: skip
    with open_database(path) as database:
        pycolmap.synthesize_dataset(options, database)
        database.clear_pose_priors()
        add_position(database, GPS, pycolmap.PosePriorCoordinateSystem.WGS84)
    return path


def add_position(
    database: pycolmap.Database,
    position: np.ndarray,
    system: pycolmap.PosePriorCoordinateSystem,
) -> None:
    prior = pycolmap.PosePrior(position=position, coordinate_system=system)
    prior.corr_data_id = database.read_image(2).data_id
    database.write_pose_prior(prior)


def rows(path: Path, query: str) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute(query).fetchall()


def test_content_and_ids_are_those_of_the_source(source: Path, tmp_path: Path) -> None:
    before = source.read_bytes()
    export_database(source, tmp_path / "sub" / "old.db")
    assert source.read_bytes() == before
    assert [file.name for file in (tmp_path / "sub").iterdir()] == ["old.db"]
    old = tmp_path / "sub" / "old.db"
    for query in (
        "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras",
        "SELECT image_id, name, camera_id FROM images",
        "SELECT image_id, rows, cols, data FROM keypoints",
        "SELECT image_id, rows, cols, data FROM descriptors",
        "SELECT pair_id, rows, cols, data FROM matches",
        "SELECT pair_id, rows, cols, data, F, E, H, qvec, tvec FROM two_view_geometries",
    ):
        expected = rows(source, query)
        assert len(expected) > 1 or "cameras" in query
        assert rows(old, query) == expected
    assert rows(old, "PRAGMA user_version") == [(3800,)]
    assert rows(old, "SELECT prior_tx, prior_ty, prior_tz FROM images")[:3] == [
        (None, None, None), (47.5, 8.25, 400.0), (None, None, None),
    ]  # fmt: skip


def test_command_takes_an_output_folder(
    source: Path, tmp_path: Path, call: Call
) -> None:
    (tmp_path / "out").mkdir()
    shutil.copy(source, tmp_path / "out" / "database.db")
    done = call(
        "export-database", tmp_path / "out", tmp_path / "old.db", "--colmap", "3.8"
    )
    assert done.code == 0
    assert done.stdout.startswith(f"{tmp_path / 'old.db'}: for COLMAP 3.8 to 3.13; ")
    assert MAPPER_OPTIONS in done.stdout
    none = call("export-database", tmp_path / "out", tmp_path / "b.db", "--descriptors")
    assert (none.code, len(none.errors)) == (2, 1)
    assert "is no output folder with features.h5" in none.errors[0]
    again = call("export-database", tmp_path / "out", tmp_path / "old.db")
    assert (again.code, len(again.errors)) == (2, 1)
    assert "exists, and is left as it is" in again.errors[0]


def test_what_is_exported_comes_back(source: Path, tmp_path: Path) -> None:
    export_database(source, tmp_path / "old.db")
    copy_database(tmp_path / "old.db", tmp_path / "new.db")
    with open_database(tmp_path / "new.db") as new, open_database(source) as database:
        assert new.read_num_matches() == database.read_num_matches()
        one, other = (data.read_two_view_geometry(1, 2) for data in (new, database))
        assert one.config == other.config
        np.testing.assert_array_equal(one.inlier_matches, other.inlier_matches)
        np.testing.assert_allclose(one.E, other.E)


def test_what_the_old_colmap_has_no_place_for(source: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.db"
    shutil.copy(source, changed)
    of_rig = pycolmap.TwoViewGeometry(
        config=pycolmap.TwoViewGeometryConfiguration.CALIBRATED_RIG
    )
    with open_database(changed) as database:
        learned = pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.ALIKED_N16ROT,
            data=np.zeros((3, 512), np.uint8),
        )
        database.clear_descriptors()
        database.write_descriptors(1, learned)
        database.delete_two_view_geometry(1, 2)
        database.write_two_view_geometry(1, 2, of_rig)
    export_database(changed, tmp_path / "old.db")
    assert rows(tmp_path / "old.db", "SELECT count(*) FROM descriptors") == [(0,)]
    assert rows(tmp_path / "old.db", "SELECT max(config) FROM two_view_geometries") == [
        (2,)
    ]
    with open_database(changed) as database:
        camera = database.read_camera(1)
        database.update_camera(
            pycolmap.Camera.create_from_model_name(
                1, "EUCM", 500, camera.width, camera.height
            )
        )  # fmt: skip
    with pytest.raises(DatabaseError, match="camera 1 is of model EUCM, which COLMAP"):
        export_database(changed, tmp_path / "other.db")
    assert not (tmp_path / "other.db").exists()


@pytest.fixture
def old_database(tmp_path: Path) -> Path:
    """A database as COLMAP 3.8 left it, of two images of one camera."""
    folder = tmp_path / "old #1?"
    folder.mkdir()
    with open_database(tmp_path / "empty.db"):
        pass
    export_database(tmp_path / "empty.db", folder / "database.db")
    params = np.array([500.0, 320.0, 240.0]).tobytes()
    points = np.array([[10.5, 20.5], [30.5, 40.5]], np.float32).tobytes()
    with closing(sqlite3.connect(folder / "database.db")) as connection, connection:
        connection.execute(
            "INSERT INTO cameras VALUES (3, 0, 640, 480, ?, 1)", [params]
        )
        for image in ((7, "7.jpg"), (8, "8.jpg")):
            columns = "INSERT INTO images (image_id, name, camera_id) VALUES (?, ?, 3)"
            connection.execute(columns, image)
        connection.execute("INSERT INTO keypoints VALUES (7, 2, 2, ?)", [points])
    return folder / "database.db"


@pytest.fixture
def database_path(tmp_path: Path) -> Path:
    """A database of the installed COLMAP with two images."""
    (tmp_path / "images").mkdir()
    for name in ("a.png", "b.png"):
        write_image(tmp_path / "images" / name, texture((60, 40), len(name)))
    path = tmp_path / "database.db"
    import_images(path, tmp_path / "images", ["a.png", "b.png"], CameraOptions())
    return path


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_old_database_is_migrated_in_the_copy_only(
    old_database: Path, tmp_path: Path
) -> None:
    before = files(old_database.parent)
    assert schema_version(old_database) == 3800
    copy_database(old_database, tmp_path / "copy.db")
    assert files(old_database.parent) == before
    assert schema_version(tmp_path / "copy.db") == newest_schema_version() > 3800
    with open_database(tmp_path / "copy.db") as database:
        assert database.read_keypoints(7).tolist() == [[10.5, 20.5], [30.5, 40.5]]


def test_images_without_a_frame_get_one_and_others_keep_theirs(
    database_path: Path, tmp_path: Path
) -> None:
    with closing(sqlite3.connect(database_path)) as connection, connection:
        (frame,) = connection.execute(
            "SELECT frame_id FROM frame_data JOIN images ON data_id = image_id WHERE name = 'b.png'"
        ).fetchone()
        connection.execute("DELETE FROM frame_data WHERE frame_id = ?", [frame])
        connection.execute("DELETE FROM frames WHERE frame_id = ?", [frame])
    with open_database(database_path) as database:
        before = {image.name: image for image in database.read_all_images()}
        assert not before["b.png"].has_frame_id()
    copy_without_features(database_path, tmp_path / "new.db")
    with open_database(tmp_path / "new.db") as database:
        after = {image.name: image for image in database.read_all_images()}
        assert after["a.png"].frame_id == before["a.png"].frame_id
        assert after["b.png"].has_frame_id()
        frame_of_b = database.read_frame(after["b.png"].frame_id)
        assert [item.id for item in frame_of_b.data_ids] == [after["b.png"].image_id]


def test_what_another_program_has_just_written_is_copied(database_path: Path) -> None:
    with pycolmap.Database.open(database_path) as writing:  # in its write-ahead log
        camera = pycolmap.Camera.create_from_model_name(9, "PINHOLE", 77.0, 60, 40)
        writing.write_camera(camera, use_camera_id=True)
        with open_copy(database_path) as copy:
            assert copy.read_camera(9).focal_length_x == 77.0


def test_newer_database_is_refused_and_left_as_it_is(
    database_path: Path, tmp_path: Path
) -> None:
    with closing(sqlite3.connect(database_path)) as connection:
        connection.execute(f"PRAGMA user_version = {newest_schema_version() + 1}")
    before = database_path.read_bytes()
    with pytest.raises(DatabaseError, match=r"newer COLMAP.*update pycolmap"):
        copy_database(database_path, tmp_path / "copy.db")
    assert database_path.read_bytes() == before
    assert not (tmp_path / "copy.db").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "has no table cameras"),
        (b"text " * 500, "not a usable COLMAP database"),
        (b"SQLite format 3\0" + b"\1" * 3000, "not a usable COLMAP database"),
    ],
)
def test_what_is_no_database_is_one_clear_line(
    tmp_path: Path, content: bytes | None, message: str
) -> None:
    path = tmp_path / "x.db"
    if content is not None:
        path.write_bytes(content)
    for copy in (copy_database, copy_without_features):
        with pytest.raises(
            OptionError if content is None else DatabaseError, match=message
        ):
            copy(path, tmp_path / "copy.db")
    assert {item.name for item in tmp_path.iterdir()} <= {"x.db"}


def test_existing_target_is_not_overwritten(
    database_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "there.db").write_text("precious")
    for copy in (copy_database, copy_without_features):
        with pytest.raises(DatabaseError, match="exists already"):
            copy(database_path, tmp_path / "there.db")
    assert (tmp_path / "there.db").read_text() == "precious"


@pytest.mark.parametrize("name", ["new.db", "old.db", ".lock", "results"])
def test_an_exported_database_may_have_any_name(
    source: Path, tmp_path: Path, name: str
) -> None:
    export_database(source, tmp_path / name)
    assert rows(tmp_path / name, "SELECT COUNT(*) FROM images") == [(6,)]
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("suffix", ["", "-wal", "-journal"])
def test_pipes_in_the_place_of_a_database_are_refused(
    tmp_path: Path, suffix: str
) -> None:
    os.mkfifo(tmp_path / f"x.db{suffix}")
    with pytest.raises(OptionError, match="is not a file, but a pipe"):
        schema_version(tmp_path / "x.db")


FOREIGN = {
    "trigger": "CREATE TRIGGER t AFTER INSERT ON keypoints BEGIN DELETE FROM images; END",
    "trigger of change": """CREATE TRIGGER t AFTER UPDATE ON cameras
        BEGIN UPDATE cameras SET params = zeroblob(300000000); END""",
    "view": "CREATE VIEW v AS SELECT zeroblob(300000000)",
    "index": "CREATE INDEX i ON images(length(name))",
    "index of a name of COLMAP's": """DROP INDEX index_name;
        CREATE INDEX index_name ON images(zeroblob(1000000))""",
    "table": "CREATE TABLE more AS SELECT zeroblob(3000000) AS data",
    "column": "ALTER TABLE images ADD COLUMN more BLOB AS (zeroblob(300000000))",
    "column with a default": "ALTER TABLE cameras ADD COLUMN note TEXT DEFAULT 'mine'",
}
"""What others may have put into a database beside COLMAP's tables."""


def whole(path: Path) -> list[tuple[object, ...]]:
    """Return what a database holds: how it is made, and all rows."""
    made = rows(path, "SELECT type, name, sql FROM sqlite_master ORDER BY name")
    return [
        *made,
        *(
            row
            for name in tables_of(path)
            for row in rows(path, f"SELECT * FROM {name}")
        ),
    ]


def tables_of(path: Path) -> list[str]:
    """Return the names of the tables of a database."""
    made = rows(
        path, "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
    )
    return [str(name) for (name,) in made]


@pytest.mark.parametrize("case", FOREIGN)
def test_copies_hold_the_tables_of_colmap_alone(
    source: Path, tmp_path: Path, case: str
) -> None:
    path = Path(shutil.copy(source, tmp_path / "given.db"))
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(FOREIGN[case])
    copy_database(source, tmp_path / "plain.db")
    copy_database(path, tmp_path / "copy.db")
    assert whole(tmp_path / "copy.db") == whole(tmp_path / "plain.db")
    assert len(tables_of(source)) == 12
    for name in tables_of(source):
        query = f"SELECT * FROM {name}"
        assert sorted(rows(tmp_path / "copy.db", query)) == sorted(
            rows(source, query)
        ), name
    with open_database(tmp_path / "copy.db") as database:
        database.clear_keypoints()
        database.write_keypoints(1, np.zeros((1, 2), np.float32))
        database.update_camera(database.read_camera(1))
        assert database.num_images() == 6


def test_triggers_of_old_databases_stay_behind(source: Path, tmp_path: Path) -> None:
    export_database(source, tmp_path / "old.db")
    execute(tmp_path / "old.db", FOREIGN["trigger"], FOREIGN["view"])
    copy_database(tmp_path / "old.db", tmp_path / "copy.db")
    made = rows(
        tmp_path / "copy.db", "SELECT name FROM sqlite_master WHERE type != 'table'"
    )
    assert not {("t",), ("v",)} & {*made}
    query = "SELECT image_id, rows, data FROM keypoints"
    assert rows(tmp_path / "copy.db", query) == rows(source, query)
    assert schema_version(tmp_path / "copy.db") == newest_schema_version()


def test_views_are_no_tables(source: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(source, tmp_path / "given.db"))
    execute(
        path, "ALTER TABLE frames RENAME TO f", "CREATE VIEW frames AS SELECT * FROM f"
    )
    copy_database(path, tmp_path / "copy.db")
    assert rows(tmp_path / "copy.db", "SELECT * FROM frames") == []


def test_rows_that_no_table_can_hold_are_one_line(source: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(source, tmp_path / "given.db"))
    execute(
        path,
        "CREATE TABLE c AS SELECT * FROM cameras",
        "DROP TABLE cameras",
        "ALTER TABLE c RENAME TO cameras",
        "UPDATE cameras SET prior_focal_length = NULL",
    )
    with pytest.raises(
        DatabaseError, match="has rows that COLMAP's tables cannot hold"
    ):
        copy_database(path, tmp_path / "copy.db")
    assert not (tmp_path / "copy.db").exists()
