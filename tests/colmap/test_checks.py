"""Each check of a database finds what it is there for, and nothing else."""

from __future__ import annotations

import random
import sqlite3
import struct
from collections import defaultdict
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from damaged import Statement, execute
from mapping_tasks import write_images

from colmap_affrect.colmap import checks, pycolmap
from colmap_affrect.colmap.checks import (
    check_database,
    keypoint_problems,
    refuse_unusable,
)
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.tables import MAX_NUM_IMAGES
from colmap_affrect.doctor import Diagnosis, examine_database
from colmap_affrect.errors import DatabaseError

NAMES = ["a.png", "b c.png", "side/č.png"]
NUM_KEYPOINTS = [5, 7, 9]
SIZE = (90, 60)


def write_database(path: Path) -> Path:
    """Write a healthy database of three images, all pairs matched and verified."""
    rng = np.random.default_rng(0)
    with open_database(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, *SIZE)
        camera.has_prior_focal_length = True
        write_images(database, camera, NAMES)
        for image_id, count in enumerate(NUM_KEYPOINTS, 1):
            keypoints = rng.uniform(0, 1, (count, 6)).astype(np.float32) * [
                *SIZE,
                1,
                1,
                1,
                1,
            ]
            database.write_keypoints(image_id, keypoints.astype(np.float32))
        for first, second in [(1, 2), (1, 3), (2, 3)]:
            indices = np.array([[0, 1], [4, 6]], np.uint32)
            database.write_matches(first, second, indices)
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
            geometry.inlier_matches = indices
            database.write_two_view_geometry(first, second, geometry)
    return path


@pytest.fixture
def database_path(tmp_path: Path) -> Path:
    return write_database(tmp_path / "database.db")


def test_database_whose_texts_are_utf_16_is_copied_with_its_names(
    database_path: Path, tmp_path: Path
) -> None:
    utf_16 = tmp_path / "utf-16.db"
    with (
        closing(sqlite3.connect(database_path)) as source,
        closing(sqlite3.connect(utf_16)) as target,
    ):
        target.execute("PRAGMA encoding = 'UTF-16'")
        for statement in source.iterdump():
            if "sqlite_sequence" not in statement:
                target.execute(statement)
        (version,) = source.execute("PRAGMA user_version").fetchone()
        target.execute(f"PRAGMA user_version = {version}")
        target.commit()
    refuse_unusable(utf_16)
    copy_database(utf_16, tmp_path / "copy.db")
    with open_database(tmp_path / "copy.db") as database:
        assert sorted(image.name for image in database.read_all_images()) == NAMES


def test_name_that_is_no_utf_8_is_found(database_path: Path) -> None:
    no_utf_8 = "UPDATE images SET name = CAST(X'61ff62' AS TEXT) WHERE image_id = 1"
    execute(database_path, no_utf_8)
    _, problems = check_database(database_path)
    assert "bad-name" in problems


def test_text_in_the_place_of_a_database_is_not_called_damaged(tmp_path: Path) -> None:
    path = tmp_path / "pairs.db"
    path.write_text("a.png b.png\n" * 50, encoding="utf-16")
    diagnosis = Diagnosis()
    assert not examine_database(diagnosis, path)
    (found,) = diagnosis.findings
    assert "does not begin as files of SQLite do" in found.what
    assert ".recover" not in found.advice


def pair_id(first: int, second: int) -> int:
    return int(pycolmap.image_pair_to_pair_id(first, second))


def replace_data(table: str, key: int, array: np.ndarray) -> Statement:
    column = "image_id" if table == "keypoints" else "pair_id"
    return (
        f"UPDATE {table} SET rows = ?, cols = ?, data = ? WHERE {column} = ?",
        [*array.shape, array.tobytes(), key],
    )


def changed_keypoint(row: int, column: int, value: float) -> Statement:
    keypoints = np.full((7, 6), 20, np.float32)
    keypoints[row, column] = value
    return replace_data("keypoints", 2, keypoints)


def in_units_of_sides(low: float, high: float) -> Statement:
    places = np.linspace(low, high, 7, dtype=np.float32)
    return replace_data("keypoints", 2, np.stack([places] * 6, axis=1))


def at_one_place(count: int, num_there: int) -> Statement:
    keypoints = np.full((count, 6), 20, np.float32)
    keypoints[num_there:, 0] = np.arange(count - num_there)
    return replace_data("keypoints", 2, keypoints)


def new_matches(first: int, second: int, table: str = "matches") -> Statement:
    indices = np.array([[0, 1]], np.uint32)
    columns = "pair_id, rows, cols, data" + (", config" * (table != "matches"))
    values = [first * (2**31 - 1) + second, *indices.shape, indices.tobytes()]
    values += [3] * (table != "matches")
    return (
        f"INSERT INTO {table} ({columns}) VALUES ({', '.join('?' * len(values))})",
        values,
    )


