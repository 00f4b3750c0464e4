"""The doctor finds what was broken, and nothing in a healthy folder."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
import tomli_w
from damaged import execute
from results import tree
from small_scene import write_photographs
from verified import CAMERAS

from colmap_affrect.cli import main
from colmap_affrect.colmap import pycolmap
from colmap_affrect.doctor import Finding, diagnose
from colmap_affrect.errors import OptionError
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.pipeline.single_stages import choose_pairs
from colmap_affrect.project.record import ModelInputs
from colmap_affrect.project.workspace import Workspace

NUM_IMAGES = 3
INSTALLATION = ("installation", "networks", "weights")


@dataclass(frozen=True)
class Folders:
    """Photographs, and the results of a run on them."""

    photos: Path
    out: Path

    @property
    def database(self) -> Path:
        return self.out / "database.db"

    def change_record(self, change: Callable[[dict], object]) -> None:
        path = self.out / "config.toml"
        record = tomllib.loads(path.read_text(encoding="utf-8"))
        change(record)
        path.write_text(tomli_w.dumps(record), encoding="utf-8")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    folder = tmp_path_factory.mktemp("finished")
    folders = Folders(folder / "my photos", folder / "out")
    write_photographs(folders.photos, NUM_IMAGES)
    run(folders.photos, folders.out, RunOptions(cameras=CAMERAS))
    return folders


@pytest.fixture
def folders(finished: Folders, tmp_path: Path) -> Folders:
    """A copy that can be broken."""
    copy = Folders(tmp_path / "my photos", tmp_path / "out")
    shutil.copytree(finished.photos, copy.photos)
    shutil.copytree(finished.out, copy.out)
    copy.change_record(
        lambda record: record["extract"].update(image_path=str(copy.photos))
    )
    return copy


def findings(path: Path | None) -> list[Finding]:
    """Findings that are not about the installation."""
    diagnosis = diagnose(path)
    return [found for found in diagnosis.findings if found.where not in INSTALLATION]


def test_healthy_run_has_no_findings_and_stays_as_it_is(folders: Folders) -> None:
    before = tree(folders.out)
    assert findings(folders.out) == []
    assert tree(folders.out) == before
    checked = "\n".join(diagnose(folders.out).checked)
    for text in (
        "stages on record: extract, pairs, match, verify, escalate, guide, map; recipe default",
        "features.h5: all values",
        "3 images, 1 camera",
        "sparse: models of 3 images",
    ):
        assert text in checked


def edit_model(path: Path) -> None:
    model = pycolmap.Reconstruction(path)
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.zeros(3)))
    model.write(path)


def lengthen(path: Path) -> None:
    path.write_bytes(path.read_bytes() + b"x")


FOLDER_CASES: dict[str, tuple[Callable[[Folders], object], Finding]] = {
    "photographs gone": (
        lambda f: shutil.rmtree(f.photos),
        Finding("error", "{out}", "no such folder", "give the folder"),
    ),
    "features removed": (
        lambda f: (f.out / "features.h5").unlink(),
        Finding("error", "{out}/features.h5", "is missing", "give the same"),
    ),
    "database removed": (
        lambda f: f.database.unlink(),
        Finding("error", "{out}/database.db", "is missing", "to make it anew"),
    ),
    "pair list": (
        lambda f: (f.out / "pairs.txt").write_text("a.png nothing.png\n"),
        Finding("error", "{out}/pairs.txt", "is not two names of images",
                "run 'colmap-affrect pairs --output-path {out} --overwrite'"),
    ),
    "model damaged": (
        lambda f: lengthen(f.out / "sparse" / "0" / "points3D.bin"),
        Finding("error", "{out}/sparse/0", "points3D.bin: is not as it was written",
                "run 'colmap-affrect map --output-path {out} --overwrite'"),
    ),
    "config.toml damaged": (
        lambda f: (f.out / "config.toml").write_text("no [toml"),
        Finding("error", "{out}/config.toml", "damaged (Expected", "restore it"),
    ),
    "config.toml removed": (
        lambda f: (f.out / "config.toml").unlink(),
        Finding("note", "{out}", "is no output folder of colmap-affrect", "--output-path"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FOLDER_CASES)
def test_what_is_broken_in_a_folder_is_the_one_finding(
    folders: Folders, case: str
) -> None:
    damage, expected = FOLDER_CASES[case]
    damage(folders)
    found = findings(folders.out)
    assert len(found) == 1, found
    (found,) = found
    places = {"out": folders.out, "photos": folders.photos}
    assert found.severity == expected.severity
    assert found.where == expected.where.format(**places)
    assert expected.what in found.what
    assert expected.advice.format(**places) in found.advice


def in_the_place_of(path: Path, kind: str) -> None:
    """Put something else in the place of a file or a folder."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    if kind == "folder":
        path.mkdir()
        (path / "mine.txt").write_text("mine")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "huge":
        with path.open("wb") as file:
            file.truncate(HUGE_BYTES)
    elif kind == "picture":
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(range(256)))
    else:
        path.write_text('{"a": [1, {"b": null}]}')


