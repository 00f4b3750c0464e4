"""Copies of COLMAP databases, made by SQLite: COLMAP migrates a database as soon as it opens it.

A copy holds the rows of COLMAP's tables, in tables that pycolmap has made, and nothing else that is
in the file: triggers, views and indices of others could do anything while COLMAP writes.
"""

import sqlite3
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.checks import (
    FATAL,
    FATAL_FOR_IMAGES,
    FATAL_FOR_MAPPING,
    refuse_unusable,
)
from colmap_affrect.colmap.database import open_database, write_frame
from colmap_affrect.colmap.tables import columns_of, open_read_only, rows_of
from colmap_affrect.errors import DatabaseError
from colmap_affrect.project.atomic_files import cannot_write
from colmap_affrect.project.outputs import temporary_folder

COPIED = (  # what is referred to comes first
    "cameras", "rigs", "rig_sensors", "frames", "frame_data", "images", "pose_priors", "keypoints",
    "descriptors", "matches", "two_view_geometries", "inlier_matches",
)  # fmt: skip
"""All tables that COLMAP has had; the last one is older than two-view geometries."""
TYPES = ("INTEGER", "TEXT", "BLOB", "REAL")  # of columns


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
    version = schema_version(path)
    newest = newest_schema_version()
    if version > newest:
        raise DatabaseError(
            f"was made by a newer COLMAP (schema {version}, pycolmap "
            f"{pycolmap.__version__} knows {newest})",
            where=path,
            advice="update pycolmap",
        )
    return version


Change = Callable[[pycolmap.Database], None]


def copy_database(
    source: Path,
    target: Path,
    refused: Collection[str] = (),
    change: Change | None = None,
) -> None:
    """Copy a database as it is now, including its write-ahead log.

    The copy, which appears as a whole, has the schema of the installed pycolmap. COLMAP leaves
    positions of before 3.10 behind. What is no table of COLMAP stays behind.

    Args:
        source: the database, which is only read.
        target: the new database.
        refused: kinds of problems that are refused: databases of anybody are checked before COLMAP
            sees the copy.
        change: changes the copy before it appears.

    Raises:
        DatabaseError: the target exists; the source is no intact database, one of a newer COLMAP,
            or has some of these problems.
    """
    if target.exists():
        raise DatabaseError(
            "exists already", where=target, advice="it is not overwritten"
        )
    version = refuse_newer(source)
    if refused:
        refuse_unusable(source, refused)
    with temporary_folder(target.parent) as folder:
        new = folder / "new.db"
        old = folder / "old.db"
        with open_database(new):  # which makes the tables
            pass
        with open_read_only(source) as original, _one_line(source, target):
            if version == newest_schema_version():
                _copy_tables(original, new)
            else:
                _copy_tables(original, old, version)
        if old.exists():
            with open_database(old):  # COLMAP migrates it
                pass
            with open_read_only(old) as migrated, _one_line(source, target):
                _copy_tables(migrated, new)
        if change:
            with open_database(new) as database:
                change(database)
        new.replace(target)


@contextmanager
def _one_line(source: Path, target: Path) -> Iterator[None]:
    """Say what SQLite refuses to write, naming the file that is copied or the one to be made."""
    try:
        yield
    except sqlite3.IntegrityError as error:
        raise DatabaseError(
            f"has rows that COLMAP's tables cannot hold ({error})",
            where=source,
            advice="import its images again into a new database",
        ) from error
    except sqlite3.OperationalError as error:
        if error.sqlite_errorcode in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE):
            raise cannot_write(target, error) from error
        raise


def _copy_tables(
    original: sqlite3.Connection, target: Path, version: int | None = None
) -> None:
    """Copy the rows of COLMAP's tables.

    Args:
        original: where they are read, in one transaction.
        target: a database with tables of COLMAP, or a new file.
        version: of the tables to be made in a new file, with the columns of the original.
    """
    original.execute("BEGIN")
    with closing(sqlite3.connect(target)) as copy:
        for table in COPIED:
            if version is not None:
                _make_table(original, copy, table)
            _copy_rows(original, copy, table)
        if version is not None:
            copy.execute(f"PRAGMA user_version = {int(version)}")
        copy.commit()


def _columns(connection: sqlite3.Connection, table: str) -> list[str]:
    """Return the columns of a table whose names can be written into a statement, in order."""
    return sorted(name for name in columns_of(connection, table) if name.isidentifier())


def _make_table(
    original: sqlite3.Connection, copy: sqlite3.Connection, table: str
) -> None:
    """Make a table with the columns of the original, and none of its conditions."""
    if not columns_of(original, table):
        return
    columns = []
    for _, name, said, _, _, is_key in original.execute(f"PRAGMA table_info({table})"):
        if not str(name).isidentifier():
            continue
        kind = str(said).upper()
        if kind not in TYPES:
            kind = "BLOB"
        key = " PRIMARY KEY" if is_key and kind == "INTEGER" else ""
        columns.append(f'"{name}" {kind}{key}')
    copy.execute(f"CREATE TABLE {table} ({', '.join(columns)})")


def _copy_rows(
    original: sqlite3.Connection, copy: sqlite3.Connection, table: str
) -> None:
    """Copy the columns that both tables have.

    SQLite takes names of tables and columns in no other way than in the text of a statement.
    """
    common = {*_columns(original, table)} & {*_columns(copy, table)}
    if not common:
        return
    columns = sorted(common)
    quoted = '"' + '", "'.join(columns) + '"'
    marks = ", ".join("?" * len(columns))
    select = f"SELECT {quoted} FROM {table}"  # noqa: S608 - a table of COPIED, identifiers
    insert = f"INSERT INTO {table} ({quoted}) VALUES ({marks})"  # noqa: S608 - the same
    copy.executemany(insert, original.execute(select))


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
def open_copy(
    source: Path, refused: Collection[str] = FATAL - FATAL_FOR_MAPPING
) -> Iterator[pycolmap.Database]:
    """Open a temporary :func:`copy_database`; the original stays as it is."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "database.db"
        copy_database(source, copy, refused)
        with open_database(copy) as database:
            yield database


def read_names(source: Path) -> list[str]:
    """Return the names of the images of a database, which is only read."""
    with open_read_only(source) as connection:
        return sorted(
            str(name) for (name,) in connection.execute("SELECT name FROM images")
        )


def read_sizes(source: Path) -> dict[str, tuple[int, int]]:
    """Return (width, height) in px of the images of a database, which is only read."""
    query = "SELECT name, width, height FROM images JOIN cameras USING (camera_id)"
    sizes = {}
    with open_read_only(source) as connection:
        for name, width, height in connection.execute(query):
            sizes[str(name)] = (width, height)
    return sizes


def has_matches(source: Path) -> bool:
    """Tell whether any pair of a database, which is only read, has matches or a geometry."""
    with open_read_only(source) as connection:
        for table in ("matches", "two_view_geometries", "inlier_matches"):
            for (count,) in rows_of(connection, "rows", table):
                if isinstance(count, int) and count > 0:
                    return True
    return False
