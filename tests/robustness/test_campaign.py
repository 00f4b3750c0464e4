"""A campaign of attacks on the command line: nothing of the user's is ever harmed.

    pytest -m long --dist load tests/robustness/test_campaign.py
    CAMPAIGN=10 pytest -m long --dist load tests/robustness/test_campaign.py

The second line makes ten times as many trials by chance. Each trial has a number, which seeds it,
stands alone, and says what it did when it fails. Kills and full disks: test_interruption.py.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import pytest
from command import CAMERA, FAST, Call, Ended, run_in_process_of_its_own
from damaged import damage, execute
from posed_photographs import write_extreme_views
from results import database_content, differences, results, tree

from colmap_affrect.colmap import pycolmap
from colmap_affrect.interop.export import FORMATS

pytestmark = pytest.mark.long

TIMES = int(os.environ.get("CAMPAIGN", "1"))
HANGING_S = 60
PLAIN = ["--recipe", "unrectified-rootsift"]
COMPARED = ["--methods", PLAIN[1], "--seeds", "0", *CAMERA]

Words = list[object]


@pytest.fixture(autouse=True)
def _ends_in_time() -> Iterator[None]:
    """End the process of the tests when a command does not come to an end."""
    signal.alarm(HANGING_S)
    yield
    signal.alarm(0)


def run_words(scene: Path, out: Path) -> Words:
    """Arguments of the run of the scene."""
    given = ["--image-path", scene / "photos", "--output-path", out]
    return ["run", "-q", *given, *FAST, "--set", "guided.enabled=always"]


@pytest.fixture(scope="session")
def scene(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the small scene in ``out``, and what commands need beside it.

    These are ``photos``; the model as it is and with a lens that distorts;
    files of hloc; a dataset.
    """
    folder = tmp_path_factory.mktemp("scene")
    shutil.copytree(photos, folder / "photos")
    (folder / "photos" / "b c.png").rename(folder / "photos" / "b-c.png")  # text has no blanks
    files = ["--features-path", folder / "features.h5", "--matches-path", folder / "matches.h5"]
    out = folder / "out"
    for words in (
        run_words(folder, out),
        ["export-h5", "--database-path", out / "database.db", *files],
    ):
        assert run_in_process_of_its_own(*words).code == 0
    shutil.copy(out / "database.db", folder / "any.db")
    shutil.copy(out / "features.h5", folder / "described.h5")
    for name in ("plain", "lens"):
        model = pycolmap.Reconstruction(out / "sparse" / "0")
        for camera in model.cameras.values() if name == "lens" else ():
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [300.0, 160.0, 120.0, 0.05]
        (folder / name).mkdir()
        model.write(folder / name)
    write_extreme_views(folder / "pairs", ["cafe"])
    return folder


def assert_clear(end: Ended, *codes: int) -> None:
    """No traceback, one of these exit codes, and one line that says why if it is not 0."""
    assert "Traceback" not in end.stdout + "".join(end.stderr), end
    assert end.code in codes, end
    assert len(end.errors) == bool(end.code), end
    assert not end.code or len(end.stderr) == 1, end


# Part 1: names and links that lead astray.

NAMES = (
    "{photos}/b-c.png", "{world}/elsewhere/new.png", "../../../photos/b-c.png",
    "side/../../../../../photos/x.png", "x.png", "x.png/..", "..", "C:\\x.png", "..\\..\\x.png",
    "\u202egnp.x", "line\nbreak.png", "~/x.png", "-rf.png", "/".join(["deep" * 12] * 20) + "/x.png",
    "dense/images/x.png", "sparse/0/cameras.bin", "",
)  # fmt: skip
"""Of an image in the place of a.png; x.png is harmless. A photograph is where a name leads."""

RESULTS = {
    "ply": "points3D.ply", "text": "text", "undistorted": "dense", "nerfstudio": "dense",
    "mvsnet": "dense", "cameras": "cameras.csv",
}  # fmt: skip
"""What each format of ``export`` writes."""


