"""Copies of a COLMAP database with one thing wrong each, chosen by chance."""

from __future__ import annotations

import random
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

PAGE_BYTES = 4096

STATEMENTS = (
    "UPDATE images SET camera_id = 999 WHERE image_id = {id}",
    "UPDATE images SET name = '' WHERE image_id = {id}",
    "UPDATE images SET name = x'ff00fe' WHERE image_id = {id}",
    "DELETE FROM images WHERE image_id = {id}",
    "UPDATE keypoints SET rows = 100000 WHERE image_id = {id}",
    "UPDATE keypoints SET rows = -1 WHERE image_id = {id}",
    "UPDATE keypoints SET cols = 0 WHERE image_id = {id}",
    "UPDATE keypoints SET data = substr(data, 1, 101) WHERE image_id = {id}",
    "UPDATE keypoints SET data = NULL WHERE image_id = {id}",
    "UPDATE keypoints SET data = 'text' WHERE image_id = {id}",
    "DELETE FROM keypoints WHERE image_id = {id}",
    "UPDATE matches SET rows = 100000",
    "UPDATE matches SET rows = -1",
    "UPDATE matches SET pair_id = -pair_id",
    "UPDATE matches SET data = substr(data, 1, 9)",
    "UPDATE matches SET data = x'ffffffffffffffff', rows = 1",
    "UPDATE two_view_geometries SET F = x'00'",
    "UPDATE two_view_geometries SET config = 77",
    "UPDATE two_view_geometries SET qvec = zeroblob(32)",
    "UPDATE two_view_geometries SET rows = 100000",
    "UPDATE two_view_geometries SET data = zeroblob(length(data) - 3)",
    "UPDATE two_view_geometries SET data = x'ffffffffffffffff', rows = 1",
    "UPDATE cameras SET model = 12345",
    "UPDATE cameras SET height = 0",
    "UPDATE cameras SET width = 9223372036854775807",
    "UPDATE cameras SET width = 'wide'",
    "UPDATE cameras SET params = x'00'",
    "UPDATE cameras SET params = zeroblob(length(params))",
    "UPDATE frames SET rig_id = 99",
    "DELETE FROM rigs",
    "DELETE FROM cameras",
    "DROP TABLE frame_data",
    "DROP TABLE two_view_geometries",
    "ALTER TABLE images RENAME COLUMN camera_id TO camera",
    "CREATE TRIGGER nosy AFTER INSERT ON matches BEGIN DELETE FROM images; END",
    "PRAGMA user_version = 2147483647",
    "PRAGMA user_version = -5",
)
"""What may be done to the rows of a database; ``{id}`` is one of the images."""


def pages(data: bytearray, chance: random.Random) -> str:
    """Replace a page, not the first, by noise."""
    start = chance.randrange(1, len(data) // PAGE_BYTES) * PAGE_BYTES
    data[start : start + PAGE_BYTES] = chance.randbytes(PAGE_BYTES)
    return f"noise at {start}"


def bits(data: bytearray, chance: random.Random) -> str:
    """Change a few bytes."""
    places = sorted(chance.sample(range(len(data)), chance.choice((1, 4, 32))))
    for place in places:
        data[place] ^= chance.randrange(1, 256)
    return f"{len(places)} bytes changed, the first at {places[0]}"


def header(data: bytearray, chance: random.Random) -> str:
    """Change a byte among the first hundred, which say how the file is to be read."""
    place = chance.randrange(100)
    data[place] ^= chance.randrange(1, 256)
    return f"header changed at {place}"


def cut(data: bytearray, chance: random.Random) -> str:
    """Cut the file off."""
    del data[chance.randrange(len(data)) :]
    return f"cut off at {len(data)}"


def zeros(data: bytearray, chance: random.Random) -> str:
    """Blank some sectors, as disks do that lose a write."""
    start = chance.randrange(len(data) // 512) * 512
    count = 512 * chance.randrange(1, 40)
    data[start : start + count] = bytes(len(data[start : start + count]))
    return f"{count} zeros at {start}"


def exchanged(data: bytearray, chance: random.Random) -> str:
    """Write one page over another."""
    source, target = (k * PAGE_BYTES for k in chance.sample(range(1, len(data) // PAGE_BYTES), 2))
    data[target : target + PAGE_BYTES] = data[source : source + PAGE_BYTES]
    return f"page at {source} written over that at {target}"


BYTES: tuple[Callable[[bytearray, random.Random], str], ...] = (bits, header, cut, zeros, exchanged)


def damage_bytes(
    path: Path, harm: Callable[[bytearray, random.Random], str], chance: random.Random
) -> str:
    """Change the bytes of a database; return what was done."""
    data = bytearray(path.read_bytes())
    done = harm(data, chance)
    path.write_bytes(data)
    return done


def damage_rows(path: Path, statement: str, chance: random.Random) -> str:
    """Execute a statement on a database; return it."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        ids = [row[0] for row in connection.execute("SELECT image_id FROM images")]
        statement = statement.format(id=chance.choice(ids))
        connection.execute(statement)
        connection.commit()
    return statement
