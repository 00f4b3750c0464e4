"""What a COLMAP database of any version holds, read by SQLite: COLMAP migrates what it opens."""

import hashlib
import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from colmap_affrect.errors import DatabaseError, OptionError
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.regular_files import NotAFileError, read_regular, require_regular

TABLES = {"cameras", "images", "keypoints", "matches"}  # of all versions of COLMAP
HOT_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # begins one of unfinished changes
DAMAGED = (sqlite3.Error, UnicodeDecodeError)  # what sqlite3 raises, also quoting odd bytes
MAX_NUM_IMAGES = 2**31 - 1  # an id of a pair is the smaller image id times this, plus the larger
SENSOR_CAMERA = 0

DIGESTED = (  # tables that decide what is mapped
    "cameras", "rigs", "rig_sensors", "frames", "frame_data", "images", "pose_priors", "keypoints",
    "matches", "two_view_geometries",
)  # fmt: skip


@contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a COLMAP database so that nothing can change it.

    Without a write-ahead log or a journal as immutable: SQLite makes no files beside it then.
    """
    wal, journal, index = (Path(f"{path}{end}") for end in ("-wal", "-journal", "-shm"))
    for file in (path, wal, journal, index):
        try:
            require_regular(file)
        except NotAFileError as error:
            raise OptionError(f"{file}: {error}; give a COLMAP database") from error
    if not path.is_file():
        raise OptionError(f"{path}: no such file; give a COLMAP database")
    mode = "mode=ro" if wal.exists() or journal.exists() else "immutable=1"
    address = f"{resolved(path).as_uri()}?{mode}"
    try:
        with closing(sqlite3.connect(address, uri=True)) as connection:
            connection.execute("PRAGMA trusted_schema = OFF")  # no code of the file
            rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
            if missing := TABLES - {name for (name,) in rows}:
                raise DatabaseError(
                    f"{path}: not a COLMAP database (it has no table {min(missing)})"
                )
            yield connection
    except DAMAGED as error:
        if journal.exists() and read_regular(journal)[:8] == HOT_JOURNAL:
            raise DatabaseError(
                f"{path}: a program that was writing to it was killed, or is still at work, and "
                f"{journal.name} undoes the half of it; wait, or open it once with a program that "
                f"may write, e.g. sqlite3 {path.name} .tables"
            ) from error
        raise DatabaseError(f"{path}: not a usable COLMAP database ({error})") from error


class Camera(NamedTuple):
    """A row of the table of cameras; the size is in px, the model a number of COLMAP's."""

    width: int
    height: int
    model: int
    params: Any


@dataclass(frozen=True)
class Tables:
    """What a database holds, without the data of keypoints and matches."""

    cameras: dict[int, Camera]  # by id
    names: dict[int, str]  # of the images, by id
    camera_ids: dict[int, int]  # by image id
    frame_images: set[int]  # ids of the images that are in a frame
    num_frames: int  # number of frames
    keypoints: dict[int, tuple[int, int]]  # rows and columns by image id
    num_matched: int  # pairs with raw matches
    num_verified: int  # pairs with inliers

    def summary(self) -> str:
        """Return the numbers of what there is."""
        features = sum(rows for rows, _ in self.keypoints.values())
        images = len(self.names)
        cameras = len(self.cameras)
        return (
            f"{images} image{'s' * (images != 1)}, {cameras} camera{'s' * (cameras != 1)}, "
            f"{features} keypoints, {self.num_matched} matched and {self.num_verified} verified "
            "pairs"
        )


def read_tables(connection: sqlite3.Connection) -> Tables:
    """Read all tables but the data of keypoints, descriptors and matches."""
    rows = partial(rows_of, connection)
    images = list(rows("image_id name camera_id", "images"))
    cameras = rows("camera_id width height model params", "cameras")
    return Tables(
        cameras={
            int(key): Camera(int(width), int(height), int(model), params)
            for key, width, height, model, params in cameras
        },
        names={int(key): str(name) for key, name, _ in images},
        camera_ids={int(key): int(camera_id) for key, _, camera_id in images},
        frame_images={
            int(key)
            for key, kind in rows("data_id sensor_type", "frame_data")
            if kind == SENSOR_CAMERA
        },
        num_frames=sum(1 for _ in rows("frame_id", "frames")),
        keypoints={
            int(key): (int(count), int(columns))
            for key, count, columns in rows("image_id rows cols", "keypoints")
        },
        num_matched=sum(int(count) > 0 for (count,) in rows("rows", "matches")),
        num_verified=sum(int(count) > 0 for (count,) in rows("rows", "two_view_geometries")),
    )


def rows_of(connection: sqlite3.Connection, columns: str, table: str) -> Iterable[tuple[Any, ...]]:
    """Return columns of a table, row by row; nothing if there is no such table.

    Names of columns have spaces between; those that the table lacks are 0.
    """
    known = columns_of(connection, table)
    if not known:
        return ()
    present = ", ".join(name if name in known | {"rowid"} else "0" for name in columns.split())
    # All names are those of COLMAP's tables, written down in this package.
    return connection.execute(f"SELECT {present} FROM {table}")  # noqa: S608


def rows_digest(path: Path) -> str:
    """Return a SHA-256 of all rows but descriptors; DatabaseError where they cannot be read."""
    digest = hashlib.sha256()
    with open_read_only(path) as connection:
        connection.text_factory = bytes
        names = ", ".join(f"'{table}'" for table in DIGESTED)
        made = f"sql FROM sqlite_master WHERE tbl_name IN ({names}) ORDER BY name"
        queries = ["* FROM pragma_user_version", made, *(f"* FROM {name}" for name in DIGESTED)]
        for query in queries:
            for row in connection.execute(f"SELECT {query}"):
                for value in row:
                    digest.update(value if isinstance(value, bytes) else repr(value).encode())
                    digest.update(b"|")
    return digest.hexdigest()


def require_intact_pages(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a database that SQLite finds damaged, perhaps in an index that no row shows."""
    (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise DatabaseError(f"{path}: damaged ({str(verdict).splitlines()[-1]})")


def damage_of(path: Path) -> str:
    """Return how a database is damaged, empty if it is not."""
    try:
        with open_read_only(path) as connection:
            require_intact_pages(connection, path)
    except (DatabaseError, OptionError) as error:
        return str(error).removeprefix(f"{path}: ")
    return ""


def columns_of(connection: sqlite3.Connection, table: str) -> set[str]:
    """Return the columns of a table, none if there is no such table; a view is none."""
    is_table = "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ? COLLATE NOCASE"
    if not connection.execute(is_table, (table,)).fetchone():
        return set()
    return {str(row[1]) for row in connection.execute(f"PRAGMA table_info({table})")}
