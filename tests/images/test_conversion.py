"""Folders of any formats become folders that COLMAP reads."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin
from small_scene import write_photographs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import ImageError, OptionError, WorkspaceError
from colmap_affrect.geometry.arrays import Bytes
from colmap_affrect.images import conversion, reading
from colmap_affrect.images.conversion import convert_images
from colmap_affrect.images.reading import decode
from colmap_affrect.project.image_failures import unusable

FOCAL_LENGTH = 0x920A
EQUIVALENT = 0xA405
EXIF_IFD = 0x8769
ORIENTATION = 0x0112


def picture(seed: int) -> Image.Image:
    values = np.random.default_rng(seed).integers(0, 256, (30, 45, 3), np.uint8)
    return Image.fromarray(values)


def exif() -> Image.Exif:
    tags = Image.Exif()
    tags.get_ifd(EXIF_IFD)[FOCAL_LENGTH] = 50.0
    tags.get_ifd(EXIF_IFD)[EQUIVALENT] = 80
    return tags


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    folder = tmp_path / "scans"
    (folder / "box").mkdir(parents=True)
    picture(1).save(folder / "box" / "a.jp2", quality_layers=[0])  # lossless
    picture(2).save(folder / "b.webp", lossless=True, exif=exif())
    picture(3).save(folder / "c.jpg")
    deep = Image.fromarray(np.arange(1350, dtype=np.uint16).reshape(30, 45) * 40)
    preview = Image.fromarray(np.zeros((3, 4), np.uint8))
    pages = [(deep, {}), (preview, {254: 1}), (picture(5).convert("L"), {})]
    with TiffImagePlugin.AppendingTiffWriter(str(folder / "d.tif")) as file:
        for page, tags in pages:
            page.save(file, format="TIFF", tiffinfo=tags)
            file.newFrame()
    picture(6).save(folder / "truly-webp.png", format="webp")
    (folder / "broken.jp2").write_bytes(b"\x00\x00\x00\x0cjP  \r\n\x87\n")
    return folder


def test_program_that_draws_a_picture_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow has Ghostscript run PostScript, whatever the name of the file."""
    folder = tmp_path / "scans"
    folder.mkdir()
    picture(1).save(folder / "a.webp")
    program = tmp_path / "bin" / "gs"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/was-run\necho 10.0\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    drawn = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\n(/etc/passwd) run\n"
    (folder / "b.jp2").write_bytes(drawn)
    report = convert_images(folder, tmp_path / "new")
    assert report.failed["b.jp2"].code == "not_convertible"
    assert list(report.written) == ["a.webp"]
    assert not (tmp_path / "was-run").exists()


def test_every_photograph_arrives_as_colmap_reads_it(
    scans: Path, tmp_path: Path
) -> None:
    out = tmp_path / "photos"
    report = convert_images(scans, out)
    assert list(report.failures) == ["broken.jp2"]
    assert report.written == {
        "b.webp": ["b.webp.png"],
        "box/a.jp2": ["box/a.jp2.png"],
        "d.tif": ["d.tif-page1.png", "d.tif-page2.png"],
        "truly-webp.png": ["truly-webp.png.png"],
    }
    assert report.copied == ["c.jpg"]
    assert (out / "c.jpg").read_bytes() == (scans / "c.jpg").read_bytes()
    np.testing.assert_array_equal(Image.open(out / "box" / "a.jp2.png"), picture(1))
    deep = decode(out / "d.tif-page1.png")
    assert (deep.dtype, int(deep[29, 44])) == (np.uint16, 1349 * 40)
    np.testing.assert_array_equal(
        decode(out / "d.tif-page2.png"), picture(5).convert("L")
    )
    for path in sorted(out.rglob("*.png")):
        assert pycolmap.Bitmap.read(path, as_rgb=False) is not None
    bitmap = pycolmap.Bitmap.read(out / "b.webp.png", as_rgb=True)
    assert bitmap.exif_focal_length() == pytest.approx(
        80 / 43.27 * np.hypot(45, 30), rel=0.01
    )


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_pages_that_lie_on_their_side_are_upright(tmp_path: Path, dtype: type) -> None:
    upright = np.arange(1350, dtype=np.uint16).reshape(30, 45).astype(dtype)
    (tmp_path / "scans").mkdir()
    with TiffImagePlugin.AppendingTiffWriter(str(tmp_path / "scans" / "a.tif")) as file:
        for orientation, page in ((6, np.rot90(upright)), (3, np.rot90(upright, 2))):
            Image.fromarray(page).save(
                file, format="TIFF", tiffinfo={ORIENTATION: orientation}
            )
            file.newFrame()
    convert_images(tmp_path / "scans", tmp_path / "photos")
    for name in ("a.tif-page1.png", "a.tif-page2.png"):
        made = Image.open(tmp_path / "photos" / name)
        assert ORIENTATION not in made.getexif()
        np.testing.assert_array_equal(made, upright)


def test_folders_that_are_there_and_those_inside_the_old_one_are_refused(
    scans: Path, tmp_path: Path
) -> None:
    for folder in (scans, scans / "png"):
        with pytest.raises(OptionError, match=r"lies in the folder of the|exists"):
            convert_images(scans, folder)
    (tmp_path / "mine").mkdir()
    with pytest.raises(OptionError, match="exists, and is left as it is"):
        convert_images(scans, tmp_path / "mine")
    with pytest.raises(OptionError, match="nowhere: no such folder"):
        convert_images(scans / "nowhere", scans)