def exports(base: Path, photograph: str) -> dict[str, tuple[Words, str]]:
    """All commands that write beside the output folder: arguments, and the name of a result."""
    files = ["--features-path", base / "features.h5", "--matches-path", base / "matches.h5"]
    images = ["--image-path", base / "photos"]
    new_files = ["--features-path", "{out}/features.h5", "--matches-path", "{out}/matches.h5"]
    assert RESULTS.keys() == FORMATS.keys()
    found: dict[str, tuple[Words, str]] = {}
    for form, name in {**RESULTS, "ply,text,cameras,nerfstudio": "text"}.items():
        for model in ("plain", "lens"):
            given = ["--model-path", base / model, *images, "--format", form]
            found[f"{form} of {model}"] = (["export", *given, "--output-path", "{out}"], name)
    distance = ["--distance", "b-c.png,side/d.png,2.0", "--output-path", "{out}/new"]
    source = ["--database-path", base / "any.db"]
    image = base / "photos" / photograph
    listed = ["--image-list-path", base / "list.txt"] if (base / "list.txt").exists() else []
    to = ["--output-path", "{out}"]
    return {
        **found,
        "align": (["align", "--model-path", base / "plain", *distance], "new"),
        "export-h5": (["export-h5", *source, *new_files], "features.h5"),
        "export-database": (["export-database", base / "any.db", "{out}/old.db"], "old.db"),
        "import-h5": (
            ["import-h5", *images, *files, *CAMERA, "--database-path", "{out}/new.db"], "new.db"
        ),
        "import-h5 of descriptors": (
            ["import-h5", *images, "--features-path", base / "described.h5", *CAMERA,
             "--database-path", "{out}/new.db"],
            "new.db",
        ),
        "convert": (["convert", *images, "--output-path", "{out}/converted"], "converted"),
        "inspect": (["inspect", image, *PLAIN, *to], f"{image.stem}-plan.json"),
        "compare": (["compare", *images, *listed, *COMPARED, *to], "report.html"),
    }  # fmt: skip


def make_world(scene: Path, folder: Path) -> Path:
    """Copy what exports read to where a few steps up lead to folders that are watched."""
    base = folder / "world" / "one" / "two" / "three"
    shutil.copytree(scene, base, ignore=shutil.ignore_patterns("out", "pairs"))
    for name in ("one/photos", "photos", "elsewhere", "home"):
        shutil.copytree(base / "photos", folder / "world" / name, dirs_exist_ok=True)
    return base


def rename_image(base: Path, name: str) -> None:
    """Give an image a name in all that exports read, and make a photograph where it leads."""
    world, path = base.parents[2], Path(os.path.normpath(base / "photos" / name))
    with suppress(OSError):
        if path.is_relative_to(world) and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(base / "photos" / "a.png", path)
    for model_path in (base / "plain", base / "lens"):
        model = pycolmap.Reconstruction(model_path)
        model.find_image_with_name("a.png").name = name
        model.write(model_path)
    quoted = name.replace("'", "''")
    execute(base / "any.db", f"UPDATE images SET name = '{quoted}' WHERE name = 'a.png'")
    for features in ("features.h5", "described.h5"):
        with suppress(ValueError, RuntimeError), h5py.File(base / features, "a") as file:
            file.copy("a.png", name)
    (base / "list.txt").write_text(f"{name}\nb-c.png\nside/č.png\nside/d.png\n", encoding="utf-8")


def assert_whole(label: str, out: Path) -> None:
    """A command that ended well has all of its results inside of its folder."""
    found = tree(out)
    assert not [key for key, value in found.items() if value[0] == "link" or "affrect" in key]
    assert any(value[0] != "folder" for value in found.values()), "nothing was written"
    if any(form in label for form in ("undistorted", "nerfstudio", "mvsnet")):
        pictures = [path for path in (out / "dense" / "images").rglob("*") if path.is_file()]
        model = pycolmap.Reconstruction(out / "dense" / "sparse")
        assert (len(pictures), model.num_reg_images()) == (4, 4)
    if "text" in label:
        assert pycolmap.Reconstruction(out / "text").num_reg_images() == 4


