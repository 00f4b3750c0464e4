"""Copies of COLMAP databases, made without opening the original through COLMAP.

COLMAP migrates a database in place as soon as it opens it, even for reading. So a user's database
is read and copied by SQLite itself, and COLMAP opens only the copy.
"""

from __future__ import annotations

import sqlite3
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import DatabaseError

TABLES = {"cameras", "images", "keypoints", "matches"}
"""Tables that databases of all versions of COLMAP have."""

DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""What sqlite3 raises on damaged files; its messages may quote bytes that are not UTF-8."""


def schema_version(path: Path) -> int:
    """Return the version of a database's tables, e.g. 4020100 for COLMAP 4.2.1.

    Raises DatabaseError when the file is missing or no COLMAP database.
    """
    with _open_read_only(path) as connection:
        version = connection.execute("PRAGMA user_version").fetchone()[0]
    return int(version)


@cache
def newest_schema_version() -> int:
    """Return the version of the databases that the installed pycolmap writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "new.db"
        with open_database(path):
            pass
        return schema_version(path)


def copy_database(source: Path, target: Path) -> None:
    """Copy a database as it is now, including its write-ahead log.

    The copy has the schema of the installed pycolmap. Raises DatabaseError when the source is
    missing, not a COLMAP database, or one of a newer COLMAP; or when the target exists.
    """
    if target.exists():
        raise DatabaseError(f"{target}: exists already; it is not overwritten")
    version, newest = schema_version(source), newest_schema_version()
    if version > newest:
        raise DatabaseError(
            f"{source}: was made by a newer COLMAP (schema {version}, pycolmap "
            f"{pycolmap.__version__} knows {newest}); update pycolmap"
        )
    new = target.with_name(target.name + ".new")
    new.unlink(missing_ok=True)
    try:
        with _open_read_only(source) as original, closing(sqlite3.connect(new)) as copy:
            original.backup(copy)
        with open_database(new):
            pass  # COLMAP migrates it
    except (*DAMAGED, DatabaseError) as error:
        new.unlink(missing_ok=True)
        raise DatabaseError(f"cannot copy {source} to {target}: {error}") from error
    new.replace(target)


def copy_with_frames(source: Path, target: Path) -> None:
    """Copy a database with all its content, as :func:`copy_database`; every image gets a frame."""
    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    copy_database(source, partial)
    with open_database(partial) as database:
        _add_frames(database)
    partial.replace(target)


def copy_without_features(source: Path, target: Path) -> None:
    """Copy cameras, rigs, frames, images and pose priors of a database, as :func:`copy_database`.

    Ids stay the same. Images without a frame get one: frames came with COLMAP 3.12, and mapping
    refuses a database in which only some images have one.
    """
    if target.exists():
        raise DatabaseError(f"{target}: exists already; it is not overwritten")
    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    copy_database(source, partial)
    with open_database(partial) as database:
        database.clear_keypoints()
        database.clear_descriptors()
        database.clear_matches()
        database.clear_two_view_geometries()
        _add_frames(database)
    partial.replace(target)


def copy_without_pairs(source: Path, target: Path, pairs: Iterable[tuple[int, int]]) -> None:
    """Copy a database and leave out the two-view geometries of some pairs of image ids."""
    copy_database(source, target)
    with closing(pycolmap.Database.open(target)) as database:
        for image_id1, image_id2 in pairs:
            database.delete_two_view_geometry(image_id1, image_id2)


def _add_frames(database: pycolmap.Database) -> None:
    rig_of_sensor = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
    cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
    for image in database.read_all_images():
        if image.has_frame_id():
            continue
        sensor = cameras[image.camera_id].sensor_id
        if sensor not in rig_of_sensor:
            rig = pycolmap.Rig()
            rig.add_ref_sensor(sensor)
            rig_of_sensor[sensor] = database.write_rig(rig)
        frame = pycolmap.Frame(rig_id=rig_of_sensor[sensor])
        frame.add_data_id(image.data_id)
        database.write_frame(frame)


@contextmanager
def open_copy(source: Path) -> Iterator[pycolmap.Database]:
    """Open a temporary :func:`copy_database`; the original stays as it is."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        copy_database(source, copy)
        with open_database(copy) as database:
            yield database


@contextmanager
def _open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a COLMAP database so that nothing can change it.

    Without a write-ahead log nobody is writing to it, and it is opened as immutable: SQLite then
    makes no files beside it, so that its folder may be read-only.
    """
    if not path.is_file():
        raise DatabaseError(f"{path}: no such file; give a COLMAP database")
    mode = "mode=ro" if path.with_name(path.name + "-wal").exists() else "immutable=1"
    address = f"{path.resolve().as_uri()}?{mode}"
    try:
        with closing(sqlite3.connect(address, uri=True)) as connection:
            rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            missing = TABLES - {name for (name,) in rows}
            if missing:
                raise DatabaseError(
                    f"{path}: not a COLMAP database (it has no table {min(missing)})"
                )
            yield connection
    except DAMAGED as error:
        raise DatabaseError(f"{path}: not a usable COLMAP database ({error})") from error
