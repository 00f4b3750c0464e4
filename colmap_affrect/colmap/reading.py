"""Databases that are only read, by SQLite: COLMAP migrates whatever it opens."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from colmap_affrect.errors import DatabaseError

TABLES = {"cameras", "images", "keypoints", "matches"}
"""Tables that databases of all versions of COLMAP have."""

HOT_JOURNAL = bytes.fromhex("d9d505f920a163d7")
"""How a rollback journal begins while its changes are not complete."""

DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""What sqlite3 raises on damaged files; its messages may quote bytes that are not UTF-8."""


@contextmanager
def open_read_only(path: Path) -> Iterator[sqlite3.Connection]:
    """Open a COLMAP database so that nothing can change it.

    Without a write-ahead log or a journal nobody is writing to it, and it is opened as immutable:
    SQLite then makes no files beside it, so that its folder may be read-only.
    """
    if not path.is_file():
        raise DatabaseError(f"{path}: no such file; give a COLMAP database")
    wal, journal = (path.with_name(path.name + suffix) for suffix in ("-wal", "-journal"))
    mode = "mode=ro" if wal.exists() or journal.exists() else "immutable=1"
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
        if journal.exists() and journal.read_bytes()[:8] == HOT_JOURNAL:
            raise DatabaseError(
                f"{path}: a program that was writing to it was killed, or is still at work, and "
                f"{journal.name} undoes the half of it; wait, or open it once with a program that "
                f"may write, e.g. sqlite3 {path.name} .tables"
            ) from error
        raise DatabaseError(f"{path}: not a usable COLMAP database ({error})") from error
