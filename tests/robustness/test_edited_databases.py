"""The database of a finished run that others change: mended from the stores, or kept and said."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import Call, on_photographs
from damaged import Harm, cut, damage, execute, noise
from results import database_content, model_names, results
from small_scene import write_photographs

from colmap_affrect.cli import main
from colmap_affrect.colmap.database import image_ids, open_database
from colmap_affrect.project.workspace import Workspace

FIRST_PAIR = "pair_id = (SELECT min(pair_id) FROM matches)"
RENAMED = "UPDATE images SET name = 'x.png' WHERE image_id = 1"
MENDED = {
    "image renamed": (RENAMED, "1 changed (x.png)"),
    "image added": ("INSERT INTO images (name, camera_id) VALUES ('x', 1)", "1 added (x)"),
    "keypoints zero": (
        "UPDATE keypoints SET data = zeroblob(length(data)) WHERE image_id = 2",
        "keypoints: 1 changed (b c.png)",
    ),
    "camera of another size": ("UPDATE cameras SET width = 100", "cameras: 3 changed"),
    "camera of no size": ("UPDATE cameras SET width = 'wide'", "(damaged (invalid"),
    "other geometry": (
        f"UPDATE two_view_geometries SET F = zeroblob(72) WHERE {FIRST_PAIR}",
        "geometries: 1 changed",
    ),
    "table dropped": ("DROP TABLE frames", "no such table: frames"),
    "trigger": (
        "CREATE TRIGGER t AFTER INSERT ON matches BEGIN DELETE FROM images; END",
        "its tables are others",
    ),
}
"""What is done, and what is said of it."""


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


@pytest.mark.parametrize("case", MENDED)
def test_what_the_stores_hold_is_made_again(
    finished: Path, out: Path, again: Again, case: str
) -> None:
    statement, said = MENDED[case]
    execute(out / "database.db", statement)
    (warning,) = again("run")
    assert warning.startswith(f"WARNING: {out / 'database.db'}: was changed since the last run")
    assert said in warning
    assert results(out) == results(finished / "out")
    assert again("map") == []


@pytest.mark.parametrize("harm", [noise, cut])
def test_damaged_files_are_made_again(finished: Path, out: Path, again: Again, harm: Harm) -> None:
    damage(out / "database.db", random.Random(3), [harm])
    again("map")
    assert results(out) == results(finished / "out")


def test_missing_and_exchanged_databases_are_made_again(
    finished: Path, out: Path, again: Again
) -> None:
    (out / "database.db").unlink()
    assert "it is missing" in again("map")[0]
    assert results(out) == results(finished / "out")
    (out / "database.db").unlink()
    assert image_ids(out / "database.db") == {}  # which makes it
    assert "images: 3 gone" in again("run")[0]
    assert not image_ids(out / "database.changed.db")
    assert results(out) == results(finished / "out")


@pytest.mark.parametrize("table", ["matches", "two_view_geometries"])
def test_deleted_pairs_stay_deleted(finished: Path, out: Path, again: Again, table: str) -> None:
    execute(out / "database.db", f"DELETE FROM {table} WHERE {FIRST_PAIR}")
    (warning,) = again("run")
    assert "which is kept: 1 pair deleted (a.png - b c.png)" in warning
    execute(out / "database.db", RENAMED)  # all is made again
    for command in ("map", "escalate", "guide", "run"):
        again(command)
        found = database_content(out / "database.db")
        assert len(found["raw matches"]) == len(found["inliers"]) == 2
    again("pairs")
    (out / "pairs.deleted.txt").unlink()
    again("run")
    assert results(out) == results(finished / "out")


def test_priors_and_cameras_of_others_are_kept(out: Path, again: Again) -> None:
    path = out / "database.db"
    execute(path, "INSERT INTO pose_priors SELECT 1, 1, 1, 0, zeroblob(24), zeroblob(72), NULL, 0")
    with open_database(path) as database:
        camera = database.read_all_cameras()[0]
        camera.params = camera.params * 1.02
        database.update_camera(camera)
    (warning,) = again("map")
    assert "which is kept: pose priors, intrinsics of cameras 1" in warning
    assert again("run") == []
    with open_database(path) as database:
        assert database.read_camera(camera.camera_id).params.tolist() == camera.params.tolist()
        assert len(database.read_all_pose_priors()) == 1


def test_pairs_of_other_programs_are_kept(finished: Path, tmp_path: Path, call: Call) -> None:
    arguments = on_photographs(finished / "photos", tmp_path / "out")
    assert call("extract", "-q", *arguments).code == 0
    with open_database(tmp_path / "out" / "database.db") as database:
        database.write_matches(1, 2, np.array([[0, 1], [1, 0]], np.uint32))
    assert "which is kept: 1 pair more" in call("extract", *arguments).stderr[0]
    with open_database(tmp_path / "out" / "database.db") as database:
        assert database.read_matches(1, 2).tolist() == [[0, 1], [1, 0]]


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
    changes: list[tuple[str, list[object]]] = [
        (RENAMED, []),
        ("UPDATE keypoints SET data = zeroblob(length(data))", ["--from-database", original]),
    ]
    for statement, given in changes:
        execute(workspace.database, statement)
        ended = call("map", *given, *paths)
        assert ended.code == 0
        assert f"is made again from {original}" in ended.stderr[0]
        assert content() == before
    original.unlink()
    execute(workspace.database, RENAMED)
    ended = call("map", *paths)
    assert (ended.code, len(ended.stderr)) == (1, 1)
    assert f"and {original} is gone" in ended.errors[0]
