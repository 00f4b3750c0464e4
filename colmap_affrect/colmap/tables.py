"""What a COLMAP database of any version holds, read by SQLite: COLMAP migrates what it opens."""

import hashlib
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from colmap_affrect.errors import DatabaseError, OptionError, with_arguments
from colmap_affrect.project.paths import resolved
from colmap_affrect.project.regular_files import (
    NotAFileError,
    first_bytes,
    open_regular,
    require_regular,
)

TABLES = {"cameras", "images", "keypoints", "matches"}  # of all versions of COLMAP
MAGIC = b"SQLite format 3\0"  # begins each file of SQLite's that is not empty
HOT_JOURNAL = bytes.fromhex("d9d505f920a163d7")  # begins one of unfinished changes
# What sqlite3 raises, also quoting odd bytes
DAMAGED = (sqlite3.Error, UnicodeDecodeError)
# COLMAP's: an id of a pair is the smaller image id times this, plus the larger
MAX_NUM_IMAGES = 2**31 - 1
SENSOR_CAMERA = 0  # COLMAP's number of the kind of sensor

DIGESTED = (  # tables that decide what is mapped
    "cameras", "rigs", "rig_sensors", "frames", "frame_data", "images", "pose_priors", "keypoints",
    "matches", "two_view_geometries",
)  # fmt: skip


class NoDatabaseError(DatabaseError):
    """A file that has never been one of SQLite's, or whose beginning is lost."""


@contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a COLMAP database so that nothing can change it.

    Without a write-ahead log or a journal as immutable: SQLite makes no files beside it then.
    """
    wal = Path(f"{path}-wal")
    journal = Path(f"{path}-journal")
    _require_regular_files((path, wal, journal, Path(f"{path}-shm")))
    _require_sqlite(path)
    mode = "mode=ro" if wal.exists() or journal.exists() else "immutable=1"
    address = f"{resolved(path).as_uri()}?{mode}"
    try:
        with closing(sqlite3.connect(address, uri=True)) as connection:
            connection.execute("PRAGMA trusted_schema = OFF")  # no code of the file
            _require_tables(connection, path)
            yield connection
    except DAMAGED as error:
        if journal.exists() and first_bytes(journal, 8) == HOT_JOURNAL:
            raise DatabaseError(
                "a program that was writing to it was killed, or is still at work, and "
                f"{journal.name} undoes the half of it",
                where=path,
                advice="wait, or open it once with a program that may write, e.g. sqlite3 "
                f"{path.name} .tables",
            ) from error
        raise DatabaseError(
            f"not a usable COLMAP database ({error})", where=path
        ) from error


def _require_sqlite(path: Path) -> None:
    """Refuse a file that is none of SQLite's, text perhaps, or a model; NoDatabaseError."""
    try:
        with open_regular(path) as file:
            start = file.read(len(MAGIC))
    except OSError:
        return  # SQLite says why
    if start and start != MAGIC and not MAGIC.startswith(start):
        raise NoDatabaseError(
            "not a usable COLMAP database (it does not begin as files of SQLite do)",
            where=path,
        )


def _require_regular_files(paths: Sequence[Path]) -> None:
    """Refuse a database, the first of some paths, that is missing, and what is no regular file."""
    for path in paths:
        try:
            require_regular(path)
        except NotAFileError as error:
            raise OptionError(
                error, where=path, advice="give a COLMAP database"
            ) from error
    if not paths[0].is_file():
        raise OptionError(
            "no such file", where=paths[0], advice="give a COLMAP database"
        )


