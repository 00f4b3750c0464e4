"""Campaign (tests/campaign.py): damaged files, of our own and of other programs."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import sys
from pathlib import Path
from typing import Any

import pytest
from campaign import CAMPAIGN, TIMES, Words, assert_clear, run_words
from command import CAMERA, Call, run_in_process_of_its_own
from damaged import damage
from results import database_content, differences, results, tree

pytestmark = CAMPAIGN

FILES = (
    "features.h5", "matches.h5", "guided.h5", "database.db", "pairs.txt", "config.toml",
    "cameras.json", "report.json", "report.html", "run.log",
    "sparse/0/cameras.bin", "sparse/0/rigs.bin", "sparse/0/frames.bin",
    "sparse/0/images.bin", "sparse/0/points3D.bin", "sparse/0/summary.json",
)  # fmt: skip
READERS = ("run", "map", "export", "align", "doctor")


def reader(name: str, scene: Path, out: Path) -> Words:
    """Arguments of a command that reads an output folder; results of some are beside it."""
    model = [
        "--model-path",
        out / "sparse" / "0",
        "--output-path",
        out.with_name("target"),
        "-q",
    ]
    return {
        "run": run_words(scene, out),
        "map": ["map", "-q", "--output-path", out],
        "export": ["export", *model, "--format", "ply,text,cameras,undistorted"],
        "align": ["align", *model, "--distance", "b-c.png,side/d.png,2.0"],
        "doctor": ["doctor", "-q", out],
    }[name]


def outcome(name: str, out: Path) -> dict[str, Any]:
    """What a command makes, or goes on with: that has to be right."""
    if name in ("export", "align"):
        return tree(out.with_name("target"), times=False)
    if name == "doctor":
        return {}
    models = {
        key: value
        for key, value in tree(out, times=False).items()
        if key.endswith(".bin")
    }
    if name == "map":
        return database_content(out / "database.db") | models
    kept = {"features", "matches"}  # what an idle run does not read; doctor does
    return {
        key: value for key, value in results(out).items() if key not in kept
    } | models


@pytest.fixture(scope="session")
def expected(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What each command leaves when nothing is damaged."""
    found: dict[str, Any] = {}
    for name in READERS:
        out = tmp_path_factory.mktemp(name) / "out"
        shutil.copytree(scene / "out", out)
        assert_clear(run_in_process_of_its_own(*reader(name, scene, out)), 0)
        found[name] = outcome(name, out)
    return found


@pytest.mark.parametrize("number", range(150 * TIMES))
def test_damaged_file_is_mended_or_named(
    scene: Path, expected: dict[str, Any], tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"damage {number}")
    name = FILES[number % len(FILES)]
    command = chance.choice(READERS)
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    done = damage(out / name, chance, others=[scene / "out" / other for other in FILES])
    before = tree(out)
    end = call(*reader(command, scene, out))
    sys.stdout.write(
        f"{done}; then {command}: {end.stderr}\n"
    )  # shown when the test fails
    if command == "doctor":  # which prints what it finds
        assert end.code in (0, 1), end
        assert differences(before, tree(out)) == []
        return
    assert_clear(end, 0, 1, 2)
    if end.code == 0:
        try:
            found = outcome(command, out)
        except (OSError, RuntimeError, ValueError, KeyError, sqlite3.Error) as error:
            raise AssertionError(
                f"success with a result that cannot be read: {error}"
            ) from error
        wrong = differences(expected[command], found)
        assert not wrong, f"success with a wrong result: {wrong}"
    elif command == "run":
        doctor = call("doctor", "-q", out)
        assert doctor.code == 1, doctor
        assert Path(name).name in doctor.stdout, doctor


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize(
    "name", [*FILES, "features.h5.journal", "database.db.seal", ".lock"]
)
def test_pipe_in_the_place_of_a_file_is_named_at_once(
    scene: Path, tmp_path: Path, call: Call, name: str
) -> None:
    for command in READERS:
        out = Path(shutil.copytree(scene / "out", tmp_path / command / "out"))
        (out / name).unlink(missing_ok=True)
        os.mkfifo(out / name)
        end = call(*reader(command, scene, out))
        assert "Traceback" not in end.stdout + "".join(end.stderr), (command, end)
        assert end.code in (0, 1, 2), (command, end)
        assert command == "doctor" or len(end.errors) == bool(end.code), (command, end)


GIVEN = ("features.h5", "matches.h5", "matches.txt", "pairs.txt")


@pytest.mark.parametrize("number", range(40 * TIMES))
def test_damaged_file_of_another_program_is_refused_or_read(
    scene: Path, tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"given {number}")
    shutil.copy(scene / "described.h5", tmp_path / "features.h5")
    shutil.copy(scene / "matches.h5", tmp_path / "matches.h5")
    lines = ["a.png side/č.png", *(f"{row} {row}" for row in range(40)), ""]
    (tmp_path / "matches.txt").write_text("\n".join(lines), encoding="utf-8")
    (tmp_path / "pairs.txt").write_text("a.png b-c.png 0.5\n", encoding="utf-8")
    name = GIVEN[number % len(GIVEN)]
    done = damage(tmp_path / name, chance, others=[tmp_path / other for other in GIVEN])
    how = {
        "matches.h5": ["--matches-path", tmp_path / name],
        "matches.txt": ["--matches-path", tmp_path / name, "--match-type", "inliers"],
        "pairs.txt": ["--match-list-path", tmp_path / name],
        "features.h5": [],
    }[name]
    files = [
        "--features-path",
        tmp_path / "features.h5",
        "--image-path",
        scene / "photos",
    ]
    before = tree(tmp_path)
    new = tmp_path / "new.db"
    end = call("import-h5", "-q", *files, *how, *CAMERA, "--database-path", new)
    sys.stdout.write(f"{done}: {end.stderr}\n")  # shown when the test fails
    assert_clear(end, 0, 1, 2)
    if end.code == 0:
        assert call("doctor", "-q", new).code == 0
        new.unlink()
    assert differences(before, tree(tmp_path)) == []
