"""A campaign of attacks on the command line: nothing of the user's is ever harmed.

    pytest -m long --dist load tests/robustness/test_campaign.py
    CAMPAIGN=10 pytest -m long --dist load tests/robustness/test_campaign.py

The second line makes ten times as many trials by chance. Each trial has a number, which seeds it,
stands alone, and says what it did when it fails. Moments depend on how fast the machine is. Kills
at system calls and full disks: tests/benchmarks/campaign.py.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from attacks import (
    TRAPS,
    Command,
    Scene,
    assert_clear,
    assert_no_traceback,
    assert_whole,
    differences,
    empty_folder,
    ended,
    exports,
    finished,
    folder_commands,
    foreign_folder,
    is_temporary,
    make_scene,
    make_world,
    placed,
    rename_image,
    tell,
    tree,
)
from command import Ended
from damaged import damage
from results import database_content, results

pytestmark = pytest.mark.long

TIMES = int(os.environ.get("CAMPAIGN", "1"))
INTERRUPTED = "interrupted; run the same command again to go on"
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGKILL: -signal.SIGKILL}


def trials(count: int) -> pytest.MarkDecorator:
    """Parametrize a test with the numbers of its trials."""
    return pytest.mark.parametrize("number", range(count * TIMES))


@pytest.fixture(scope="session")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return make_scene(photos, tmp_path_factory.mktemp("scene"))


# Part 1: names and links that lead astray.

NAMES = (
    "{photos}/b c.png", "{world}/elsewhere/new.png", "//{photos}/b c.png", "../../x.png",
    "../photos/b c.png", "../../../photos/b c.png", "side/../../../../../photos/x.png", "x.png",
    "side/../b c.png", "x.png/..", "..", ".", "side//x.png", "side/", "C:\\x.png",
    "\\\\server\\share\\x.png", "..\\..\\x.png", "x.png ", "\u202egnp.x", "side/c\u030c.png",
    "line\nbreak.png", "\x1b[31mred\x7f.png", "ž" * 148 + ".png", "~/x.png", "-rf.png",
    "/".join(["deep" * 12] * 20) + "/x.png", "dense/images/x.png", "sparse/0/cameras.bin", "",
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


# Part 2: exports that are interrupted, with something of the user in their folder.

ALL_FORMATS = "ply,text,cameras,bundler,nerfstudio,geojson of lens"
WRITERS = (ALL_FORMATS, "align", "export-h5", "export-database", "convert")
MINE = {"mine.txt": ("file",), "mine": ("folder",), "mine/report.html": ("file",)}


def plant(out: Path) -> bool:
    """Put a file and a folder of the user into an output folder, if it is there."""
    with suppress(FileNotFoundError):
        (out / "mine.txt").write_text("mine")
        (out / "mine").mkdir()
        (out / "mine" / "report.html").write_text("mine")
    return (out / "mine").exists()


def left(out: Path, is_planted: bool) -> dict[str, Any]:
    """What is in a folder beside the files of the user, which have to be there."""
    found = tree(out, times=False)
    for name in ("mine.txt", "mine/report.html") if is_planted else ():
        assert (out / name).exists(), f"{name} was removed"
        assert (out / name).read_text() == "mine", f"{name} was changed"
    return {key: value for key, value in found.items() if key not in MINE}


def assert_final_is_whole(found: Mapping[str, Any], expected: Mapping[str, Any]) -> None:
    """Whatever stands under a final name is that of the undisturbed command, and all of it."""
    tops = {key.split("/")[0] for key in found}
    for key in found.keys() | {key for key in expected if key.split("/")[0] in tops}:
        assert key in expected, f"{key} is not of the undisturbed command"
        assert key in found, f"{key} is missing under a final name"
        assert found[key] == expected[key], f"{key} is not whole"


def assert_ended_by(end: Ended, number: signal.Signals) -> None:
    """Exit code and one line, or the command was done before the signal came."""
    assert_no_traceback(end)
    assert end.code in (0, CODES[number]), end
    if end.code in (130, 143):
        assert len(end.stderr) == 1, end
        assert number == signal.SIGTERM or end.stderr == [INTERRUPTED], end


@trials(40)
def test_interrupted_export_takes_away_its_own_only(
    scene: Scene, tmp_path: Path, number: int
) -> None:
    chance, label = random.Random(f"interrupt {number}"), WRITERS[number % len(WRITERS)]
    sent = chance.choice(list(CODES))
    expected, seconds = scene.ended(label, tmp_path / "undisturbed")
    out = tmp_path / "out"
    if is_there := label in ("export-h5", "export-database") or chance.random() < 0.6:
        out.mkdir()
    moments = sorted(chance.uniform(0.01, 1.1 * seconds) for _ in range(2))
    command = Command(*placed(exports(scene.folder)[label][0], out))
    time.sleep(moments[0])
    is_planted = plant(out)
    time.sleep(moments[1] - moments[0])
    command.send(sent)
    end = command.ended()
    tell(f"{label}, {sent.name} at {moments[1]:.3f} of {seconds:.3f} s, planted: {is_planted}")
    if is_planted and end.errors:  # it saw them before it began
        assert_clear(end, 1, 2)
    else:
        assert_ended_by(end, sent)
    found = left(out, is_planted)
    if label == "convert":  # whose pictures are results of their own
        assert finished(found).items() <= expected.items()
    else:
        assert_final_is_whole(finished(found), finished(expected))
    assert {path.name for path in tmp_path.iterdir() if not is_temporary(path.name)} <= {"out"}
    is_whole = finished(found) == finished(expected)  # the signal came when all was done
    if end.code in (130, 143) and label != "convert" and not is_whole:
        assert not found, f"left over: {sorted(found)}"
        assert out.exists() == (is_there or is_planted), "the output folder is left over"
        assert {path.name for path in tmp_path.iterdir()} <= {"out"}
    assert_goes_on(scene, label, out, is_planted)


def assert_goes_on(scene: Scene, label: str, out: Path, is_planted: bool) -> None:
    """The same command again works, or refuses what is whole already, or what is the user's."""
    expected = finished(scene.undisturbed[label][0])
    before = finished(left(out, is_planted))
    if label in ("export-h5", "export-database"):
        out.mkdir(exist_ok=True)
    again = ended(*placed(exports(scene.folder)[label][0], out))
    assert_clear(again, 0, 1, 2)
    found = finished(left(out, is_planted))
    if again.code == 0:
        assert found == expected, differences(expected, found)
    elif is_planted and not before:
        assert not found, found
        shutil.rmtree(out / "mine")
        (out / "mine.txt").unlink()
        assert_goes_on(scene, label, out, is_planted=False)
    else:
        assert before, f"refused, and nothing is there: {again.errors}"
        assert found == before, differences(before, found)


# Part 3: damaged files.

FILES = (
    "features.h5", "matches.h5", "guided.h5", "database.db", "pairs.txt", "config.toml",
    "cameras.json", "report.json", "report.html", "run.log",
    "sparse/inputs.sha256", "sparse/0/cameras.bin", "sparse/0/rigs.bin", "sparse/0/frames.bin",
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
    return results(out) | models


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


# Part 4: folders that are not ours.

FOLDERS = ("report", "notes", "database", "photographs", "above the photographs")
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
