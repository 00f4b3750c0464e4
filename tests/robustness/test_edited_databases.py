"""The database of a finished run that others change: made again from the stores, or mapped so."""

from __future__ import annotations

import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest
from command import Call, on_photographs
from damaged import PAGE_BYTES, Harm, cut, damage, execute, noise
from results import database_content, model_names, results
from small_scene import write_photographs

from colmap_affrect.cli import main
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.tables import damage_of, rows_digest
from colmap_affrect.project.outputs import database_files
from colmap_affrect.project.record import stamp_of
from colmap_affrect.project.workspace import Workspace

pytestmark = pytest.mark.long

LAST_PAIR = "pair_id = (SELECT max(pair_id) FROM matches)"
RENAMED = "UPDATE images SET name = 'x.png' WHERE image_id = 1"
Change = Callable[[Path], object]


def sql(statement: str) -> Change:
    return lambda path: execute(path, statement)


def by_chance(harm: Harm) -> Change:
    return lambda path: damage(path, random.Random(3), [harm])


def empty(path: Path) -> None:
    path.unlink()
    assert image_ids(path) == {}  # which makes it


CHANGES: dict[str, Change] = {
    "image renamed": sql(RENAMED),
    "pair deleted": sql(f"DELETE FROM matches WHERE {LAST_PAIR}"),
    "other keypoints": sql("UPDATE keypoints SET data = zeroblob(length(data))"),
    "other geometry": sql(
        f"UPDATE two_view_geometries SET F = zeroblob(72) WHERE {LAST_PAIR}"
    ),
    "other camera": sql("UPDATE cameras SET params = zeroblob(length(params))"),
    "camera of no size": sql("UPDATE cameras SET width = 'wide'"),
    "table dropped": sql("DROP TABLE frames"),
    "trigger": sql(
        "CREATE TRIGGER t AFTER INSERT ON matches BEGIN DELETE FROM images; END"
    ),
    "noise": by_chance(noise),
    "cut": by_chance(cut),
    "missing": Path.unlink,
    "empty": empty,
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three photographs and a run on them."""
    folder = tmp_path_factory.mktemp("edited")
    write_photographs(folder / "photos", 3)
    assert main(["run", "-q", *on_photographs(folder / "photos", folder / "out")]) == 0
    return folder


@pytest.fixture
def out(finished: Path, tmp_path: Path) -> Path:
    """A copy of the output folder, to be changed."""
    return Path(shutil.copytree(finished / "out", tmp_path / "out"))


@pytest.fixture
def again(finished: Path, out: Path, call: Call) -> Callable[[str], list[str]]:
    """Run a command again that must end well; return its warnings."""

    def run_again(command: str) -> list[str]:
        given = on_photographs(finished / "photos", out) if command == "run" else []
        ended = call(command, *(given or ["--output-path", out]))
        assert ended.code == 0, ended.stderr
        return [line for line in ended.stderr if line.startswith("WARNING: ")]

    return run_again


Again = Callable[[str], list[str]]


@pytest.mark.long
@pytest.mark.parametrize("case", CHANGES)
def test_what_the_stores_hold_is_made_again(
    finished: Path, out: Path, again: Again, case: str
) -> None:
    CHANGES[case](out / "database.db")
    (warning,) = again("run")
    why = "was changed since the last run"
    kept = out / "database.changed.db"
    if case == "missing":
        why = "is missing"
        kept = out / "database.db"
    if case in ("noise", "cut"):
        assert "database.db: cannot be used (" in warning
        why = warning.partition("database.db: ")[2].partition("; it is")[0]
    assert (
        f"database.db: {why}; it is made again from features.h5 and matches.h5"
        in warning
    )
    assert kept.exists()
    assert results(out) == results(finished / "out")
    assert again("run") == again("map") == []


def harm(path: Path, name: str) -> None:
    """Fill the first page of an index, or a table, with zeros."""
    with closing(sqlite3.connect(path)) as connection:
        query = "SELECT rootpage FROM sqlite_master WHERE name = ?"
        (number,) = connection.execute(query, (name,)).fetchone()
    data = bytearray(path.read_bytes())
    data[(number - 1) * PAGE_BYTES : number * PAGE_BYTES] = bytes(PAGE_BYTES)
    path.write_bytes(data)


INDICES = (
    "sqlite_autoindex_images_1", "index_name", "rig_ref_sensor_assignment",
    "rig_sensor_assignment", "frame_sensor_assignment", "pose_prior_data_assignment",
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("index", INDICES)
def test_damaged_index_is_found_and_made_again(
    finished: Path, out: Path, again: Again, index: str
) -> None:
    path = out / "database.db"
    before = rows_digest(path)
    harm(path, index)
    assert rows_digest(path) == before  # the rows do not show it
    (warning,) = again("map" if index == "index_name" else "run")
    assert "database.db: cannot be used (damaged" in warning
    assert "made again from features.h5 and matches.h5" in warning
    assert not damage_of(path)
    assert results(out) == results(finished / "out")
    assert again("run") == []


def test_damage_that_came_meanwhile_is_mended_by_the_next_command(
    out: Path, call: Call
) -> None:
    """A file with the stamp of its seal is not looked through: COLMAP stumbles over the damage."""
    path = out / "database.db"
    seal = out / "database.db.seal"
    harm(path, "sqlite_autoindex_images_1")
    harm(path, "two_view_geometries")
    seal.write_text(
        f"{seal.read_text().splitlines()[0]}\n{stamp_of(database_files(path)[:2])}\n"
    )
    first, second = (call("map", "--output-path", out, "--overwrite") for _ in range(2))
    assert (first.code, len(first.errors)) == (1, 1)
    assert str(path) in first.errors[0]
    assert second.code == 0
    assert "it is made again from features.h5" in second.stderr[0]
    assert not damage_of(path)


@pytest.mark.long
@pytest.mark.parametrize("table", ["images", "frame_data", "keypoints"])
def test_map_makes_a_damaged_database_again(
    finished: Path, out: Path, again: Again, table: str
) -> None:
    """What it takes as it is are changes of other programs, which leave it whole."""
    harm(out / "database.db", table)
    (warning,) = again("map")
    assert "database.db: cannot be used (" in warning
    assert database_content(out / "database.db") == database_content(
        finished / "out/database.db"
    )


@pytest.mark.long
def test_database_that_was_touched_or_left_by_a_killed_command_is_used(
    finished: Path, out: Path, again: Again
) -> None:
    for harmless in (
        Path.touch,
        image_ids,
        sql("VACUUM"),
        sql("DELETE FROM descriptors"),
    ):
        harmless(out / "database.db")
        assert again("run") == []
    Workspace(out).seal.unlink()
    assert again("run") == []
    assert results(out) == results(finished / "out")


def test_map_maps_a_changed_database_as_it_is(
    out: Path, again: Again, call: Call
) -> None:
    path = out / "database.db"
    execute(path, f"DELETE FROM two_view_geometries WHERE {LAST_PAIR}", RENAMED)
    changed = database_content(path)
    for _ in range(2):
        (warning,) = again("map")
        assert (
            f"{path}: was changed since the last run, and is mapped as it is" in warning
        )
    assert database_content(path) == changed
    kept = out / "database.changed.db"
    other = ["--output-path", out.with_name("other")]
    assert (
        f"'colmap-affrect map --from-database {kept} --output-path OTHER'"
        in again("verify")[0]
    )
    assert len(database_content(path)["inliers"]) == 3
    assert call("map", "-q", "--from-database", kept, *other).code == 0
    execute(path, "UPDATE matches SET data = zeroblob(1)")
    ended = call("map", "--output-path", out)
    assert (ended.code, len(ended.stderr)) == (1, 1)


@pytest.mark.long
def test_copies_are_made_again_from_the_original(
    finished: Path, tmp_path: Path, call: Call
) -> None:
    original = Path(shutil.copy(finished / "out" / "database.db", tmp_path / "any.db"))
    workspace = Workspace(tmp_path / "copied")

    def content() -> object:
        return database_content(workspace.database), model_names(workspace)

    paths = ["--output-path", workspace.path]
    assert call("map", "-q", "--from-database", original, *paths).code == 0
    before = content()
    execute(workspace.database, RENAMED)
    assert "is mapped as it is" in call("map", *paths).stderr[0]
    ended = call("map", "--from-database", original, *paths)
    assert ended.code == 0
    assert f"it is made again from {original}" in ended.stderr[0]
    assert content() == before
    workspace.database.unlink()
    assert (
        f"is missing; it is made again from {original}" in call("map", *paths).stderr[0]
    )
    assert content() == before
