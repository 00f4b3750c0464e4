"""Attacks: commands in processes that can be ended, damage to files, and what is there then."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import runpy
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import h5py
from command import CAMERA, FAST, Ended
from damaged import execute
from planar_pairs import TRUTH, write_pair

from colmap_affrect.colmap import pycolmap
from colmap_affrect.interop.align import Georeference
from colmap_affrect.interop.export import FORMATS

HANGING_S = 30.0
PLAIN = ["--recipe", "unrectified-rootsift"]
COMPARED = ["--methods", "unrectified-rootsift", "--seeds", "0", *CAMERA]

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
    runpy.run_module("colmap_affrect", run_name="__main__", alter_sys=True)


def ended(*arguments: object, **variables: str) -> Ended:
    """Run a command to its end, in a process that is forked from one that has all modules.

    One that does not come to an end is killed, and the test fails.
    """
    words, said = [str(argument) for argument in arguments], Path(tempfile.mkdtemp(prefix="said-"))
    process = PROCESSES.Process(target=_be_the_command, args=(words, said, variables))
    process.start()
    process.join(HANGING_S)
    if (code := process.exitcode) is None:
        os.killpg(process.pid or 0, signal.SIGKILL)
        process.join()
    text = [(said / name).read_text(errors="replace") for name in ("out", "err")]
    shutil.rmtree(said)
    assert code is not None, f"no end after {HANGING_S:g} s: {words} {text[1][-500:]}"
    return Ended(code, text[0], text[1].splitlines())


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


@dataclass
class Scene:
    """A finished run of the small scene, and what commands need beside it.

    Attributes:
        folder: has ``photos``; ``out``, all stages; the model as it is and with a lens that
            distorts, both with a place on earth; files of hloc; a dataset; scans to be converted.
    """

    folder: Path

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def run(self, out: Path) -> list[object]:
        """Arguments of the run."""
        given = ["--image-path", self.folder / "photos", "--output-path", out]
        return ["run", "-q", *given, *FAST, "--guided", "always"]

    def copy(self, folder: Path) -> Path:
        """Copy the output folder; times stay."""
        return Path(shutil.copytree(self.out, folder / "copy", symlinks=True))


def make_scene(photos: Path, folder: Path) -> Scene:
    """Run the small scene, and put beside it what commands need."""
    made = Scene(folder)
    shutil.copytree(photos, folder / "photos")
    assert ended(*made.run(made.out)).code == 0
    files = ["--features-path", folder / "features.h5", "--matches-path", folder / "matches.h5"]
    assert ended("export-h5", "--output-path", made.out, *files).code == 0
    shutil.copy(made.out / "database.db", folder / "any.db")
    for name in ("plain", "lens"):
        model = pycolmap.Reconstruction(made.out / "sparse" / "0")
        for camera in model.cameras.values() if name == "lens" else ():
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            camera.params = [300.0, 160.0, 120.0, 0.05]
        (folder / name).mkdir()
        model.write(folder / name)
        Georeference(50.0, 14.0, 200.0).write(folder / name)
    shutil.copytree(photos, folder / "scans")
    picture = cv2.imread(str(photos / "a.png"))
    for number in range(6):
        cv2.imwrite(str(folder / "scans" / f"{number}.webp"), picture)
    write_pair(folder / "pairs" / "a.png", folder / "pairs" / "b.png", seed=3)
    pair = {"image1": "a.png", "image2": "b.png", "homography": TRUTH.tolist()}
    (folder / "pairs" / "pairs.json").write_text(json.dumps({"pairs": [pair]}))
    return made


def exports(folder: Path, photograph: str = "a.png") -> dict[str, tuple[list[object], str]]:
    """All commands that write beside the output folder: arguments, and the name of a result."""
    files = ["--features-path", folder / "features.h5", "--matches-path", folder / "matches.h5"]
    images = ["--image-path", folder / "photos"]
    new_files = ["--features-path", "{out}/features.h5", "--matches-path", "{out}/matches.h5"]
    names = {
        "ply": "points3D.ply", "text": "text", "undistorted": "dense", "nerfstudio": "dense",
        "cameras": "cameras.csv", "geojson": "cameras.geojson",
    }  # fmt: skip
    assert names.keys() == FORMATS.keys()
    found: dict[str, tuple[list[object], str]] = {}
    for form, name in [*names.items(), ("ply,text,cameras,nerfstudio,geojson", "text")]:
        for model in ("plain", "lens"):
            given = ["--model-path", folder / model, *images, "--format", form]
            found[f"{form} of {model}"] = (["export", *given, "--output-path", "{out}"], name)
    distance = ["--distance", "b c.png,side/d.png,2.0", "--output-path", "{out}/new"]
    found["align"] = (["align", "--model-path", folder / "plain", *distance], "new")
    source = ["--database-path", folder / "any.db"]
    found["export-h5"] = (["export-h5", *source, *new_files], "features.h5")
    found["export-database"] = (["export-database", folder / "any.db", "{out}/old.db"], "old.db")
    imported = ["import-h5", *images, *files, *CAMERA, "--database-path", "{out}/new.db"]
    found["import-h5"] = (imported, "new.db")
    scans = folder / "scans" if (folder / "scans").exists() else folder / "photos"
    found["convert"] = (["convert", "--image-path", scans, "--output-path", "{out}"], "a.png")
    image = folder / "photos" / photograph
    plan = f"{image.stem}-plan.json"
    found["inspect"] = (["inspect", image, *PLAIN, "--output-path", "{out}"], plan)
    listed = ["--image-list-path", folder / "list.txt"] if (folder / "list.txt").exists() else []
    compared = ["compare", *images, *listed, *COMPARED, "--output-path", "{out}"]
    found["compare"] = (compared, "report.html")
    return found


def placed(arguments: list[object], out: Path) -> list[object]:
    """Arguments with the output folder in its place, and no progress on stderr."""
    return [*(str(word).replace("{out}", str(out)) for word in arguments), "-q"]


def folder_commands(scene: Scene, photos: Path) -> dict[str, list[object]]:
    """Commands that fill an output folder, all but its name."""
    images = ["--image-path", photos]
    dataset = ["--dataset-path", scene.folder / "pairs", "--recipes", "unrectified-rootsift"]
    return {
        "run": ["run", "-q", *images, *FAST],
        "extract": ["extract", "-q", *images, *FAST],
        "compare": ["compare", "-q", *images, *COMPARED],
        "evaluate": ["evaluate", "-q", "pairs", *dataset],
        "inspect": ["inspect", "-q", photos / "a.png", *PLAIN],
        "map": ["map", "-q", "--from-database", scene.folder / "any.db"],
        "convert": ["convert", "-q", *images],
    }


def foreign_folder(kind: str, folder: Path) -> Path:
    """Make a folder of the user's, which is not empty."""
    made = folder / "mine"
    made.mkdir()
    (made / "notes.txt").write_text("mine")
    for name in ("report.html", "database.db", "run.log") if kind == "report" else ():
        (made / name).write_text("mine")
    return {"photographs": folder / "photos", "above the photographs": folder}.get(kind, made)


