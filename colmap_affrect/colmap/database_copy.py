"""Copies of COLMAP databases, made by SQLite: COLMAP migrates a database as soon as it opens it."""

import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import FATAL, FATAL_FOR_IMAGES, refuse_unusable
from colmap_affrect.colmap.database import open_database, write_frame
from colmap_affrect.colmap.tables import open_read_only
from colmap_affrect.errors import DatabaseError
from colmap_affrect.project.outputs import temporary_folder


def schema_version(path: Path) -> int:
    """Return the version of the tables, e.g. 4020100 for COLMAP 4.2.1; OptionError if no file."""
    with open_read_only(path) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


@cache
def newest_schema_version() -> int:
    """Return the version of the databases that the installed pycolmap writes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "new.db"
        with open_database(path):
            pass
        return schema_version(path)


def refuse_newer(path: Path) -> int:
    """Return the version of the tables; DatabaseError if pycolmap does not know it."""
    version, newest = schema_version(path), newest_schema_version()
    if version > newest:
        raise DatabaseError(
            f"{path}: was made by a newer COLMAP (schema {version}, pycolmap "
            f"{pycolmap.__version__} knows {newest}); update pycolmap"
        )
    return version


Change = Callable[[pycolmap.Database], None]


def copy_database(
    source: Path, target: Path, refused: Collection[str] = (), change: Change | None = None
) -> None:
    """Copy a database as it is now, including its write-ahead log.

    The copy, which appears as a whole, has the schema of the installed pycolmap, and what
    ``change`` does to it. COLMAP leaves positions of before 3.10 behind. DatabaseError when the
    target exists, for what is no intact database or one of a newer COLMAP, and for ``refused``
    kinds of problems: databases of anybody are checked before COLMAP sees the copy.
    """
    if target.exists():
        raise DatabaseError(f"{target}: exists already; it is not overwritten")
    refuse_newer(source)
    if refused:
        refuse_unusable(source, refused)
    with temporary_folder(target.parent) as folder:
        new = folder / target.name
        with open_read_only(source) as original, closing(sqlite3.connect(new)) as copy:
            original.backup(copy)
        with open_database(new) as database:  # COLMAP migrates it
            if change:
                change(database)
        new.replace(target)


def copy_without_features(source: Path, target: Path) -> None:
    """Copy cameras, rigs, frames, images and pose priors, with their ids; all images get frames."""

    def change(database: pycolmap.Database) -> None:
        database.clear_keypoints()
        database.clear_descriptors()
        database.clear_matches()
        database.clear_two_view_geometries()
        add_frames(database)

    copy_database(source, target, FATAL_FOR_IMAGES, change)


def add_frames(database: pycolmap.Database) -> None:
    """Give every image a frame: mapping refuses a database in which only some have one."""
    rigs = {rig.ref_sensor_id: rig.rig_id for rig in database.read_all_rigs()}
    for image in database.read_all_images():
        if not image.has_frame_id():
            write_frame(database, image, rigs)


@contextmanager
def open_copy(source: Path) -> Iterator[pycolmap.Database]:
    """Open a temporary :func:`copy_database`; the original stays as it is."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        copy_database(source, copy, FATAL - {"camera-panorama"})
        with open_database(copy) as database:
            yield database


def read_names(source: Path) -> list[str]:
    """Return the names of the images of a database, which is only read."""
    with open_read_only(source) as connection:
        return sorted(str(name) for (name,) in connection.execute("SELECT name FROM images"))


def has_matches(source: Path) -> bool:
    """Tell whether any pair of a database, which is only read, has matches or a geometry."""
    with open_read_only(source) as connection:
        rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        tables = {"matches", "two_view_geometries", "inlier_matches"} & {name for (name,) in rows}
        queries = [f"SELECT EXISTS (SELECT 1 FROM {name} WHERE rows > 0)" for name in tables]  # noqa: S608
        return any(connection.execute(query).fetchone()[0] for query in queries)
