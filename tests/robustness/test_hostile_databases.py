"""Databases that are damaged, made to do harm, or full of random matches."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from command import FAST, Call
from damaged import execute
from mapping_tasks import write_images
from small_scene import write_photographs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database, write_keypoints, write_matches
from colmap_affrect.colmap.database_copy import read_names
from colmap_affrect.colmap.database_verification import verified_pairs, verify
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.doctor import Diagnosis, examine_database
from colmap_affrect.errors import DatabaseError
from colmap_affrect.geometry.affine import rotation
from colmap_affrect.interop.pycolmap_api import extract_features

pytestmark = pytest.mark.long

ROWS = [
    (
        "UPDATE images SET camera_id = 999 WHERE image_id = 1",
        "images whose camera does not exist",
    ),
    (
        "UPDATE matches SET data = x'ffffffffffffffff', rows = 1",
        "at which COLMAP crashes",
    ),
    (
        "UPDATE two_view_geometries SET qvec = zeroblob(32), tvec = NULL",
        "(qvec and tvec of pair",
    ),
    ("UPDATE cameras SET width = 'wide'", "damaged"),
    ("UPDATE cameras SET width = 0", "of a size that no photograph has"),
    ("UPDATE cameras SET height = -5", "of a size that no photograph has"),
    (
        "UPDATE rigs SET ref_sensor_type = 1",
        "frames that hold images twice, or of other cameras",
    ),
    (
        "INSERT INTO rig_sensors VALUES (1, 5, 1, NULL)",
        "sensors of rigs whose place in the rig",
    ),
]
"""What is done to a database, and what is said of it; more kinds are in the tests of checks."""


@pytest.fixture(scope="module")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of two matched photographs."""
    folder = tmp_path_factory.mktemp("healthy")
    write_photographs(folder / "photos", 2)
    path = folder / "any.db"
    in_order = pycolmap.FeatureExtractionOptions(num_threads=1)
    pycolmap.extract_features(path, folder / "photos", extraction_options=in_order)
    pycolmap.match_exhaustive(path)
    execute(path, "PRAGMA journal_mode = DELETE")
    return path


@pytest.fixture
def path(healthy: Path, tmp_path: Path) -> Path:
    """A copy of the database, to be changed."""
    return Path(shutil.copy(healthy, tmp_path / "any.db"))


def num_errors(path: Path) -> int:
    """What the doctor finds in a database; the installation is left out, which takes long."""
    diagnosis = Diagnosis()
    examine_database(diagnosis, path, None)
    return diagnosis.num_errors


@pytest.mark.parametrize(("statement", "said"), ROWS)
def test_hostile_rows_are_one_line(
    healthy: Path, path: Path, call: Call, statement: str, said: str
) -> None:
    execute(path, statement)
    before = path.read_bytes()
    commands = [["map"], ["extract", "--image-path", healthy.parent / "photos"]]
    is_of_images = any(table in statement for table in ("cameras", "images", "rig"))
    for command in commands if is_of_images else commands[:1]:
        out = ["--output-path", path.parent / "out", "--from-database", path]
        ended = call(*command, "-q", *out)
        assert (ended.code, len(ended.stderr)) == (1, 1)
        assert ended.stderr[0].startswith(f"error: {path}: ")
        assert said in ended.stderr[0]
    assert num_errors(path) > 0
    assert path.read_bytes() == before


def test_panoramas_are_refused_before_anything_is_recorded(
    healthy: Path, path: Path, call: Call
) -> None:
    model = pycolmap.CameraModelId.EQUIRECTANGULAR.value
    params = np.array([320.0, 240.0])
    query = f"UPDATE cameras SET model = {model}, params = ? WHERE camera_id = 2"
    execute(path, (query, [params.tobytes()]))
    out = path.parent / "out"
    photos = healthy.parent / "photos"
    given = ["--output-path", out, "--image-path", photos]
    for command in (["extract", *given], ["run", *given], ["map", *given[:2]]):
        ended = call(*command, "-q", "--from-database", path)
        assert (ended.code, len(ended.stderr)) == (1, 1)
        assert (
            "look all around, which have no focal length (camera 2: EQUIREC"
            in ended.stderr[0]
        )
        assert not (out / "config.toml").exists()
    assert num_errors(path) == 0  # COLMAP has a use for it
    with pytest.raises(DatabaseError, match=r"camera 2: E.*; cut perspective views"):
        extract_features(path, photos)
    assert not (path.parent / "any.affrect" / "config.toml").exists()
    assert (
        call("extract", "-q", *given, "--from-database", healthy, *FAST[:2]).code == 0
    )