def _require_tables(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a database of another program."""
    rows = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    missing = TABLES - {name for (name,) in rows}
    if missing:
        raise DatabaseError(
            f"not a COLMAP database (it has no table {min(missing)})", where=path
        )


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
        num_images = len(self.names)
        num_cameras = len(self.cameras)
        num_keypoints = sum(rows for rows, _ in self.keypoints.values())
        images = "image" if num_images == 1 else "images"
        cameras = "camera" if num_cameras == 1 else "cameras"
        return (
            f"{num_images} {images}, {num_cameras} {cameras}, {num_keypoints} keypoints, "
            f"{self.num_matched} matched and {self.num_verified} verified pairs"
        )


def read_tables(connection: sqlite3.Connection) -> Tables:
    """Read all tables but the data of keypoints, descriptors and matches."""
    images = list(rows_of(connection, "image_id name camera_id", "images"))
    cameras = {}
    rows = rows_of(connection, "camera_id width height model params", "cameras")
    for camera_id, width, height, model, params in rows:
        cameras[int(camera_id)] = Camera(
            width=int(width), height=int(height), model=int(model), params=params
        )
    frame_images = set[int]()
    for image_id, kind in rows_of(connection, "data_id sensor_type", "frame_data"):
        if kind == SENSOR_CAMERA:
            frame_images.add(int(image_id))
    num_frames = len(list(rows_of(connection, "frame_id", "frames")))
    sizes = rows_of(connection, "image_id rows cols", "keypoints")
    return Tables(
        cameras=cameras,
        names={int(image_id): str(name) for image_id, name, _ in images},
        camera_ids={int(image_id): int(camera_id) for image_id, _, camera_id in images},
        frame_images=frame_images,
        num_frames=num_frames,
        keypoints={
            int(image_id): (int(rows), int(columns))
            for image_id, rows, columns in sizes
        },
        num_matched=_num_with_rows(connection, "matches"),
        num_verified=_num_with_rows(connection, "two_view_geometries"),
    )


def _num_with_rows(connection: sqlite3.Connection, table: str) -> int:
    """Return how many pairs of a table of matches have some."""
    return sum(int(count) > 0 for (count,) in rows_of(connection, "rows", table))


def rows_of(
    connection: sqlite3.Connection, columns: str, table: str
) -> Iterable[tuple[Any, ...]]:
    """Return columns of a table, row by row.

    Args:
        connection: to the database.
        columns: names with spaces between; those that the table lacks are 0.
        table: of COLMAP.

    Returns:
        The rows; nothing if there is no such table.
    """
    known = columns_of(connection, table)
    if not known:
        return ()
    known.add("rowid")
    present = ", ".join(name if name in known else "0" for name in columns.split())
    return connection.execute(f"SELECT {present} FROM {table}")  # noqa: S608 - names that this package has written down


def rows_digest(path: Path) -> str:
    """Return a SHA-256 of all rows but descriptors; DatabaseError where they cannot be read."""
    tables = ", ".join(f"'{table}'" for table in DIGESTED)
    queries = [
        "* FROM pragma_user_version",
        f"sql FROM sqlite_master WHERE tbl_name IN ({tables}) ORDER BY name",
    ]
    for table in DIGESTED:
        queries.append(f"* FROM {table}")
    digest = hashlib.sha256()
    with open_read_only(path) as connection:
        connection.text_factory = bytes
        for query in queries:
            for row in connection.execute(f"SELECT {query}"):
                for value in row:
                    digest.update(
                        value if isinstance(value, bytes) else repr(value).encode()
                    )
                    digest.update(b"|")
    return digest.hexdigest()


def require_intact_pages(connection: sqlite3.Connection, path: Path) -> None:
    """Refuse a database that SQLite finds damaged, perhaps in an index that no row shows."""
    (verdict,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if verdict != "ok":
        raise DatabaseError(f"damaged ({str(verdict).splitlines()[-1]})", where=path)


def damage_of(path: Path) -> str:
    """Return how a database is damaged, empty if it is not."""
    try:
        with open_read_only(path) as connection:
            require_intact_pages(connection, path)
    except (DatabaseError, OptionError) as error:
        return with_arguments(error.what)
    return ""


def columns_of(connection: sqlite3.Connection, table: str) -> set[str]:
    """Return the columns of a table, none if there is no such table; a view is none."""
    is_table = (
        "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = ? COLLATE NOCASE"
    )
    if not connection.execute(is_table, (table,)).fetchone():
        return set()
    return {str(row[1]) for row in connection.execute(f"PRAGMA table_info({table})")}
