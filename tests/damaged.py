"""Damage to files by chance, and edits of COLMAP databases."""

from __future__ import annotations

import os
import random
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

PAGE_BYTES = 4096

Harm = Callable[[bytearray, random.Random], None]


def bits(data: bytearray, chance: random.Random) -> None:
    for _ in range(chance.choice((1, 4, 32))):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)


def header(data: bytearray, chance: random.Random) -> None:
    data[chance.randrange(min(100, len(data)))] ^= chance.randrange(1, 256)


def _page(data: bytearray, chance: random.Random) -> slice:
    start = chance.randrange(-(-len(data) // PAGE_BYTES)) * PAGE_BYTES
    return slice(start, min(len(data), start + PAGE_BYTES))


def zeros(data: bytearray, chance: random.Random) -> None:
    page = _page(data, chance)
    data[page] = bytes(page.stop - page.start)


def noise(data: bytearray, chance: random.Random) -> None:
    page = _page(data, chance)
    data[page] = chance.randbytes(page.stop - page.start)


def exchanged(data: bytearray, chance: random.Random) -> None:
    source = _page(data, chance)
    target = _page(data, chance)
    data[target] = data[source][: target.stop - target.start]


def spliced(data: bytearray, chance: random.Random) -> None:
    start = chance.randrange(len(data))
    data[start : start + chance.choice((0, 1, 4, 40))] = chance.choice(PIECES)


def cut(data: bytearray, chance: random.Random) -> None:
    del data[chance.randrange(len(data)) :]


def emptied(data: bytearray, _: random.Random) -> None:
    data.clear()


PIECES = (
    b"", b"\0", b"\n", b"\t", b" ", b"#", b",", b"..", b'"', b"[" * 3000, b"{", b"=", b"9" * 30,
    b"1e999", b"nan", b"\xff\xfe", b"\xe2\x80\xa8", b"\x1b[31m", b"a" * 300, b"../" * 20,
)  # fmt: skip
"""What readers of text and numbers may not expect."""

HARMS: tuple[Harm, ...] = (bits, header, zeros, noise, exchanged, spliced, cut, emptied)


def damage(
    path: Path,
    chance: random.Random,
    harms: Sequence[Harm] = HARMS,
    others: Sequence[Path] = (),
) -> str:
    """Damage a file, or give it the content of another one; return what was done.

    Its times stay as they were half of the times: disks fail, too.
    """
    stat = path.stat()
    data = bytearray(path.read_bytes())
    before = bytes(data)
    done = ""
    while data == before:
        if others and chance.randrange(len(harms) + 1) == 0:
            other = chance.choice(
                [other for other in others if other.name != path.name]
            )
            data = bytearray(other.read_bytes())
            done = f"content of {other.name}"
        else:
            harm = chance.choice(harms)
            harm(data, chance)
            done = harm.__name__
    path.write_bytes(data)
    if keeps_times := chance.random() < 0.5:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return f"{path.name}: {done}{', times kept' if keeps_times else ''}"


Statement = str | tuple[str, list[object]]
"""What SQLite is to do; perhaps with the values of its question marks."""


def execute(path: Path, *statements: Statement) -> None:
    """Execute statements on a database."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        for statement in statements:
            query, values = (statement, []) if isinstance(statement, str) else statement
            connection.execute(query, values)
        connection.commit()
