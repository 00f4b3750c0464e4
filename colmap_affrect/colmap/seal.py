"""What a command left in a database, to tell what others have changed in it since.

- ``database.db.parts``: digests of all rows, by image, camera and pair.
- ``database.db.seal``: size and times of the file, while no command works with it. A database that
  has them still is not read.
- ``database.db.seal-open``: the same while a command works. ``open_database`` removes it when
  anything is written, so a database without a seal was left by a process that was killed.
"""

import hashlib
import io
import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.database import working_seal
from colmap_affrect.colmap.tables import open_read_only
from colmap_affrect.errors import DatabaseError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.project.atomic_files import replace_bytes, replace_text

QUERIES = {
    "tables": "SELECT 0, user_version, (SELECT group_concat(sql) FROM (SELECT sql FROM "
    "sqlite_master WHERE tbl_name IN ('cameras', 'rigs', 'rig_sensors', 'frames', 'frame_data', "
    "'images', 'pose_priors', 'keypoints', 'descriptors', 'matches', 'two_view_geometries') "
    "ORDER BY name)) FROM pragma_user_version",
    "images": "SELECT image_id, name, camera_id FROM images",
    "cameras": "SELECT camera_id, width, height FROM cameras",
    "intrinsics": "SELECT camera_id, model, params, prior_focal_length FROM cameras",
    "rigs": "SELECT rowid, * FROM rigs",
    "rig_sensors": "SELECT rowid, * FROM rig_sensors",
    "frames": "SELECT rowid, * FROM frames",
    "frame_data": "SELECT rowid, * FROM frame_data",
    "priors": "SELECT rowid, * FROM pose_priors",
    "keypoints": "SELECT rowid, * FROM keypoints",
    "matches": "SELECT rowid, * FROM matches",
    "geometries": "SELECT rowid, * FROM two_view_geometries",
}
"""By part: the key of each of its rows, and what is digested."""

ROW = np.dtype([("key", "<i8"), ("digest", "<u8")])
Parts = dict[str, NDArray[np.void]]


@dataclass(frozen=True)
class Change:
    """What has changed in a part of a database: keys of rows."""

    added: Indices
    gone: Indices
    changed: Indices
    num_before: int

    @property
    def keys(self) -> Indices:
        """All of them."""
        return np.concatenate([self.added, self.gone, self.changed])


def seal_of(path: Path) -> Path:
    """Return the seal of a database that no command is working with."""
    return path.with_name(path.name + ".seal")


def parts_of(path: Path) -> Path:
    """Return the file of digests."""
    return path.with_name(path.name + ".parts")


def is_untouched(path: Path) -> bool:
    """Tell whether a database is as it was when it was sealed."""
    return _stamp(path) in map(_read_stamp, (seal_of(path), working_seal(path)))


def begin_work(path: Path) -> None:
    """Have it known that a command works with a database."""
    if not is_untouched(path):
        remove_seal(path)
    elif seal_of(path).exists():
        seal_of(path).replace(working_seal(path))


def keep_seal(path: Path) -> None:
    """Take a database that was read, and holds what was sealed, for one that nobody has touched."""
    replace_text(working_seal(path), json.dumps(_stamp(path)))


def remove_seal(path: Path) -> None:
    """Have a database read again when it is sealed."""
    for file in (seal_of(path), working_seal(path)):
        file.unlink(missing_ok=True)


def end_work(path: Path, *, reads: bool = True) -> None:
    """Seal a database; without ``reads`` only one to which nothing was written meanwhile."""
    if not path.exists():
        return
    working, stamp = working_seal(path), _stamp(path)
    # Opening it through COLMAP changes the times, and another file is a new one.
    is_same = parts_of(path).exists() and _read_stamp(working)[:2] == stamp[:2]
    if not (is_same or reads):
        return
    if not is_same:
        content = io.BytesIO()
        parts: dict[str, Any] = read_parts(path)
        np.savez(content, **parts)
        replace_bytes(parts_of(path), content.getvalue())
    if is_same and _read_stamp(working) == stamp:
        working.replace(seal_of(path))
        return
    replace_text(seal_of(path), json.dumps(stamp))
    working.unlink(missing_ok=True)


def changes(path: Path) -> dict[str, Change]:
    """Return what has changed by part, nothing where no command had sealed the database.

    Raises DatabaseError where it cannot be read.
    """
    now, found = read_parts(path), dict[str, Change]()
    if not seal_of(path).exists():
        return found
    with (
        suppress(OSError, ValueError, KeyError, BadZipFile),
        np.load(parts_of(path), allow_pickle=False) as before,
    ):
        for part, rows in now.items():
            old = before[part]
            _, at, there = np.intersect1d(old["key"], rows["key"], True, return_indices=True)
            change = Change(
                np.setdiff1d(rows["key"], old["key"]),
                np.setdiff1d(old["key"], rows["key"]),
                old["key"][at][old["digest"][at] != rows["digest"][there]],
                len(old),
            )
            if len(change.keys):
                found[part] = change
    return found


def read_parts(path: Path) -> Parts:
    """Return the digests of all rows by part; DatabaseError where it cannot be read."""
    with open_read_only(path) as connection:
        connection.text_factory = bytes
        try:
            parts = {
                part: np.fromiter(((row[0], _digest(row)) for row in connection.execute(sql)), ROW)
                for part, sql in QUERIES.items()
            }
        except (TypeError, ValueError, OverflowError) as error:
            raise DatabaseError(f"{path}: damaged ({error})") from error
    if any(len(np.unique(rows["key"])) < len(rows) for rows in parts.values()):
        raise DatabaseError(f"{path}: damaged (rows have the same number)")
    return parts


def _digest(row: tuple[object, ...]) -> int:
    digest = hashlib.blake2b(digest_size=8)
    for value in row:
        digest.update(value if isinstance(value, bytes) else repr(value).encode())
        digest.update(b"|")
    return int.from_bytes(digest.digest(), "little")


def _stamp(path: Path) -> list[int]:
    """Return number and size of a file and its times, and those of the log beside it."""
    found = list[int]()
    for file in (path, path.with_name(path.name + "-wal")):
        with suppress(FileNotFoundError):
            there = file.stat()
            found += [there.st_ino, there.st_size, there.st_mtime_ns, there.st_ctime_ns]
    return found


def _read_stamp(path: Path) -> list[int]:
    with suppress(OSError, ValueError, TypeError):
        return [int(number) for number in json.loads(path.read_text())]
    return []