def test_healthy_database_has_no_problem(database_path: Path) -> None:
    tables, problems = check_database(database_path)
    assert problems == {}
    assert tables.summary() == (
        "3 images, 1 camera, 21 keypoints, 3 matched and 3 verified pairs"
    )


GEOMETRIES = "two_view_geometries"
OF_13 = f"WHERE pair_id = {pair_id(1, 3)}"
OF_RIGS = [("rigs", "rig_id"), ("frames", "rig_id")]
OF_CAMERAS = [
    ("cameras", "camera_id"), ("images", "camera_id"), ("rigs", "ref_sensor_id"),
    ("frame_data", "sensor_id"),
]  # fmt: skip
BROKEN: list[tuple[str, list[Statement], list[str]]] = [
    ("no-parent", ["UPDATE images SET camera_id = 9 WHERE image_id = 2"], ["b c.png"]),
    ("no-parent", ["UPDATE frames SET rig_id = 7 WHERE frame_id = 2"], ["row 2 of frames, rigs"]),
    ("no-parent", ["UPDATE frames SET rig_id = 9"],
     [f"row {n} of frames, rigs" for n in (1, 2, 3)]),
    ("no-parent", ["INSERT INTO rigs VALUES (5, 9, 0)"], ["camera 9 of rig 5"]),
    ("no-parent",
     ["INSERT INTO rig_sensors VALUES (1, 9, 0, zeroblob(56))"], ["camera 9 of rig 1"]),
    ("bad-id", ["UPDATE frames SET frame_id = -5 WHERE frame_id = 1",
                "UPDATE frame_data SET frame_id = -5 WHERE frame_id = 1"],
     ["frame_id -5 of frames"]),
    ("bad-id", [f"UPDATE {table} SET {column} = 5000000000" for table, column in OF_RIGS],
     ["rig_id 5000000000 of rigs"]),
    ("bad-id", [f"UPDATE {table} SET {column} = 4294967295" for table, column in OF_CAMERAS],
     ["camera_id 4294967295 of cameras"]),
    ("bad-id", ["CREATE TABLE k AS SELECT * FROM keypoints", "DROP TABLE keypoints",
                "ALTER TABLE k RENAME TO keypoints",
                "INSERT INTO keypoints SELECT * FROM keypoints WHERE image_id = 2"],
     ["image_id 2 of keypoints, twice"]),
    ("bad-id", ["DROP INDEX pose_prior_data_assignment",
                "INSERT INTO pose_priors VALUES (1, 2, 1, 0, NULL, NULL, NULL, 0)",
                "INSERT INTO pose_priors VALUES (2, 2, 1, 0, NULL, NULL, NULL, 0)"],
     ["pose prior of 2 of camera 1, twice"]),
    ("bad-id", ["INSERT INTO pose_priors VALUES (1, -1, 1, 0, NULL, NULL, NULL, 0)"],
     ["pose prior of -1 of camera 1"]),
    ("bad-name", ["CREATE TABLE i AS SELECT * FROM images", "DROP TABLE images",
                  "ALTER TABLE i RENAME TO images", "UPDATE images SET name = 'a.png'"],
     ["a.png, 3 times"]),
    ("bad-rig", ["INSERT INTO rig_sensors VALUES (1, 1, 0, zeroblob(56))"], ["camera 1, twice"]),
    ("bad-rig", ["INSERT INTO rigs VALUES (5, 1, 9)"], ["sensor of kind 9, 1 of rig 5"]),
    ("rig-without-pose", ["INSERT INTO rig_sensors VALUES (1, 1, 1, NULL)"], ["IMU 1 of rig 1"]),
    ("bad-frame", ["UPDATE rigs SET ref_sensor_type = 1"],
     [f"frame {n}: camera 1, which is not in its rig 1" for n in (1, 2, 3)]),
    ("bad-frame", ["UPDATE frame_data SET sensor_id = 7 WHERE data_id = 1"],
     ["frame 1: camera 7, while image 1 is of camera 1"]),
    ("bad-frame", ["INSERT INTO frame_data VALUES (1, 99, 1, 0)"],
     ["frame 1: camera 1, which has no image 99", "frame 1: camera 1, twice"]),
    ("bad-frame", ["INSERT INTO frame_data VALUES (1, 1, 1, 1)"],
     ["frame 1: IMU 1, which is not in its rig 1"]),
    ("bad-frame", ["INSERT INTO frame_data VALUES (1, 5, 1, 9)"],
     ["frame 1: sensor of kind 9, 1, which is no kind of sensor"]),
    ("bad-frame", ["UPDATE frame_data SET frame_id = 2 WHERE frame_id = 1"],
     ["frame 2: camera 1, twice"]),
    ("bad-frame", ["DROP INDEX frame_sensor_assignment",
                   "INSERT INTO frame_data VALUES (2, 1, 1, 0)"],
     ["1 of camera, twice", "frame 2: camera 1, twice"]),
    ("no-frame", ["DELETE FROM frame_data WHERE data_id = 3"], ["side/č.png"]),
    ("bad-name", ["UPDATE images SET name = x'61FF' WHERE image_id = 1"], ["image 1: 'a\ufffd'"]),
    ("keypoint-data",
     [replace_data("keypoints", 2, np.ones((7, 3), np.float32))], ["b c.png has 3"]),
    ("keypoint-data",
     ["UPDATE keypoints SET data = substr(data, 1, 167) WHERE image_id = 2"], ["b c.png"]),
    ("keypoint-data",
     ["UPDATE two_view_geometries SET rows = 0, data = NULL",
      "UPDATE matches SET rows = 0, data = NULL",
      "UPDATE keypoints SET rows = -1 WHERE image_id = 2"],
     ["b c.png"]),
    ("keypoint-data", ["UPDATE keypoints SET data = 'text' WHERE image_id = 2"], ["b c.png"]),
    ("descriptor-data", ["INSERT INTO descriptors VALUES (2, 0, 7, 128, zeroblob(895))"],
     ["b c.png"]),
    ("descriptor-data", ["INSERT INTO descriptors VALUES (2, 0, -7, -128, zeroblob(896))"],
     ["b c.png"]),
    ("bad-camera", ["UPDATE cameras SET model = 12345"], ["camera 1: model 12345"]),
    ("bad-camera",
     ["UPDATE cameras SET width = 9223372036854775807"],
     ["camera 1: 9223372036854775807 x 60 px"]),
    ("bad-camera", ["UPDATE cameras SET params = substr(params, 1, 24)"], ["camera 1"]),
    ("matrix-data",
     [f"UPDATE two_view_geometries SET F = substr(zeroblob(72), 1, 71) {OF_13}"],
     [f"F of row {pair_id(1, 3)} of two_view_geometries"]),
    ("matrix-data", [f"UPDATE two_view_geometries SET camera1 = x'0011' {OF_13}"],
     [f"camera1 or camera2 of pair_id {pair_id(1, 3)}"]),
    ("matrix-data", [f"UPDATE two_view_geometries SET camera2 = zeroblob(65) {OF_13}"],
     [f"camera1 or camera2 of pair_id {pair_id(1, 3)}"]),
    ("keypoints-not-finite", [changed_keypoint(6, 1, np.nan)], ["b c.png"]),
    ("keypoints-outside", [changed_keypoint(6, 0, 94.0)], ["b c.png"]),
    ("keypoints-outside", [changed_keypoint(6, 1, -4.0)], ["b c.png"]),
    ("keypoints-outside", [changed_keypoint(6, 1, 64.0)], ["b c.png"]),
    *(("keypoints-normalised", [in_units_of_sides(*ends)], ["b c.png"])
      for ends in ((0.0, 1.0), (0.0, 1.5), (-1.0, 1.0))),
    ("keypoints-at-one-place", [at_one_place(11, 10)], ["b c.png"]),
    ("match-data",
     [f"UPDATE matches SET rows = 3 {OF_13}"], ["a.png - side/č.png (raw matches)"]),
    ("match-data",
     [replace_data(GEOMETRIES, pair_id(2, 3), np.array([[0, 9]], np.uint32))],
     ["b c.png - side/č.png (inliers)"]),
    ("match-data",
     [new_matches(2, 2), new_matches(2, 2, GEOMETRIES)],
     ["b c.png - b c.png (raw matches)", "b c.png - b c.png (inliers)"]),
    ("match-data", [new_matches(2, 8, GEOMETRIES)], ["b c.png - image 8 (inliers)"]),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "statements", "items"), BROKEN)
