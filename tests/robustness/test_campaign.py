"""A campaign of attacks on the command line: nothing of the user's is ever harmed.

    pytest -m long --dist load tests/robustness/test_campaign.py
    CAMPAIGN=10 pytest -m long --dist load tests/robustness/test_campaign.py

The second line makes ten times as many trials by chance. Each trial has a number, which seeds it,
stands alone, and says what it did when it fails. Kills
at system calls and full disks: tests/benchmarks/campaign.py.
"""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from attacks import (
    TRAPS,
    Scene,
    assert_clear,
    assert_no_traceback,
    assert_whole,
    differences,
    empty_folder,
    ended,
    exports,
    folder_commands,
    foreign_folder,
    make_scene,
    make_world,
    placed,
    rename_image,
    tell,
    tree,
)
from damaged import damage
from results import database_content, results

pytestmark = pytest.mark.long

TIMES = int(os.environ.get("CAMPAIGN", "1"))


def trials(count: int) -> pytest.MarkDecorator:
    """Parametrize a test with the numbers of its trials."""
    return pytest.mark.parametrize("number", range(count * TIMES))


@pytest.fixture(scope="session")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(photos, tmp_path_factory.mktemp("scene"))


# Part 1: names and links that lead astray.

NAMES = (
    "{photos}/b c.png", "{world}/elsewhere/new.png", "../../../photos/b c.png",
    "side/../../../../../photos/x.png", "x.png", "x.png/..", "..", "C:\\x.png", "..\\..\\x.png",
    "\u202egnp.x", "line\nbreak.png", "~/x.png", "-rf.png", "/".join(["deep" * 12] * 20) + "/x.png",
    "dense/images/x.png", "sparse/0/cameras.bin", "",
)  # fmt: skip
"""Of an image in the place of a.png; x.png is harmless. A photograph is where a name leads."""


def attack_exports(
    base: Path, photograph: str, prepare: Callable[[Path, str], list[Path]], *codes: int
) -> list[str]:
    """Call all exports, each into a folder that is prepared; return what went wrong.

    ``prepare`` gets the folder and the name of a result, and returns what may be changed.
    """
    world, wrong = base.parents[2], []
    for label, (arguments, result) in exports(base, photograph).items():
        out = base / "outputs" / label.replace(",", " ")
        allowed = prepare(out, result)
        before = tree(world, *allowed)
        try:
            end = ended(*placed(arguments, out), HOME=str(world / "home"))
            harmed = differences(before, tree(world, *allowed))
            assert not harmed, f"{harmed}, exit code {end.code}"
            assert_clear(end, *codes, *((2,) if "nvm" in label else ()))  # spaces in other names
            if end.code == 0 and out in allowed:
                assert_whole(label, out)
        except AssertionError as error:
            wrong.append(f"{label}: {str(error)[:600]}")
    return wrong


@pytest.mark.parametrize("name", NAMES, ids=lambda name: ascii(name)[1:-1][:24])
def test_names_of_images_lead_nowhere_else(scene: Scene, tmp_path: Path, name: str) -> None:
    base = make_world(scene, tmp_path)
    name = name.format(photos=base / "photos", world=base.parents[2])
    rename_image(base, name)
    photograph = "b c.png"
    with suppress(OSError):
        photograph = name if (base / "photos" / name).is_file() else photograph
    codes = (0,) if name == "x.png" else (0, 1, 2)
    wrong = attack_exports(base, photograph, empty_folder, *codes)
    assert not wrong, "\n".join([f"image named {name!r}", *wrong])


@pytest.mark.parametrize("trap", TRAPS)
def test_links_in_output_folders_are_not_followed(scene: Scene, tmp_path: Path, trap: str) -> None:
    base = make_world(scene, tmp_path)
    wrong = attack_exports(base, "a.png", TRAPS[trap], 0, 1, 2)
    assert not wrong, "\n".join([trap, *wrong])


# Part 2: damaged files.

