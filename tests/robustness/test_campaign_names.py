"""Campaign (tests/campaign.py): names of images, and links, that lead astray."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import h5py
import pytest
from campaign import CAMPAIGN, COMPARED, PLAIN, Words, assert_clear
from command import CAMERA, Call
from damaged import execute
from results import differences, tree

from colmap_affrect.colmap import pycolmap
from colmap_affrect.interop.export import FORMATS

pytestmark = CAMPAIGN

NAMES = (
    "{photos}/b-c.png",
    "{world}/elsewhere/new.png",
    "../../../photos/b-c.png",
    "side/../../../../../photos/x.png",
    "x.png",
    "x.png/..",
    "..",
    "C:\\x.png",
    "..\\..\\x.png",
    "\u202egnp.x",
    "line\nbreak.png",
    "~/x.png",
    "-rf.png",
    "/".join(["deep" * 12] * 20) + "/x.png",
    "dense/images/x.png",
    "sparse/0/cameras.bin",
    "",
)
"""Of an image in the place of a.png; x.png is harmless. A photograph is where a name leads."""

RESULTS = {
    "ply": "points3D.ply", "text": "text", "undistorted": "dense", "nerfstudio": "dense",
    "mvsnet": "dense", "cameras": "cameras.csv",
}  # fmt: skip
"""What each format of ``export`` writes."""


def exports(base: Path, photograph: str) -> dict[str, tuple[Words, str]]:
    """All commands that write beside the output folder: arguments, and the name of a result."""
    files = [
        "--features-path",
        base / "features.h5",
        "--matches-path",
        base / "matches.h5",
    ]
    images = ["--image-path", base / "photos"]
    new_files = [
        "--features-path",
        "{out}/features.h5",
        "--matches-path",
        "{out}/matches.h5",
    ]
    # The page of a run is copied as it is: no name of an image is looked at.
    assert RESULTS.keys() == FORMATS.keys() - {"report"}
    found: dict[str, tuple[Words, str]] = {}
    for form, name in {**RESULTS, "ply,text,cameras,nerfstudio": "text"}.items():
        for model in ("plain", "lens"):
            given = ["--model-path", base / model, *images, "--format", form]
            found[f"{form} of {model}"] = (
                ["export", *given, "--output-path", "{out}"],
                name,
            )
    distance = ["--distance", "b-c.png,side/d.png,2.0", "--output-path", "{out}/new"]
    source = ["--database-path", base / "any.db"]
    image = base / "photos" / photograph
    listed = (
        ["--image-list-path", base / "list.txt"] if (base / "list.txt").exists() else []
    )
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
    world = base.parents[2]
    path = Path(os.path.normpath(base / "photos" / name))
    with suppress(OSError):
        if path.is_relative_to(world) and not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(base / "photos" / "a.png", path)
    for model_path in (base / "plain", base / "lens"):
        model = pycolmap.Reconstruction(model_path)
        model.find_image_with_name("a.png").name = name
        model.write(model_path)
    quoted = name.replace("'", "''")
    execute(
        base / "any.db", f"UPDATE images SET name = '{quoted}' WHERE name = 'a.png'"
    )
    for features in ("features.h5", "described.h5"):
        with (
            suppress(ValueError, RuntimeError),
            h5py.File(base / features, "a") as file,
        ):
            file.copy("a.png", name)
    (base / "list.txt").write_text(
        f"{name}\nb-c.png\nside/č.png\nside/d.png\n", encoding="utf-8"
    )


def assert_dense_is_whole(dense: Path) -> None:
    """All four photographs are there, and in the model."""
    pictures = [path for path in (dense / "images").rglob("*") if path.is_file()]
    assert len(pictures) == 4
    assert pycolmap.Reconstruction(dense / "sparse").num_reg_images() == 4


def assert_whole(label: str, out: Path) -> None:
    """A command that ended well has all of its results inside of its folder."""
    found = tree(out)
    assert not [key for key in found if "affrect" in key]
    kinds = {value[0] for value in found.values()}
    assert "link" not in kinds
    assert kinds - {"folder"}, "nothing was written"
    if any(form in label for form in ("undistorted", "nerfstudio", "mvsnet")):
        assert_dense_is_whole(out / "dense")
    if "text" in label:
        assert pycolmap.Reconstruction(out / "text").num_reg_images() == 4


Prepare = Callable[[Path, str], list[Path]]
"""Makes the output folder, given the name of a result; returns what may be changed then."""


def attack_exports(
    base: Path, photograph: str, prepare: Prepare, call: Call, *codes: int
) -> list[str]:
    """Call all exports, each into a folder that is prepared; return what went wrong."""
    world = base.parents[2]
    wrong = []
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