Prepare = Callable[[Path, str], list[Path]]
"""Makes the output folder, given the name of a result; returns what may be changed then."""


def attack_exports(
    base: Path, photograph: str, prepare: Prepare, call: Call, *codes: int
) -> list[str]:
    """Call all exports, each into a folder that is prepared; return what went wrong."""
    world, wrong = base.parents[2], []
    for label, (words, result) in exports(base, photograph).items():
        out = base / "outputs" / label.replace(",", " ")
        allowed = prepare(out, result)
        before = tree(world, *allowed)
        try:
            end = call(*(str(word).replace("{out}", str(out)) for word in words), "-q")
            harmed = differences(before, tree(world, *allowed))
            assert not harmed, f"{harmed}, exit code {end.code}"
            assert_clear(end, *codes)
            if end.code == 0 and out in allowed:
                assert_whole(label, out)
        except AssertionError as error:
            wrong.append(f"{label}: {str(error)[:600]}")
    return wrong


def empty_folder(out: Path, _: str) -> list[Path]:
    out.mkdir(parents=True)
    return [out]


@pytest.mark.parametrize("name", NAMES, ids=lambda name: ascii(name)[1:-1][:24])
def test_names_of_images_lead_nowhere_else(
    scene: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    base = make_world(scene, tmp_path)
    monkeypatch.setenv("HOME", str(base.parents[2] / "home"))
    name = name.format(photos=base / "photos", world=base.parents[2])
    rename_image(base, name)
    photograph = "b-c.png"
    with suppress(OSError):
        photograph = name if (base / "photos" / name).is_file() else photograph
    codes = (0,) if name == "x.png" else (0, 1, 2)
    wrong = attack_exports(base, photograph, empty_folder, call, *codes)
    assert not wrong, "\n".join([f"image named {name!r}", *wrong])


def link_to(target: str) -> Prepare:
    """A result is there already as a link; only the rest of the folder may change."""

    def prepare(out: Path, result: str) -> list[Path]:
        out.mkdir(parents=True)
        (out / result).symlink_to(out.parents[1] / target)
        return [out]

    return prepare


def hard_link(out: Path, result: str) -> list[Path]:
    out.mkdir(parents=True)
    os.link(out.parents[1] / "photos" / "a.png", out / result)
    return [out]


def linked_folder(out: Path, _: str) -> list[Path]:
    out.parent.mkdir(parents=True, exist_ok=True)
    out.symlink_to(out.parents[1] / "photos")
    return []


TRAPS = {
    "dangling link": link_to("../new.png"),
    "link to a photograph": link_to("photos/a.png"),
    "output folder is a link to the photographs": linked_folder,
    "hard link to a photograph": hard_link,
}


@pytest.mark.parametrize("trap", TRAPS)
def test_links_in_output_folders_are_not_followed(
    scene: Path, tmp_path: Path, call: Call, trap: str
) -> None:
    base = make_world(scene, tmp_path)
    wrong = attack_exports(base, "a.png", TRAPS[trap], call, 0, 1, 2)
    assert not wrong, "\n".join([trap, *wrong])


# Part 2: damaged files.

FILES = (
    "features.h5", "matches.h5", "guided.h5", "database.db", "pairs.txt", "config.toml",
    "cameras.json", "report.json", "report.html", "run.log",
    "sparse/0/cameras.bin", "sparse/0/rigs.bin", "sparse/0/frames.bin",
    "sparse/0/images.bin", "sparse/0/points3D.bin", "sparse/0/summary.json",
)  # fmt: skip
READERS = ("run", "map", "export", "align", "doctor")


def reader(name: str, scene: Path, out: Path) -> Words:
    """Arguments of a command that reads an output folder; results of some are beside it."""
    model = ["--model-path", out / "sparse" / "0", "--output-path", out.with_name("target"), "-q"]
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
    models = {key: value for key, value in tree(out, times=False).items() if key.endswith(".bin")}
    if name == "map":
        return database_content(out / "database.db") | models
    kept = {"features", "matches"}  # what an idle run does not read; doctor does
    return {key: value for key, value in results(out).items() if key not in kept} | models


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
    name, command = FILES[number % len(FILES)], chance.choice(READERS)
    out = Path(shutil.copytree(scene / "out", tmp_path / "out"))
    done = damage(out / name, chance, others=[scene / "out" / other for other in FILES])
    before = tree(out)
    end = call(*reader(command, scene, out))
    sys.stdout.write(f"{done}; then {command}: {end.stderr}\n")  # shown when the test fails
    if command == "doctor":  # which prints what it finds
        assert end.code in (0, 1), end
        assert differences(before, tree(out)) == []
        return
    assert_clear(end, 0, 1, 2)
    if end.code == 0:
        try:
            found = outcome(command, out)
        except (OSError, RuntimeError, ValueError, KeyError, sqlite3.Error) as error:
            raise AssertionError(f"success with a result that cannot be read: {error}") from error
        wrong = differences(expected[command], found)
        assert not wrong, f"success with a wrong result: {wrong}"
    elif command == "run":
        doctor = call("doctor", "-q", out)
        assert doctor.code == 1, doctor
        assert Path(name).name in doctor.stdout, doctor


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("name", [*FILES, "features.h5.journal", "database.db.seal", ".lock"])
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
    files = ["--features-path", tmp_path / "features.h5", "--image-path", scene / "photos"]
    before = tree(tmp_path)
    new = tmp_path / "new.db"
    end = call("import-h5", "-q", *files, *how, *CAMERA, "--database-path", new)
    sys.stdout.write(f"{done}: {end.stderr}\n")  # shown when the test fails
    assert_clear(end, 0, 1, 2)
    if end.code == 0:
        assert call("doctor", "-q", new).code == 0
        new.unlink()
    assert differences(before, tree(tmp_path)) == []


# Part 3: folders that are not ours.

FILLERS: dict[str, Words] = {
    "run": ["--image-path", "{photos}", *FAST],
    "extract": ["--image-path", "{photos}", *FAST],
    "compare": ["--image-path", "{photos}", *COMPARED],
    "evaluate": ["evd", "--dataset-path", "{scene}/pairs", "--recipes", PLAIN[1]],
    "inspect": ["{photos}/a.png", *PLAIN],
    "map": ["--from-database", "{scene}/any.db"],
    "convert": ["--image-path", "{photos}"],
}
"""Commands that fill an output folder."""


@pytest.mark.parametrize("kind", ["report", "photographs", "above the photographs"])
@pytest.mark.parametrize("name", FILLERS)
def test_foreign_folder_is_refused(
    scene: Path, tmp_path: Path, call: Call, name: str, kind: str
) -> None:
    photos = Path(shutil.copytree(scene / "photos", tmp_path / "photos"))
    (tmp_path / "mine").mkdir()
    for mine in ("notes.txt", "report.html", "database.db", "run.log"):
        (tmp_path / "mine" / mine).write_text("mine")
    out = {"report": tmp_path / "mine", "photographs": photos}.get(kind, tmp_path)
    before = tree(tmp_path)
    words = [str(word).format(photos=photos, scene=scene) for word in FILLERS[name]]
    end = call(name, "-q", *words, "--output-path", out)
    assert not (harmed := differences(before, tree(tmp_path))), (harmed, end.code)
    assert_clear(end, 1, 2)


# Part 4: databases and models of others whose values contradict each other.

IDS_OF_TABLES = (
    "cameras.camera_id", "images.camera_id", "rigs.rig_id", "rigs.ref_sensor_id",
    "rigs.ref_sensor_type", "frames.frame_id", "frames.rig_id", "frame_data.frame_id",
    "frame_data.data_id", "frame_data.sensor_id", "frame_data.sensor_type", "keypoints.rows",
    "keypoints.cols", "matches.rows", "two_view_geometries.config", "images.name",
)  # fmt: skip
ODD = ("0", "-1", "1", "2", "99", "5000000000", "4294967295", "NULL", "'x'", "1.5", "x'00ff'")
ADDED = (
    "INSERT INTO rig_sensors VALUES ({}, {}, {}, NULL)",
    "INSERT INTO rigs VALUES ({}, {}, {})",
    "INSERT INTO frames VALUES ({}, {})",
    "INSERT INTO frame_data VALUES ({}, {}, {}, {})",
    "INSERT INTO pose_priors VALUES ({}, {}, {}, {}, zeroblob(24), NULL, NULL, {})",
    "CREATE TRIGGER t AFTER INSERT ON {2} BEGIN DELETE FROM images; END",
)  # fmt: skip


def contradict(path: Path, chance: random.Random) -> str:
    """Change an id, or add a row, by chance; return what was done."""
    while True:
        table, _, column = chance.choice(IDS_OF_TABLES).partition(".")
        where = chance.choice(("", f" WHERE rowid = (SELECT max(rowid) FROM {table})"))
        statement = f"UPDATE {table} SET {column} = {chance.choice(ODD)}{where}"
        if chance.random() < 0.5:
            values = [chance.choice(ODD[:7]) for _ in range(5)]
            values = [chance.choice((value, "1")) for value in values]
            statement = chance.choice(ADDED).replace("{2}", table).format(*values)
        with suppress(sqlite3.Error):  # the tables themselves refuse much of it
            execute(path, statement)
            return statement


@pytest.mark.parametrize("number", range(40 * TIMES))
def test_database_that_contradicts_itself_is_mapped_or_named(
    scene: Path, tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"contradict {number}")
    path, out = Path(shutil.copy(scene / "any.db", tmp_path / "any.db")), tmp_path / "out"
    done = contradict(path, chance)
    before = path.read_bytes()
    for words in (
        ["map", "--from-database", path, "--output-path", out, "--no-page"],
        ["export-h5", "--database-path", path, "--features-path", tmp_path / "f.h5",
         "--matches-path", tmp_path / "m.h5"],
        ["export-database", path, tmp_path / "old.db"],
    ):  # fmt: skip
        end = call(*words, "-q")
        sys.stdout.write(f"{done}; then {words[0]}: {end.stderr}\n")  # shown when the test fails
        assert_clear(end, 0, 1, 2, 3)
        if end.code in (1, 2) and words[0] == "map":
            assert call("doctor", "-q", path).code == 1
    assert path.read_bytes() == before


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e308"])
@pytest.mark.parametrize("what", ["pose", "camera", "point", "name", "no image"])
def test_model_that_nothing_can_be_computed_with_is_named(
    scene: Path, tmp_path: Path, call: Call, what: str, value: str
) -> None:
    model, odd = pycolmap.Reconstruction(scene / "plain"), float(value)
    first, second = [model.image(image_id) for image_id in sorted(model.reg_image_ids())[:2]]
    if what == "pose":
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [odd, 0.0, 0.0])
        model.frame(first.frame_id).set_cam_from_world(first.camera_id, pose)
    elif what == "camera":
        model.cameras[first.camera_id].params = [odd, odd, 160.0, 120.0]
    elif what == "point":
        model.points3D[min(model.points3D)].xyz = [odd, 0.0, 0.0]
    elif what == "name":
        first.name = second.name
    else:
        for frame_id in list(model.reg_frame_ids()):
            model.deregister_frame(frame_id)
    (folder := tmp_path / "model").mkdir()
    model.write(folder)
    given = ["--model-path", folder, "--output-path", tmp_path / "new"]
    out = ["--output-path", tmp_path / "out", "--extend", folder, "-q"]
    for words in (
        ["export", *given, "--format", "ply,cameras"],
        ["export", *given, "--format", "nerfstudio", "--image-path", scene / "photos"],
        ["align", *given, "--distance", "b-c.png,side/d.png,2.0"],
        ["map", "--from-database", scene / "any.db", *out],
    ):
        assert_clear(call(*words), 1)
    assert not list((tmp_path / "new").glob("*"))
    assert call("doctor", "-q", folder).code == 1