FILES = (
    "features.h5", "matches.h5", "guided.h5", "database.db", "pairs.txt", "config.toml",
    "cameras.json", "report.json", "report.html", "run.log",
    "sparse/0/cameras.bin", "sparse/0/rigs.bin", "sparse/0/frames.bin",
    "sparse/0/images.bin", "sparse/0/points3D.bin", "sparse/0/summary.json",
)  # fmt: skip
READERS = ("run", "map", "export", "align", "doctor")
WRITTEN = ["--format", "ply,text,cameras,bundler,undistorted"]


def reader(name: str, scene: Scene, out: Path, target: Path) -> list[object]:
    """Arguments of a command that reads an output folder."""
    model = ["--model-path", out / "sparse" / "0", "--output-path", target, "-q"]
    return {
        "run": scene.run(out),
        "map": ["map", "-q", "--output-path", out],
        "export": ["export", *model, *WRITTEN],
        "align": ["align", *model, "--distance", "b c.png,side/d.png,2.0"],
        "doctor": ["doctor", "-q", out],
    }[name]


@pytest.fixture(scope="session")
def expected(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What each command leaves when nothing is damaged."""
    found: dict[str, Any] = {}
    for name in READERS:
        folder = tmp_path_factory.mktemp(name)
        out = scene.copy(folder)
        end = ended(*reader(name, scene, out, folder / "target"))
        assert_clear(end, 0)
        found[name] = outcome(name, out, folder / "target")
    return found


def outcome(name: str, out: Path, target: Path) -> dict[str, Any]:
    """What a command makes, or goes on with: that has to be right."""
    if name in ("export", "align"):
        return tree(target, times=False)
    if name == "doctor":
        return {}
    models = {key: value for key, value in tree(out, times=False).items() if key.endswith(".bin")}
    if name == "map":
        return database_content(out / "database.db") | models
    kept = {"features", "matches"}  # what an idle run does not read; doctor does
    return {key: value for key, value in results(out).items() if key not in kept} | models


def assert_right(name: str, out: Path, target: Path, expected: Mapping[str, Any]) -> None:
    try:
        found = outcome(name, out, target)
    except (OSError, RuntimeError, ValueError, KeyError, sqlite3.Error) as error:
        raise AssertionError(f"success with a result that cannot be read: {error}") from error
    wrong = differences(expected[name], found)
    assert not wrong, f"success with a wrong result: {wrong}"


@trials(150)
def test_damaged_file_is_mended_or_named(
    scene: Scene, expected: dict[str, Any], tmp_path: Path, number: int
) -> None:
    chance = random.Random(f"damage {number}")
    name, command = FILES[number % len(FILES)], chance.choice(READERS)
    out, target = scene.copy(tmp_path), tmp_path / "target"
    done = damage(out / name, chance, others=[scene.out / other for other in FILES])
    tell(f"{done}; then {command}")
    before = tree(out)
    end = ended(*reader(command, scene, out, target))
    if command == "doctor":
        assert_no_traceback(end)
        assert end.code in (0, 1), end
        assert differences(before, tree(out)) == []
        return
    assert_clear(end, 0, 1, 2)
    if end.code == 0:
        assert_right(command, out, target, expected)
    elif command == "run":
        doctor = ended("doctor", "-q", out)
        assert_no_traceback(doctor)
        assert doctor.code == 1, (end.errors, doctor)
        assert Path(name).name in doctor.stdout, (end.errors, doctor)


# Part 3: folders that are not ours.

FOLDERS = ("report", "photographs", "above the photographs")
FILLERS = ("run", "extract", "compare", "evaluate", "inspect", "map", "convert")


@pytest.mark.parametrize("kind", FOLDERS)
@pytest.mark.parametrize("name", FILLERS)
def test_foreign_folder_is_refused(scene: Scene, tmp_path: Path, name: str, kind: str) -> None:
    photos = Path(shutil.copytree(scene.folder / "photos", tmp_path / "photos"))
    out = foreign_folder(kind, tmp_path)
    before = tree(tmp_path)
    end = ended(*folder_commands(scene, photos)[name], "--output-path", out)
    assert not (harmed := differences(before, tree(tmp_path))), (harmed, end.code)
    assert_clear(end, 1, 2)