def test_only_what_can_be_decoded_is_copied(scans: Path, tmp_path: Path) -> None:
    (scans / "secret.txt").write_text("a private key")
    (scans / "linked.jpg").symlink_to(scans / "secret.txt")
    (scans / "drawing.jpg").write_text("<svg/>")
    (scans / "text.png").write_text("%PDF-1.7")
    picture(7).save(scans / "old.tga")
    (scans / "old.tga").rename(scans / "old.jpg")
    for name in ("half.jpg", "half.png"):
        large = Image.fromarray(
            np.random.default_rng(1).integers(0, 256, (300, 400, 3), np.uint8)
        )
        large.save(scans / name)
        data = (scans / name).read_bytes()
        (scans / name).write_bytes(data[: len(data) // 2])
    report = convert_images(scans, tmp_path / "photos")
    bad = {"linked.jpg", "drawing.jpg", "text.png", "old.jpg", "half.jpg", "half.png"}
    assert set(report.failures) == {"broken.jp2", *bad}
    assert report.copied == ["c.jpg"]
    assert not bad & {path.name for path in (tmp_path / "photos").iterdir()}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_pipes_devices_and_endless_files_are_named_and_the_others_converted(
    scans: Path, tmp_path: Path
) -> None:
    os.mkfifo(scans / "pipe.jpg")
    os.mkfifo(scans / "box" / "config.toml")  # would say whose the folder is
    (scans / "zeros.jpg").symlink_to("/dev/zero")
    with (scans / "huge.jpg").open("wb") as file:
        file.truncate(1 << 40)
    report = convert_images(scans, tmp_path / "photos")
    assert set(report.failures) == {"broken.jp2", "pipe.jpg", "zeros.jpg", "huge.jpg"}
    assert "is not a file, but a pipe" in report.failures["pipe.jpg"]
    assert "is not a file, but a device" in report.failures["zeros.jpg"]
    assert "is 1100 GB long" in report.failures["huge.jpg"]
    assert report.copied == ["c.jpg"]


def test_no_photograph_takes_the_place_of_another(scans: Path, tmp_path: Path) -> None:
    picture(8).save(scans / "b.webp.png")
    picture(9).save(scans / "d.tif-page2.png")
    report = convert_images(scans, tmp_path / "photos")
    assert report.renamed == {
        "b.webp.png": "b.webp-2.png",
        "d.tif-page2.png": "d.tif-page2-2.png",
    }
    assert report.written["d.tif"] == ["d.tif-page1.png", "d.tif-page2-2.png"]
    assert "b.webp-2.png: instead of b.webp.png" in report.summary()
    made = Image.open(tmp_path / "photos" / "b.webp.png")
    np.testing.assert_array_equal(made, picture(8))
    np.testing.assert_array_equal(
        Image.open(tmp_path / "photos" / "b.webp-2.png"), picture(2)
    )


def test_of_a_damaged_page_no_other_page_is_left(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = conversion._as_png

    def as_png(path: Path, data: object, numbers: list[int]) -> Iterator[bytes]:
        for number, content in enumerate(usual(path, data, numbers)):
            if number:
                raise unusable("no_image", path)
            yield content

    monkeypatch.setattr(conversion, "_as_png", as_png)
    report = convert_images(scans, tmp_path / "photos")
    assert "not a readable image" in report.failures["d.tif"]
    assert not list((tmp_path / "photos").glob("d.tif*"))


def test_converted_photographs_with_long_names_get_shorter_ones(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    name = "x" * 250 + ".webp"
    picture(1).save(tmp_path / "scans" / name)
    report = convert_images(tmp_path / "scans", tmp_path / "photos")
    (new,) = report.written[name]
    assert len(new) == 255
    assert (tmp_path / "photos" / new).is_file()


@pytest.mark.parametrize(
    "is_picture", [True, False], ids=["a picture and a hole", "a hole"]
)
def test_long_file_that_is_not_what_it_says_is_named_and_not_read(
    tmp_path: Path, is_picture: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    picture(1).save(folder / "a.png")
    long = folder / "b.jpg"
    if is_picture:
        picture(2).save(long)
    with long.open("ab") as file:
        file.truncate(3_000_000_000)
    read = list[int]()
    empty = np.empty

    def counted(shape: int, *args: object) -> object:
        read.append(shape)
        return empty(shape, *args)

    monkeypatch.setattr(reading.np, "empty", counted)
    report = convert_images(folder, tmp_path / "photos")
    assert report.copied == ["a.png"]
    why = (
        "is 3.0 GB long, which its 0.0 megapixels do not need"
        if is_picture
        else "not a readable"
    )
    assert why in report.failures["b.jpg"]
    assert max(read) < 1_000_000


def test_long_file_whose_pixels_need_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "USUAL_BYTES", 1000)
    path = tmp_path / "a.png"
    picture(1).save(path)
    assert len(reading.read_photograph(path)) == path.stat().st_size > 1000


def test_copies_that_are_removed_while_others_are_made_are_no_success(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = tmp_path / "photos"
    write_photographs(photos)
    usual = reading.read_photograph
    num_read = 0

    def remove(path: Path) -> Bytes:
        nonlocal num_read
        num_read += 1
        if num_read == 3:
            for made in tmp_path.glob(".*"):
                shutil.rmtree(made)
        return usual(path)

    monkeypatch.setattr(reading, "read_photograph", remove)
    with pytest.raises(WorkspaceError, match="removed meanwhile"):
        convert_images(photos, tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_folder_of_which_nothing_can_be_decoded_leaves_none(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("none")
    with pytest.raises(ImageError, match=r"none of 1 files .* the first: .*a\.jpg"):
        convert_images(photos, tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]
