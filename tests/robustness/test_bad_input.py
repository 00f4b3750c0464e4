"""Photographs, options and folders that are no good: one clear line, and the others go on."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
import pytest
from command import CAMERA, FAST, Call
from results import tree
from small_scene import NAMES, photograph, write_photographs
from synthetic import png_of_size, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import StoreError
from colmap_affrect.images.photographs import list_images
from colmap_affrect.images.reading import IMAGE_SUFFIXES, read_gray
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.project.workspace import Workspace

TRIO = sorted(NAMES[:3])
PHOTOGRAPH = photograph((0.8, -0.3, 0.3), -7.5)
"""One more of the small scene, (240, 320) uint8."""
FORMATS = {
    "WEBP": "WebP",
    "GIF": "GIF",
    "AVIF": "AVIF or HEIF",
    "JPEG2000": "JPEG 2000",
}
"""Formats that COLMAP cannot read, as Pillow and as we call them."""
FAILING = {"start.jpg", "0 empty.jpg", "gone.png", "pipe.jpg", "bomb.png"}
FAILING |= {f"{kind}.jpg" for kind in FORMATS}


def codes_of_missing(report: dict[str, Any]) -> dict[str, str]:
    """Why photographs are in no model, by the content of report.json."""
    return {name: why["code"] for name, why in report["unregistered"].items()}


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
    assert ended.stderr[-1].startswith(
        "error: could not read 1 of the images: broken.jpg; the results are"
    )
    assert "not broken.jpg: unreadable" in ended.stdout
    report = json.loads((tmp_path / "out" / "report.json").read_text(encoding="utf-8"))
    assert codes_of_missing(report) == {"broken.jpg": "unreadable"}
    assert report["status"] == "partial"
    ended = call(*arguments, "--max-failures", 1)
    assert (ended.code, ended.errors) == (0, [])


def test_folders_without_usable_images_are_one_line(tmp_path: Path, call: Call) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for names, code, said in (
        (["notes.txt"], 2, f"{photos}: holds no images (.jpg"),
        (
            ["a.png", "b.jpg"],
            1,
            f"none of the 2 images can be used; the first: {photos / 'a.png'}",
        ),
    ):
        for name in names:
            (photos / name).write_bytes(b"text")
        ended = call(
            "run", "--image-path", photos, "--output-path", tmp_path / "out", "-q"
        )
        assert (ended.code, ended.stdout, len(ended.stderr)) == (code, "", 1)
        assert said in ended.errors[0]


def test_one_image_ends_without_a_model(tmp_path: Path, call: Call) -> None:
    write_photographs(tmp_path / "photos", 1)
    out = tmp_path / "out"
    ended = call(
        "run", "--image-path", tmp_path / "photos", "--output-path", out, *FAST, "-q"
    )
    assert ended.code == 3
    assert ended.stderr == [
        f"error: one image cannot make a model; see {out / 'report.html'}"
    ]
    assert "registered  0 of 1 images" in ended.stdout
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert (report["status"], report["num_models"], report["num_pairs"]) == (
        "no_model",
        0,
        0,
    )
    assert codes_of_missing(report) == {"a.png": "no_verified_pair"}


@pytest.mark.long
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
    with pytest.raises(
        StoreError, match=r"wing-b/c\.png and wing/b-c\.png have the same key"
    ):
        run(tmp_path / "photos", tmp_path / "out", RunOptions())
    assert not Workspace(tmp_path / "out").features.exists()


def test_cameras_that_cannot_be_used_are_refused_before_anything_is_recorded(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    extract = [
        "extract",
        "--image-path",
        trio,
        "--output-path",
        tmp_path / "out",
        *FAST[:2],
    ]
    refused = call(*extract, "--camera-model", "EQUIRECTANGULAR")
    assert (
        "model: EQUIRECTANGULAR: cut perspective views out of the panoramas, "
        in refused.errors[0]
    )
    refused = call(*extract, "--principal-point", "5")
    assert "--principal-point: cy='': should be a valid number" in refused.errors[0]
    assert not Workspace(tmp_path / "out").config.exists()
    assert call(*extract).code == 0


@pytest.mark.long
def test_damaged_features_are_made_again_with_overwrite(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    extract = [
        "extract",
        "--image-path",
        trio,
        "--output-path",
        tmp_path / "out",
        *FAST,
    ]
    assert call(*extract).code == 0
    (tmp_path / "out" / "features.h5").write_bytes(b"damaged")
    assert (
        "run the same 'extract' or 'run' with --overwrite" in call(*extract).errors[0]
    )
    assert call(*extract, "--overwrite").code == 0


def write_bad_images(folder: Path) -> None:
    """Put all kinds of bad images beside good ones."""
    photo = PIL.Image.fromarray(PHOTOGRAPH)
    data = cv2.imencode(".jpg", PHOTOGRAPH)[1].tobytes()
    png = (folder / "a.png").read_bytes()
    (folder / "half.jpg").write_bytes(data[: len(data) // 2])
    (folder / "start.jpg").write_bytes(data[:200])
    noise = np.random.default_rng(0).bytes(len(data) - 1400)
    (folder / "noise.jpg").write_bytes(data[:700] + noise + data[-700:])
    (folder / "half.png").write_bytes(png[: len(png) // 2])
    (folder / "0 empty.jpg").write_bytes(b"")
    (folder / "gone.png").symlink_to(folder / "nowhere.png")
    os.mkfifo(folder / "pipe.jpg")
    (folder / "bomb.png").write_bytes(
        png_of_size(40_000, 40_000)
    )  # more than OpenCV takes
    for kind in FORMATS:
        photo.save(folder / f"{kind}.jpg", format=kind)
    photo.save(folder / "x.webp")
    photo.save(folder / "side" / "y.WebP", format="webp")
    photo.save(folder / "z.gif")


@pytest.mark.long
def assert_formats_are_named(failures: dict[str, str], folder: Path) -> None:
    """Files of other formats than their names say are no images for COLMAP."""
    for kind, name in FORMATS.items():
        why = failures[f"{kind}.jpg"]
        assert f"is of the format {name}, which COLMAP cannot read" in why
        # So it is in truth, or the rule would keep good images out.
        assert pycolmap.Bitmap.read(folder / f"{kind}.jpg", as_rgb=False) is None


def test_bad_images_are_named_and_the_others_registered(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    write_bad_images(trio)
    folders = [trio, trio / "side"]

    def state() -> object:
        return tree(trio), [folder.stat().st_mtime_ns for folder in folders]

    before = state()
    for folder in folders:
        folder.chmod(
            0o555
        )  # does not stop root, but then the times of the folders tell
    ended = call(
        "run", "--image-path", trio, "--output-path", tmp_path / "out", "--json", *FAST
    )
    for folder in folders:
        folder.chmod(0o755)
    assert state() == before
    extraction = ended.report["stages"][0]
    failures = extraction["failures"]
    warnings = extraction["warnings"]
    # Decoders differ in what they make of data that ends early.
    assert (
        set(failures)
        >= FAILING
        >= set(failures) - {"half.jpg", "half.png", "noise.jpg"}
    )
    assert_formats_are_named(failures, trio)
    assert set(TRIO) <= set(ended.report["registered_names"])
    assert (ended.code, len(ended.errors)) == (1, 1)
    assert all(name in ended.errors[0] for name in failures)
    assert set(warnings) == {"*.webp", "*.gif", "contrast"}
    assert warnings["*.webp"].startswith("2 left out, such as side/y.WebP: ")
    codes = {warning["about"]: warning["code"] for warning in extraction["warned"]}
    assert codes == {
        "*.webp": "format_unread",
        "*.gif": "format_unread",
        "contrast": "low_contrast",
    }


@pytest.mark.parametrize("suffix", IMAGE_SUFFIXES)
def test_formats_that_are_taken_are_read_alike_by_colmap(
    tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"x{suffix}"
    mode = {".ppm": "RGB", ".pbm": "1"}.get(suffix, "L")
    PIL.Image.fromarray(PHOTOGRAPH).convert(mode).save(path)
    theirs = pycolmap.Bitmap.read(path, as_rgb=False).to_array()
    np.testing.assert_allclose(read_gray(path).astype(int), theirs.squeeze(), atol=3)


@pytest.mark.long
def test_tiny_images_are_no_obstacle(trio: Path, tmp_path: Path, call: Call) -> None:
    tiny = {
        f"{height} x {width}.png": PHOTOGRAPH[100 : 100 + height, :width]
        for height, width in [(1, 1), (1, 320), (140, 1), (7, 7), (31, 31)]
    }
    tiny["flat strip.png"] = np.full((2, 4000), 9, np.uint8)
    for name, gray in tiny.items():
        write_image(trio / name, gray)
    given = ["--image-path", trio, "--output-path", tmp_path / "out", "--json", *CAMERA]
    ended = call("run", *given)
    assert ended.code == 0, ended.stderr
    assert ended.report["registered_names"] == TRIO
    assert set(ended.report["unregistered"]) == set(tiny)
    assert set(codes_of_missing(ended.report).values()) <= {
        "no_features",
        "no_verified_pair",
    }


def test_float_pixels_that_are_not_finite_are_black_or_white(tmp_path: Path) -> None:
    values = np.array([[np.nan, np.inf, -np.inf, 0.5]], np.float32)
    assert read_gray(write_image(tmp_path / "x.tif", values)).tolist() == [
        [0, 255, 0, 127]
    ]


OF_A_RUN = (
    "features.h5", "features.h5.journal", "matches.h5", "guided.h5", "config.toml", "cameras.json",
    "database.db", "database.db.seal", "database.db-wal", "pairs.txt", "run.log", ".lock",
    "report.json",
)  # fmt: skip


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("name", OF_A_RUN)
def test_pipes_in_the_place_of_results_are_refused(
    trio: Path, tmp_path: Path, call: Call, name: str
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "config.toml").write_text("format_version = 11")  # it is ours
    (out / name).unlink(missing_ok=True)
    os.mkfifo(out / name)
    if name == "config.toml":
        (out / "run.log").write_text("colmap-affrect 0.1.0: output folder")
    ended = call("run", "--image-path", trio, "--output-path", out)
    assert (ended.code, len(ended.stderr)) == (2, 1)
    assert f"{name}: is not a file, but a pipe" in ended.errors[0]
    ended = call("doctor", out)
    assert ended.code in (0, 1, 2)
    assert "Traceback" not in "".join(ended.stderr)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_pipes_among_photographs_and_lists_are_one_line(
    trio: Path, tmp_path: Path, call: Call
) -> None:
    os.mkfifo(trio / "side" / "config.toml")
    os.mkfifo(trio / "side" / "run.log")
    run = ["run", "--image-path", trio, "--output-path", tmp_path / "out"]
    os.mkfifo(tmp_path / "list")
    for option in (
        "--image-list-path",
        "--match-list-path",
        "--cameras-path",
        "--tie-points",
    ):
        ended = call(*run, option, tmp_path / "list")
        assert (ended.code, len(ended.stderr)) == (2, 1)
        assert (
            "is not a file, but a pipe, which can be read only once" in ended.errors[0]
        )
    assert list_images(trio) == TRIO
