"""What a command left in a database, to tell what others have changed in it since.

``database.db.seal`` holds size and times of the file, and digests of all rows by image, camera and
pair; a file with these times is not read. While a command works it is ``database.db.seal-open``,
which ``open_database`` removes when anything is written: a killed process leaves none.
"""

import hashlib
import io
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap.database import working_seal
from colmap_affrect.colmap.tables import open_read_only
from colmap_affrect.errors import DAMAGE, DatabaseError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.project.atomic_files import replace_bytes

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

UNREADABLE = (*DAMAGE, BadZipFile, EOFError)
STAMP = "stamp"  # numbers and times of the files, beside the parts
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


def has_seal(path: Path) -> bool:
    """Tell whether a database was sealed when the last command that worked with it ended."""
    return bool(_stamp_in(seal_of(path)))


def is_untouched(path: Path) -> bool:
    """Tell whether a database is as it was when it was sealed."""
    return _stamp(path) in map(_stamp_in, (seal_of(path), working_seal(path)))


def begin_work(path: Path) -> None:
    """Have it known that a command works with a database."""
    if not is_untouched(path):
        remove_seal(path)
    elif seal_of(path).exists():
        seal_of(path).replace(working_seal(path))


def keep_seal(path: Path) -> None:
    """Take a database that was read, and holds what was sealed, for one that nobody has touched."""
    _write(seal_of(path), _parts_in(seal_of(path)), _stamp(path))


def remove_seal(path: Path) -> None:
    """Have a database read again when it is sealed."""
    for file in (seal_of(path), working_seal(path)):
        file.unlink(missing_ok=True)


def end_work(path: Path, *, reads: bool = True) -> None:
    """Seal a database; without ``reads`` only one to which nothing was written meanwhile."""
    if not path.exists():
        return
    working, stamp = working_seal(path), _stamp(path)
    known = _stamp_in(working)
    if known == stamp:
        working.replace(seal_of(path))
        return
    # Opening it through COLMAP changes the times, and another file is a new one.
    parts = _parts_in(working) if known[:2] == stamp[:2] else {}
    if parts or reads:
        _write(seal_of(path), parts or read_parts(path), stamp)
        working.unlink(missing_ok=True)


def changes(path: Path) -> dict[str, Change]:
    """Return what has changed by part, nothing where no command had sealed the database."""
    now, found = read_parts(path), dict[str, Change]()
    before = _parts_in(seal_of(path))
    for part, rows in now.items() if before else ():
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


def _write(seal: Path, parts: Parts, stamp: list[int]) -> None:
    content, arrays = io.BytesIO(), {STAMP: np.array(stamp, np.int64), **parts}
    np.savez(content, **arrays)  # type: ignore[arg-type]
    replace_bytes(seal, content.getvalue())


def _stamp_in(seal: Path) -> list[int]:
    return [int(number) for number in _arrays_in(seal, (STAMP,)).get(STAMP, ())]


def _parts_in(seal: Path) -> Parts:
    return _arrays_in(seal, QUERIES)


def _arrays_in(seal: Path, names: Iterable[str]) -> dict[str, NDArray[Any]]:
    """Return arrays of a seal; none where there is no seal, or it cannot be read."""
    with suppress(*UNREADABLE), np.load(seal, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in names}
    return {}