def test_what_is_broken_is_found_and_nothing_else(
    database_path: Path, kind: str, statements: list[Statement], items: list[str]
) -> None:
    execute(database_path, *statements)
    assert check_database(database_path)[1] == {kind: items}


def test_keypoints_of_smaller_pictures_are_found(
    database_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(3)
    places = rng.uniform(0.0, 1.0, (100, 2)).astype(np.float32) * np.float32(SIZE)
    execute(database_path, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    for scale in (0.4, 1.0):  # those of one image alone may be so
        for image_id in (1, 2, 3):
            rows = np.column_stack(
                [places * np.float32(0.5), np.ones((100, 2), np.float32)]
            )
            if image_id == 2:
                rows[:, :2] *= np.float32(2.0 * scale)
            execute(database_path, (
                "UPDATE keypoints SET rows = 100, cols = 4, data = ? WHERE image_id = ?",
                [rows.astype(np.float32).tobytes(), image_id],
            ))  # fmt: skip
        caplog.clear()
        refuse_unusable(database_path, warns=True)
        found = check_database(database_path)[1]
        assert found == (
            {"keypoints-in-a-corner": sorted(NAMES)} if scale < 1.0 else {}
        )
        assert ("all keypoints in the upper left part" in caplog.text) == (scale < 1.0)
    diagnosis = Diagnosis()
    assert examine_database(diagnosis, database_path)
    assert diagnosis.num_errors == 0


@pytest.mark.parametrize("statement", [
    "DELETE FROM frames",  # none has one: as in databases of old
    ("UPDATE two_view_geometries SET camera1 = ?, camera2 = camera1",
     [struct.pack("<IiQQBQ3d", 7, 0, 90, 60, 1, 3, 100.0, 45.0, 30.0)]),
    "INSERT INTO descriptors VALUES (2, 0, 7, 128, zeroblob(896))",
    "INSERT INTO frames VALUES (9, 1)",  # which holds nothing
    "INSERT INTO rig_sensors VALUES (1, 1, 1, zeroblob(56))",  # an IMU, and it is known where
    changed_keypoint(6, 0, 92.5),  # 2 px and a hundredth of a side beyond the border
    changed_keypoint(6, 0, 1.0),
    at_one_place(11, 9),
    replace_data("keypoints", 2, np.full((7, 4), 3, np.float32)),
    replace_data("matches", pair_id(1, 2), np.array([[4, 6]], np.uint32)),  # the last ones
    f"UPDATE two_view_geometries SET rows = 0, data = NULL, config = 0 "
    f"WHERE pair_id = {pair_id(1, 2)}",  # tried without success
    f"DELETE FROM matches WHERE pair_id = {pair_id(1, 2)}",  # inliers alone were imported
])  # fmt: skip
def test_what_is_allowed_is_no_problem(
    database_path: Path, statement: Statement
) -> None:
    path = database_path
    none_has_one = statement == "DELETE FROM frames"
    execute(path, "DELETE FROM frame_data" if none_has_one else "SELECT 1", statement)
    assert check_database(path)[1] == {}


@pytest.mark.parametrize(("first", "second"), [(1, 2), (2**31 - 3, 2**31 - 2)])
def test_pair_ids_are_those_of_colmap(first: int, second: int) -> None:
    assert divmod(pair_id(first, second), MAX_NUM_IMAGES) == (first, second)


def test_damaged_file_is_a_database_error_or_problems(
    tmp_path: Path, database_path: Path
) -> None:
    execute(database_path, "PRAGMA journal_mode = DELETE")
    data = database_path.read_bytes()
    rng = random.Random(7)
    errors = []
    for number in range(30):
        changed = bytearray(data)
        for _ in range(rng.choice([1, 10, 100])):
            changed[rng.randrange(len(changed))] = rng.randrange(256)
        path = tmp_path / f"{number}.db"
        path.write_bytes(changed if number % 3 else data[: rng.randrange(len(data))])
        try:
            check_database(path)
        except DatabaseError as error:
            errors.append(str(error).startswith(f"{path}: "))
    assert len(errors) > 10
    assert all(errors)


def test_places_that_less_than_half_of_the_keypoints_are_at_are_no_problem() -> None:
    """Twelve or twenty of 41 keypoints are in the middle, and as many on each side of it."""
    for num_there, is_problem in ((12, False), (20, False), (21, True)):
        left = np.linspace(10.0, 90.0, (41 - num_there) // 2)
        right = np.linspace(110.0, 190.0, 41 - num_there - len(left))
        columns = np.concatenate([left, np.full(num_there, 100.0), right])
        keypoints = np.stack([columns, columns], axis=1).astype(np.float32)
        found = keypoint_problems(keypoints, (200, 200))
        assert found == (["keypoints-at-one-place"] if is_problem else [])


@pytest.mark.parametrize(("num_keypoints", "is_problem"), [(90, False), (110, True)])
def test_few_keypoints_may_be_in_a_corner(
    num_keypoints: int, *, is_problem: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    rows = []
    for image_id in (1, 2, 3):
        keypoints = rng.uniform(0.0, 90.0, (num_keypoints, 2)).astype("<f4")
        rows.append((image_id, num_keypoints, 2, keypoints.tobytes()))
    monkeypatch.setattr(checks, "rows_of", lambda *_: rows)
    camera = SimpleNamespace(width=200, height=200)
    tables: Any = SimpleNamespace(
        names={1: "a", 2: "b", 3: "c"},
        camera_ids={1: 1, 2: 1, 3: 1},
        cameras={1: camera},
    )
    found = defaultdict[str, list[str]](list)
    connection: Any = None
    checks._check_keypoints(connection, tables, found)
    assert found == ({"keypoints-in-a-corner": ["a", "b", "c"]} if is_problem else {})
