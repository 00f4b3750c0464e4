"""Photographs, options and folders that are no good: one clear line, and the others go on."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import FAST, Call
from small_scene import photograph, write_photographs
from synthetic import write_image

from colmap_affrect.colmap.cameras import read_given_cameras
from colmap_affrect.errors import OptionError, StoreError
from colmap_affrect.images.photographs import CameraOptions, list_images
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.extract import extract as extract_stage
from colmap_affrect.stages.inputs import Inputs


@pytest.fixture
def trio(tmp_path: Path) -> Path:
    """Three photographs in a folder of their own, to be mixed with others."""
    write_photographs(tmp_path / "trio", 3)
    return tmp_path / "trio"


@pytest.mark.long
def test_unreadable_image_is_reported_and_the_run_goes_on(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    (trio / "broken.jpg").write_bytes(b"no image at all")
    arguments = ["run", "--image-path", trio, "--output-path", tmp_path / "out", *FAST]
    ended = call(*arguments)
    assert (ended.code, len(ended.errors)) == (1, 1)
    assert ended.stderr[-1] == "error: could not read 1 of the images: broken.jpg"
    assert "not broken.jpg: unreadable" in ended.stdout
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert report["unregistered"] == {"broken.jpg": "unreadable"}
    assert report["status"] == "partial"
    ended = call(*arguments, "--max-failures", 1)
    assert (ended.code, ended.errors) == (0, [])


def test_folders_without_usable_images_are_one_line(tmp_path: Path, call: Call) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for names, said in (
        (["notes.txt"], f"{photos}: holds no images (.jpg"),
        (["a.png", "b.jpg"], f"none of the 2 images can be used; the first: {photos / 'a.png'}: "),
    ):
        for name in names:
            (photos / name).write_bytes(b"text")
        ended = call("run", "--image-path", photos, "--output-path", tmp_path / "out", "-q")
        assert (ended.code, ended.stdout, len(ended.stderr)) == (1, "", 1)
        assert said in ended.errors[0]


def test_one_image_ends_without_a_model(tmp_path: Path, call: Call) -> None:
    write_photographs(tmp_path / "photos", 1)
    out = tmp_path / "out"
    ended = call("run", "--image-path", tmp_path / "photos", "--output-path", out, *FAST, "-q")
    assert ended.code == 3
    assert ended.stderr == [f"error: one image cannot make a model; see {out / 'report.html'}"]
    assert "registered  0 of 1 images" in ended.stdout
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert (report["status"], report["num_models"], report["num_pairs"]) == ("no_model", 0, 0)
    assert report["unregistered"] == {"a.png": "no verified pair"}


def test_pair_list_may_name_an_image_that_cannot_be_read(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    (trio / "broken.png").write_bytes(b"text")
    pairs = tmp_path / "list.txt"
    pairs.write_text("broken.png a.png\na.png\tb c.png\n", encoding="utf-8")
    out = ["--output-path", tmp_path / "out"]
    call("extract", "--image-path", trio, *out, *FAST)
    ended = call("pairs", *out, "--match-list-path", pairs)
    assert (ended.code, ended.stdout.split(" in ")[0]) == (0, "pairs: 1 done")
    assert Workspace(tmp_path / "out").pairs.read_text() == "a.png\tb c.png\n"


def test_names_with_the_same_key_are_refused(tmp_path: Path) -> None:
    for name in ("wing/b-c.png", "wing-b/c.png"):
        (tmp_path / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(tmp_path / "photos" / name, photograph((0, 0, 0), 0))
    with pytest.raises(StoreError, match=r"wing-b/c\.png and wing/b-c\.png have the same key"):
        run(tmp_path / "photos", tmp_path / "out", RunOptions())
    assert not Workspace(tmp_path / "out").features.exists()


def test_cameras_that_cannot_be_used_are_refused_before_anything_is_recorded(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    extract = ["extract", "--image-path", trio, "--output-path", tmp_path / "out", *FAST[:2]]
    refused = call(*extract, "--camera-model", "EQUIRECTANGULAR")
    assert "--camera-model EQUIRECTANGULAR: not one of SIMPLE_PINHOLE, " in refused.errors[0]
    inputs = Inputs.of(trio, cameras=CameraOptions(existing_camera_id=7))
    context = Context(Workspace(tmp_path / "out"))
    with pytest.raises(OptionError, match=r"existing_camera_id=7: .*database\.db has no such"):
        extract_stage(context, inputs, load_recipe("unrectified-rootsift"))
    assert not context.workspace.config.exists()
    assert call(*extract).code == 0


def test_files_of_text_may_begin_with_a_byte_order_mark(trio: Path, tmp_path: Path) -> None:
    """As editors of Windows write them."""

    def written(name: str, text: str) -> Path:
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
        return tmp_path / name

    recipe = written("own.toml", 'rectifier = "identity"\n')
    assert load_recipe(str(recipe)).extraction.rectifier.name == "identity"
    names = list_images(trio)
    assert list_images(trio, written("list.txt", f"{names[0]}\n")) == names[:1]
    listed = written("pairs.txt", f"{names[0]}\t{names[1]}\n")
    assert [*read_pairs(listed, names)] == [(names[0], names[1])]
    table = CameraOptions(cameras_path=str(written("table.csv", "name,focal_px\na.png,300\n")))
    assert read_given_cameras(table)["a.png"].focal_px == 300.0


def test_damaged_features_are_made_again_with_overwrite(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    extract = ["extract", "--image-path", trio, "--output-path", tmp_path / "out", *FAST]
    assert call(*extract).code == 0
    (tmp_path / "out" / "features.h5").write_bytes(b"damaged")
    assert "run the same 'extract' or 'run' with --overwrite" in call(*extract).errors[0]
    assert call(*extract, "--overwrite").code == 0
