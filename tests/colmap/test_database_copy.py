"""Databases of other people and of other versions of COLMAP are copied, never opened."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
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
from colmap_affrect.colmap.initial_cameras import import_images
from colmap_affrect.colmap.old_databases import TABLES
from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.images.photographs import CameraOptions


@pytest.fixture
def old_database(tmp_path: Path) -> Path:
    """A database as COLMAP 3.8 left it, of two images of one camera."""
    folder = tmp_path / "old #1?"
    folder.mkdir()
    path = folder / "database.db"
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(f"{TABLES} DROP TABLE pose_priors;")
        params = np.array([301.0, 161.0, 122.0, 0.01]).tobytes()
        connection.execute("INSERT INTO cameras VALUES (7, 2, 320, 240, ?, 1)", [params])
        for number, name in [(3, "b.png"), (5, "a.png")]:
            nothing = [None] * 7
            connection.execute(
                f"INSERT INTO images VALUES (?, ?, 7, {', '.join('?' * 7)})",
                [number, name, *nothing],
            )
            points = np.array([[10.5, 20.5], [30.5, 40.5]], np.float32).tobytes()
            connection.execute("INSERT INTO keypoints VALUES (?, 2, 2, ?)", [number, points])
    return path


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


def test_old_database_is_migrated_in_the_copy_only(old_database: Path, tmp_path: Path) -> None:
    before = files(old_database.parent)
    assert schema_version(old_database) == 3800
    copy_database(old_database, tmp_path / "copy.db")
    assert files(old_database.parent) == before
    assert schema_version(tmp_path / "copy.db") == newest_schema_version() > 3800
    with open_database(tmp_path / "copy.db") as database:
        assert database.read_keypoints(3).tolist() == [[10.5, 20.5], [30.5, 40.5]]


def test_old_database_without_features_can_be_mapped(old_database: Path, tmp_path: Path) -> None:
    copy_without_features(old_database, tmp_path / "new.db")
    with open_database(tmp_path / "new.db") as database:
        images = {image.name: image for image in database.read_all_images()}
        assert {name: image.image_id for name, image in images.items()} == {"b.png": 3, "a.png": 5}
        assert all(image.has_frame_id() for image in images.values())
        assert not database.exists_keypoints(3)
        camera = database.read_camera(7)
        assert (camera.params.tolist(), camera.has_prior_focal_length) == (
            [301.0, 161.0, 122.0, 0.01],
            True,
        )


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


def test_newer_database_is_refused_and_left_as_it_is(database_path: Path, tmp_path: Path) -> None:
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
        with pytest.raises(OptionError if content is None else DatabaseError, match=message):
            copy(path, tmp_path / "copy.db")
    assert {item.name for item in tmp_path.iterdir()} <= {"x.db"}


def test_existing_target_is_not_overwritten(database_path: Path, tmp_path: Path) -> None:
    (tmp_path / "there.db").write_text("precious")
    for copy in (copy_database, copy_without_features):
        with pytest.raises(DatabaseError, match="exists already"):
            copy(database_path, tmp_path / "there.db")
    assert (tmp_path / "there.db").read_text() == "precious"