def make_world(scene: Scene, folder: Path) -> Path:
    """Copy what exports read to where a few steps up lead to folders that are watched."""
    base = folder / "world" / "one" / "two" / "three"
    base.mkdir(parents=True)
    for name in ("photos", "plain", "lens"):
        shutil.copytree(scene.folder / name, base / name)
    for name in ("any.db", "features.h5", "matches.h5"):
        shutil.copy(scene.folder / name, base / name)
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
    with suppress(ValueError, RuntimeError), h5py.File(base / "features.h5", "a") as file:
        file.copy("a.png", name)
    (base / "list.txt").write_text(f"{name}\nb c.png\nside/č.png\nside/d.png\n", encoding="utf-8")


def assert_whole(label: str, out: Path) -> None:
    """A command that ended well has all of its results inside of its folder."""
    found = tree(out)
    links = {key: value for key, value in found.items() if value[0] == "link"}
    assert not links, f"links are taken for results: {links}"
    temporary = [key for key in found if "affrect" in key]
    assert not temporary, f"left over: {temporary}"
    assert any(value[0] != "folder" for value in found.values()), "nothing was written"
    if "undistorted" in label or "nerfstudio" in label:
        pictures = [path for path in (out / "dense" / "images").rglob("*") if path.is_file()]
        model = pycolmap.Reconstruction(out / "dense" / "sparse")
        assert (len(pictures), model.num_reg_images()) == (4, 4)
    if "text" in label:
        assert pycolmap.Reconstruction(out / "text").num_reg_images() == 4


# Output folders before an export; each function returns what may be changed then.


def empty_folder(out: Path, _: str) -> list[Path]:
    out.mkdir(parents=True)
    return [out]


def linked(target: str) -> Callable[[Path, str], list[Path]]:
    """A result is there already as a link; only the rest of the folder may change."""

    def prepare(out: Path, result: str) -> list[Path]:
        out.mkdir(parents=True)
        (out / result).symlink_to(out.parents[1] / target)
        return [out]

    return prepare


def linked_folder(out: Path, _: str) -> list[Path]:
    out.parent.mkdir(parents=True, exist_ok=True)
    out.symlink_to(out.parents[1] / "photos")
    return []


def hard_link(out: Path, result: str) -> list[Path]:
    out.mkdir(parents=True)
    os.link(out.parents[1] / "photos" / "a.png", out / result)
    return [out]


TRAPS = {
    "dangling link": linked("../new.png"),
    "link to a photograph": linked("photos/a.png"),
    "output folder is a link to the photographs": linked_folder,
    "hard link to a photograph": hard_link,
}