def test_hot_journal_is_refused_with_advice(path: Path, call: Call) -> None:
    """What a killed program had not completed is not read as if it counted."""
    killed = path.with_name("killed.db")
    with closing(sqlite3.connect(path, isolation_level=None)) as connection:
        connection.execute(
            "PRAGMA cache_size = 1"
        )  # pages reach the file before the end
        connection.execute("BEGIN")
        connection.execute("UPDATE keypoints SET data = zeroblob(length(data))")
        connection.execute("UPDATE images SET name = 'half ' || name")
        shutil.copy(path, killed)
        shutil.copy(f"{path}-journal", f"{killed}-journal")
        connection.execute("ROLLBACK")
    before = killed.read_bytes()
    ended = call(
        "map", "--from-database", killed, "--output-path", path.with_name("out")
    )
    assert ended.code == 1
    assert "sqlite3 killed.db .tables" in ended.errors[0]
    assert num_errors(killed) == 1
    assert killed.read_bytes() == before
    execute(killed, "SELECT count(*) FROM images")  # undoes the half
    assert read_names(killed) == ["a.png", "b c.png"]


def test_journal_that_is_over_does_not_matter(path: Path) -> None:
    path.with_name("any.db-journal").write_bytes(bytes(512))
    assert read_names(path) == ["a.png", "b c.png"]


CAMERA_SIZE = (1600, 1200)


@pytest.mark.parametrize("prior", [False, True], ids=["no prior", "prior"])
@pytest.mark.parametrize(
    ("count", "num_pairs"),
    [(200, 1), (1000, 1), pytest.param(1000, 50, marks=pytest.mark.slow)],
)
def test_random_matches_are_rejected(
    tmp_path: Path, count: int, num_pairs: int, prior: bool
) -> None:
    rng = np.random.default_rng([count, prior])
    path = tmp_path / "database.db"
    camera = pycolmap.Camera.create_from_model_name(
        1, "SIMPLE_RADIAL", 1.2 * CAMERA_SIZE[0], *CAMERA_SIZE
    )
    camera.has_prior_focal_length = prior
    lafs = np.zeros((count, 2, 3))
    same = np.stack([np.arange(count)] * 2, axis=1)
    with open_database(path) as database:
        image_ids = range(1, 2 * num_pairs + 1)
        write_images(database, camera, map(str, image_ids))
        for image_id in image_ids:
            lafs[:, :, :2] = rotation(rng.uniform(0, 2 * np.pi, count)) * rng.uniform(
                6, 30, 2
            )
            lafs[:, :, 2] = rng.uniform(0, np.subtract(CAMERA_SIZE, 1), (count, 2))
            write_keypoints(database, image_id, lafs)
            if image_id % 2 == 0:
                write_matches(database, image_id - 1, image_id, same)
    verify(path, VerificationOptions())
    assert verified_pairs(path, 1) == {}


def test_database_without_images_is_one_line(
    healthy: Path, path: Path, call: Call
) -> None:
    execute(
        path,
        *(f"DELETE FROM {table}" for table in ("images", "keypoints", "frame_data")),
    )
    execute(path, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    photos = healthy.parent / "photos"
    out = path.with_name("out")
    for command in ("run", "extract"):
        given = ["--image-path", photos, "--output-path", out, "--from-database", path]
        ended = call(command, "-q", *given)
        assert (ended.code, len(ended.stderr)) == (1, 1)
        assert ended.stderr[0] == f"error: {path}: holds no images; import some first"
        assert not out.exists()


def test_triggers_of_a_received_database_do_nothing(
    healthy: Path, path: Path, call: Call
) -> None:
    for table in ("keypoints", "images", "frames"):
        execute(
            path,
            f"CREATE TRIGGER t{table} AFTER INSERT ON {table} BEGIN DELETE FROM images; END",
        )
    out = path.with_name("out")
    given = ["--image-path", healthy.parent / "photos", "--output-path", out]
    assert call("extract", "-q", *given, "--from-database", path, *FAST[:2]).code == 0
    assert read_names(out / "database.db") == read_names(healthy)