HUGE_BYTES = 1 << 33  # of holes, which take no room on the disk
READ = (
    "features.h5", "matches.h5", "database.db", "pairs.txt", "config.toml", "cameras.json",
    "sparse/0/rigs.bin", "sparse/0/summary.json",
)  # fmt: skip
"""What doctor reads, and what is refused where it is something else."""
KINDS = ("folder", "pipe", "huge", "picture", "other JSON")
REPLACED = ("report.json", "report.html", "run.log", "database.db.seal", "mapped.db")
"""What is only written anew: a folder in its place would end commands at that point."""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize(("name", "kind"), [
    (name, kind)
    for name, kind in itertools.product(READ, KINDS)
    if (name, kind) != ("sparse/0/rigs.bin", "huge")  # its digest takes long
])  # fmt: skip
def test_whatever_is_in_the_place_of_a_file_is_found(
    folders: Folders, name: str, kind: str
) -> None:
    in_the_place_of(folders.out / name, kind)
    before = (folders.out / "run.log").read_bytes()
    found = [one for one in findings(folders.out) if one.severity == "error"]
    place = name.removesuffix("/rigs.bin").removesuffix("/summary.json")
    assert any(place in f"{one.where} {one.what}" for one in found), found
    assert "memory" not in " ".join(one.what for one in found)
    assert (folders.out / "run.log").read_bytes() == before


@pytest.mark.parametrize("name", REPLACED)
def test_folder_in_the_place_of_a_file_is_found_and_never_removed(
    folders: Folders, name: str
) -> None:
    in_the_place_of(folders.out / name, "folder")
    (found,) = findings(folders.out)
    assert (found.severity, found.where) == ("error", str(folders.out))
    assert found.what == f"{name}: is a folder, in the place of a file"
    with pytest.raises(OptionError, match="is a folder, in the place of a file"):
        run(folders.photos, folders.out, RunOptions(cameras=CAMERAS), overwrite=True)
    assert (folders.out / name / "mine.txt").read_text() == "mine"


def test_file_in_the_place_of_a_folder_is_found(folders: Folders) -> None:
    in_the_place_of(folders.out / "sparse", "picture")
    whats = [one.what for one in findings(folders.out)]
    assert "sparse: is a file, in the place of a folder" in whats


def declare(path: Path, name: str, shape: tuple[int, ...]) -> None:
    """Declare an array of a store in the place of that which is there, without values."""
    with h5py.File(path, "r+") as file:
        keys: list[str] = []
        file.visit(lambda key: keys.append(key) if key.endswith(name) else None)
        del file[keys[0]]
        chunks = tuple(min(size, 64) for size in shape)
        file.create_dataset(keys[0], shape, "f4", chunks=chunks)


@pytest.mark.parametrize(
    "shape", [(1 << 40, 2), (3000, 3000, 3000, 3000), (90_000_000, 2)]
)
@pytest.mark.parametrize(("store", "name"), [
    ("features.h5", "/keypoints"), ("features.h5", "/lafs"), ("matches.h5", "/matches0"),
])  # fmt: skip
def test_array_of_an_absurd_size_is_damage_and_no_lack_of_memory(
    folders: Folders, store: str, name: str, shape: tuple[int, ...]
) -> None:
    declare(folders.out / store, name, shape)
    (found,) = findings(folders.out)
    assert found.where == str(folders.out / store)
    assert f"damaged ({name[1:]} of shape {shape}" in found.what
    assert "'" in found.advice  # names a command that makes it again


def test_features_of_another_run_are_found(folders: Folders) -> None:
    double = "UPDATE keypoints SET rows = 2 * rows, data = data || data"
    execute(folders.database, f"{double} WHERE image_id = 1")
    found = [one for one in findings(folders.out) if "fewer features than" in one.what]
    (finding,) = found
    assert finding.where == str(folders.out / "features.h5")
    assert finding.what == "has fewer features than database.db of a.png"
    assert "extract" in finding.advice


