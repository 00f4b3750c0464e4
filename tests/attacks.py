"""Attacks: commands in processes that can be ended, damage to files, and what is there then."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import random
import runpy
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from command import Ended

HANGING_S = 30.0
PAGE_BYTES = 4096

PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload([
    "colmap_affrect.cli.commands", "colmap_affrect.doctor", "colmap_affrect.evaluation.evaluate",
    "colmap_affrect.interop.align", "colmap_affrect.interop.export", "colmap_affrect.interop.hdf5",
    "colmap_affrect.pipeline", "colmap_affrect.comparison.compare", "colmap_affrect.mappers.sparse",
    "colmap_affrect.report.run_page", "torch", "kornia", "matplotlib.pyplot",
])  # fmt: skip


def _be_the_command(arguments: Sequence[str], said: Path, variables: Mapping[str, str]) -> None:
    """Turn this process into the command line, and end it."""
    os.setsid()
    os.environ.update(variables)
    os.fsync = lambda _: None
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, name in enumerate(("out", "err"), 1):
        os.dup2(os.open(said / name, os.O_CREAT | os.O_WRONLY), number)
    sys.argv = ["colmap-affrect", *arguments]
    (said / "begun").touch()
    runpy.run_module("colmap_affrect", run_name="__main__", alter_sys=True)


class Command:
    """The command line at work in a process and a group of its own.

    The process is forked from one that has all modules; a ``fresh`` one starts from nothing, as
    for a user.
    """

    def __init__(self, *arguments: object, fresh: bool = False, **variables: str) -> None:
        self.words = [str(argument) for argument in arguments]
        self.said = Path(tempfile.mkdtemp(prefix="said-"))
        self.fresh: subprocess.Popen[bytes] | None = None
        if fresh:
            with (self.said / "out").open("wb") as out, (self.said / "err").open("wb") as err:
                self.fresh = subprocess.Popen(
                    [sys.executable, "-m", "colmap_affrect", *self.words],
                    stdout=out, stderr=err, start_new_session=True,
                    preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
                )  # fmt: skip
            return
        arguments = (self.words, self.said, variables)
        self.forked = PROCESSES.Process(target=_be_the_command, args=arguments)
        self.forked.start()
        while not (self.said / "begun").exists() and self.forked.is_alive():
            time.sleep(0.001)

    def send(self, number: signal.Signals) -> None:
        """Send a signal: Ctrl-C to the whole group, as terminals do, others to the process."""
        process_id = (self.fresh or self.forked).pid or 0
        with suppress(ProcessLookupError):
            (os.killpg if number == signal.SIGINT else os.kill)(process_id, number)

    def _code(self, timeout_s: float) -> int | None:
        if self.fresh:
            with suppress(subprocess.TimeoutExpired):
                return self.fresh.wait(timeout_s)
            return None
        self.forked.join(timeout_s)
        return self.forked.exitcode

    def ended(self, timeout_s: float = HANGING_S) -> Ended:
        """Wait for the end; a command that does not come to one is killed, and the test fails."""
        if (code := self._code(timeout_s)) is None:
            self.send(signal.SIGKILL)
            self._code(HANGING_S)
        text = [(self.said / name).read_text(errors="replace") for name in ("out", "err")]
        shutil.rmtree(self.said)
        assert code is not None, f"no end after {timeout_s:g} s: {self.words} {text[1][-500:]}"
        return Ended(code, text[0], text[1].splitlines())


def ended(*arguments: object, **variables: str) -> Ended:
    """Run a command to its end."""
    return Command(*arguments, **variables).ended()


def assert_no_traceback(end: Ended) -> None:
    """Nobody sees where in the program something went wrong."""
    lines = [*end.stdout.splitlines(), *end.stderr]
    assert not any("Traceback" in line for line in lines), f"traceback: {lines[-1]}"


def assert_clear(end: Ended, *codes: int) -> None:
    """No traceback, one of these exit codes, and one line that says why if it is not 0."""
    assert_no_traceback(end)
    assert end.code in codes, end
    if end.code:
        assert len(end.errors) == len(end.stderr) == 1, end
    else:
        assert not end.errors, end


def tell(text: str) -> None:
    """Say what a trial does; pytest shows it when the trial fails."""
    sys.stdout.write(f"{text}\n")


def tree(folder: Path, *without: Path, times: bool = True) -> dict[str, tuple[object, ...]]:
    """What is in a folder, by its path there: files by digest and time; links are not followed."""
    found: dict[str, tuple[object, ...]] = {}
    for path in folder.rglob("*"):
        if any(path.is_relative_to(other) for other in without):
            continue
        key = str(path.relative_to(folder))
        if path.is_symlink():
            found[key] = ("link", str(path.readlink()))
        elif path.is_file():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            found[key] = (digest, path.stat().st_mtime_ns) if times else (digest,)
        else:
            found[key] = ("folder",)
    return found


def differences(before: Mapping[str, object], after: Mapping[str, object]) -> list[str]:
    """What was made, changed or removed between two looks at a folder."""
    keys = before.keys() | after.keys()
    told = {(False, True): "made", (True, False): "removed", (True, True): "changed"}
    return sorted(
        f"{told[key in before, key in after]} {key!r}"
        for key in keys
        if before.get(key) != after.get(key)
    )


# Damage to the bytes of a file; each returns what it did.


def bits(data: bytearray, chance: random.Random) -> str:
    places = [chance.randrange(len(data)) for _ in range(chance.choice((1, 4, 32)))]
    for place in places:
        data[place] ^= 1 << chance.randrange(8)
    return f"bits flipped in {len(places)} bytes, the first at {places[0]}"


def _page(data: bytearray, chance: random.Random) -> slice:
    start = chance.randrange(-(-len(data) // PAGE_BYTES)) * PAGE_BYTES
    return slice(start, min(len(data), start + PAGE_BYTES))


def zeros(data: bytearray, chance: random.Random) -> str:
    page = _page(data, chance)
    data[page] = bytes(page.stop - page.start)
    return f"page at {page.start} zeroed"


def noise(data: bytearray, chance: random.Random) -> str:
    page = _page(data, chance)
    data[page] = chance.randbytes(page.stop - page.start)
    return f"page at {page.start} is noise"


def header(data: bytearray, chance: random.Random) -> str:
    place = chance.randrange(min(100, len(data)))
    data[place] ^= chance.randrange(1, 256)
    return f"header changed at {place}"


def exchanged(data: bytearray, chance: random.Random) -> str:
    source, target = _page(data, chance), _page(data, chance)
    data[target] = data[source][: target.stop - target.start]
    return f"page at {source.start} written over that at {target.start}"


def cut(data: bytearray, chance: random.Random) -> str:
    del data[chance.randrange(len(data)) :]
    return f"cut off at {len(data)}"


def emptied(data: bytearray, _: random.Random) -> str:
    data.clear()
    return "emptied"


def random_bytes(data: bytearray, chance: random.Random) -> str:
    data[:] = chance.randbytes(len(data))
    return "all bytes random"


HARMS: tuple[Callable[[bytearray, random.Random], str], ...] = (
    bits, zeros, noise, header, exchanged, cut, emptied, random_bytes,
)  # fmt: skip


def damage(
    path: Path, chance: random.Random, harms: Sequence[Any] = HARMS, others: Sequence[Path] = ()
) -> str:
    """Damage a file, or give it the content of another one; return what was done.

    Its times stay as they were half of the times: disks fail, too.
    """
    stat, data = path.stat(), bytearray(path.read_bytes())
    before = bytes(data)
    while data == before:
        if others and chance.randrange(len(harms) + 1) == 0:
            other = chance.choice([other for other in others if other.name != path.name])
            data, done = bytearray(other.read_bytes()), f"content of {other.name}"
        else:
            done = chance.choice(harms)(data, chance)
    path.write_bytes(data)
    if keeps_times := chance.random() < 0.5:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return f"{path.name}: {done}{', times kept' if keeps_times else ''}"


STATEMENTS = (
    "UPDATE images SET camera_id = 999 WHERE image_id = {id}",
    "UPDATE images SET name = '' WHERE image_id = {id}",
    "UPDATE images SET name = x'ff00fe' WHERE image_id = {id}",
    "UPDATE images SET name = 'renamed.png' WHERE image_id = {id}",
    "DELETE FROM images WHERE image_id = {id}",
    "INSERT INTO images (name, camera_id) VALUES ('more.png', 1)",
    "UPDATE keypoints SET rows = 100000 WHERE image_id = {id}",
    "UPDATE keypoints SET rows = -1 WHERE image_id = {id}",
    "UPDATE keypoints SET data = zeroblob(length(data)) WHERE image_id = {id}",
    "UPDATE keypoints SET data = substr(data, 1, 101) WHERE image_id = {id}",
    "UPDATE keypoints SET data = NULL WHERE image_id = {id}",
    "DELETE FROM keypoints WHERE image_id = {id}",
    "UPDATE matches SET rows = 100000",
    "UPDATE matches SET data = x'ffffffffffffffff', rows = 1",
    "UPDATE two_view_geometries SET config = 77",
    "UPDATE two_view_geometries SET qvec = zeroblob(32)",
    "UPDATE two_view_geometries SET data = x'ffffffffffffffff', rows = 1",
    "DELETE FROM two_view_geometries",
    "UPDATE cameras SET width = 100",
    "UPDATE cameras SET params = x'00'",
    "UPDATE frames SET rig_id = 99",
    "DELETE FROM rigs",
    "DELETE FROM cameras",
    "DROP TABLE frame_data",
    "DROP TABLE two_view_geometries",
    "ALTER TABLE images RENAME COLUMN camera_id TO camera",
    "CREATE TRIGGER nosy AFTER INSERT ON matches BEGIN DELETE FROM images; END",
    "PRAGMA user_version = 2147483647",
)
"""What nobody means to do to the rows of a database; ``{id}`` is one of the images."""

MEANT = (
    "DELETE FROM two_view_geometries WHERE pair_id = (SELECT min(pair_id) FROM matches)",
    "DELETE FROM matches WHERE pair_id = (SELECT min(pair_id) FROM matches)",
    "INSERT INTO pose_priors SELECT 1, data_id, sensor_id, sensor_type, "
    "x'000000000000F03F000000000000F03F000000000000F03F', NULL, NULL, 1 FROM frame_data LIMIT 1",
    "UPDATE cameras SET params = "
    "x'00000000008072400000000000C0724000000000000064400000000000005E40' WHERE camera_id = 1",
)
"""Edits that a user may mean; the second takes the matches of a pair and leaves its geometry."""

PROBES = (
    "SELECT image_id, name, camera_id FROM images ORDER BY name",
    "SELECT * FROM cameras ORDER BY camera_id",
    "SELECT count(*), total(length(data)), total(rows) FROM keypoints",
    "SELECT pair_id, rows FROM matches ORDER BY pair_id",
    "SELECT pair_id, rows, config FROM two_view_geometries ORDER BY pair_id",
    "SELECT * FROM pose_priors",
    "SELECT * FROM frames ORDER BY frame_id",
    "SELECT count(*) FROM rigs",
    "SELECT type, name FROM sqlite_master ORDER BY type, name",
    "PRAGMA user_version",
)


def execute(path: Path, statement: str) -> None:
    """Execute a statement on a database."""
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute(statement)
        connection.commit()


def rows(path: Path) -> dict[str, list[Any]]:
    """What a database answers to the probes."""
    with closing(sqlite3.connect(path)) as connection:
        return {probe: connection.execute(probe).fetchall() for probe in PROBES}