def test_stages_that_are_to_be_done_again_are_no_fault(folders: Folders) -> None:
    assert folders.database.exists()
    choose_pairs(folders.out, overwrite=True)
    assert not folders.database.exists()
    assert findings(folders.out) == []


def test_an_edited_model_is_refused_and_replaced_only_if_that_is_said(
    folders: Folders, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = folders.out / "sparse" / "0"
    out = str(folders.out)
    edit_model(model)
    before = (model / "points3D.bin").read_bytes()
    target = [
        "--model-path",
        str(model),
        "--output-path",
        str(tmp_path / "new"),
        "--format=ply",
    ]
    for inputs in (None, "0" * 64):  # and where mapping would begin anew
        if inputs:
            Workspace(folders.out).record_mapping(ModelInputs(inputs))
        for arguments in (["map", "--output-path", out], ["export", *target]):
            assert main([*arguments, "--quiet"]) == 1
            (line,) = capsys.readouterr().err.splitlines()
            assert "copy it to a folder of its own without summary.json" in line
    assert (model / "points3D.bin").read_bytes() == before
    assert main(["map", "--output-path", out, "--quiet", "--overwrite"]) == 0
    assert main(["export", *target, "--quiet"]) == 0


def test_model_of_another_program_is_examined(tmp_path: Path, folders: Folders) -> None:
    shutil.copytree(folders.out / "sparse" / "0", tmp_path / "model")
    (tmp_path / "model" / "summary.json").unlink()
    assert findings(tmp_path / "model") == []
    model = pycolmap.Reconstruction(tmp_path / "model")
    model.cameras[1].params = [float("nan")] * len(model.cameras[1].params)
    model.write(tmp_path / "model")
    (found,) = findings(tmp_path / "model")
    assert (found.severity, found.advice) == ("error", "make the model again")
    assert "camera 1 has no size, or no finite and positive focal length" in found.what


@pytest.mark.long
def test_folder_in_use_is_left_alone(folders: Folders) -> None:
    (folders.out / "features.h5").unlink()
    with Workspace(folders.out).locked():
        (found,) = findings(folders.out)
    assert found.severity == "warning"
    assert "another colmap-affrect is working in this folder" in found.what
    assert found.advice == "run doctor again when it is done"


def test_what_is_no_database_is_one_error(tmp_path: Path, folders: Folders) -> None:
    (tmp_path / "empty.db").touch()
    (tmp_path / "text.db").write_text("text")
    data = folders.database.read_bytes()
    # SQLite's message about it quotes bytes that are no UTF-8.
    (tmp_path / "schema.db").write_bytes(
        data.replace(b"CREATE TABLE frames", b"CREATE TABL\xbe frames")
    )
    for name in ("", "empty.db", "text.db", "schema.db"):
        path = tmp_path / name
        (found,) = findings(path)
        assert (found.severity, found.where) == ("error", str(path))


def test_installation_is_examined_without_a_path(tmp_path: Path) -> None:
    (tmp_path / "AffNet.pth").write_bytes(b"not the published file")
    diagnosis = diagnose(weights_path=tmp_path)
    assert "pycolmap 4." in diagnosis.checked[0]
    assert diagnosis.checked[1].startswith("networks: run on ")
    found = {finding.where: finding for finding in diagnosis.findings}
    other = found[str(tmp_path / "AffNet.pth")]
    assert other.what == "not the published file of affnet"
    fetch = (
        f"remove it and run: colmap-affrect weights fetch affnet --weights {tmp_path}"
    )
    assert other.advice == f"unless it is your own, {fetch}"
    assert diagnosis.num_errors == 0


def test_missing_torch_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "colmap_affrect.features.networks", None)
    (found,) = diagnose().findings
    assert found.severity == "error"
    assert "torch or kornia cannot be loaded" in found.what


def test_command_prints_and_ends_with_1_if_there_are_errors(
    folders: Folders, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", str(folders.out)]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("no problems found\n")
    assert printed.err == ""
    (folders.out / "features.h5").unlink()
    arguments = ["doctor", str(folders.out), "--json", "-q"]
    assert main(arguments) == 1
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    assert (report["num_errors"], report["num_warnings"], printed.err) == (1, 0, "")
    assert report["findings"][0]["where"] == str(folders.out / "features.h5")
    assert set(report["findings"][0]) == {"severity", "where", "what", "advice"}
