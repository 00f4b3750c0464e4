"""Lists of photographs, masks, and what else is known beside their pixels."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import PIL.ExifTags
import PIL.Image
import pytest
from command import Call
from small_scene import IMAGE_SIZE, photograph
from synthetic import png_of_size, texture, write_image

import colmap_affrect
from colmap_affrect.cli import main
from colmap_affrect.colmap import pycolmap
from colmap_affrect.data import Mask
from colmap_affrect.errors import ImageError, OptionError
from colmap_affrect.images.masks import read_mask, shrink_mask
from colmap_affrect.images.photographs import (
    MaskOptions,
    Photographs,
    left_out,
    list_images,
    photograph_files,
)
from colmap_affrect.images.reading import read_photograph
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.stage_warnings import StageWarning, texts_by_subject


def diagonal_mask(size: tuple[int, int] = IMAGE_SIZE) -> Mask:
    """True above a slanted line that has no symmetry."""
    columns, rows = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return np.asarray(rows < 60 + 0.4 * columns)


@pytest.fixture
def photo_path(tmp_path: Path) -> Path:
    path = tmp_path / "photos" / "a b.png"
    path.parent.mkdir()
    write_image(path, photograph((0.2, 0.0, 0.1), 4.0))
    return path


def write_mask(path: Path, mask: Mask, white: int = 255) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_image(path, mask.astype(np.uint8) * np.uint8(white))


def touch(folder: Path, *names: str) -> None:
    """Write empty files."""
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_shrunk_mask_keeps_its_place() -> None:
    mask = np.zeros((90, 120), bool)
    mask[30:, 20:60] = True
    expected = np.zeros((30, 40), bool)
    expected[10:, 7:20] = True
    np.testing.assert_array_equal(shrink_mask(mask, (40, 30)), expected)


@pytest.mark.parametrize("white", [1, 255])
def test_only_black_is_left_out(tmp_path: Path, white: int) -> None:
    write_mask(tmp_path / "m.png", diagonal_mask((40, 90)), white)
    np.testing.assert_array_equal(
        read_mask(tmp_path / "m.png"), diagonal_mask((40, 90))
    )


@pytest.mark.parametrize("mask_name", ["wing/a b.jpg.png", "wing/a b.png"])
def test_masks_are_found_as_colmap_finds_them(tmp_path: Path, mask_name: str) -> None:
    image = texture((200, 160), 3)
    for folder in ("images/wing", "masks/wing"):
        (tmp_path / folder).mkdir(parents=True)
    write_image(tmp_path / "images/wing/a b.jpg", image)
    mask = diagonal_mask((200, 160))
    write_mask(tmp_path / "masks" / mask_name, mask)
    found = Photographs(
        tmp_path / "images", MaskOptions(path=str(tmp_path / "masks"))
    ).mask("wing/a b.jpg")
    np.testing.assert_array_equal(found, mask)
    pycolmap.extract_features(
        tmp_path / "colmap.db",
        tmp_path / "images",
        reader_options=dict(mask_path=tmp_path / "masks"),
    )
    with pycolmap.Database.open(tmp_path / "colmap.db") as database:
        points = database.read_keypoints(1)[:, :2]
    assert len(points) > 20
    assert mask[tuple(np.floor(points).astype(int).T[::-1])].all()


def test_mask_and_camera_mask_both_count(tmp_path: Path) -> None:
    one = diagonal_mask((60, 50))
    other = diagonal_mask((60, 50))[:, ::-1]
    write_mask(tmp_path / "masks" / "x.png", one)
    write_mask(tmp_path / "camera.png", other)
    masks = MaskOptions(
        path=str(tmp_path / "masks"), camera_path=str(tmp_path / "camera.png")
    )
    both = Photographs(tmp_path, masks).mask("x.jpg")
    np.testing.assert_array_equal(both, one & other)
    write_mask(tmp_path / "camera.png", other[:40])
    with pytest.raises(
        ImageError, match=r"60 x 50 px and its mask 60 x 40 px .*camera\.png"
    ):
        Photographs(tmp_path, masks).mask("x.jpg")


@pytest.mark.parametrize(("prepare_mask", "message"), [
    (lambda path: path.write_bytes(b""), "not a readable image"),
    (lambda path: write_mask(path, diagonal_mask((300, 240))), "320 x 240 px and its mask 300"),
    (
        lambda path: path.write_bytes(png_of_size(32_000, 31_000)),
        "320 x 240 px and its mask 32000 x 31000 px",
    ),
])  # fmt: skip
def test_image_with_a_wrong_mask_is_reported_and_the_others_go_on(
    photo_path: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    prepare_mask: Callable[[Path], None],
    message: str,
) -> None:
    write_image(photo_path.with_name("good.png"), texture((90, 70), 1))
    write_mask(tmp_path / "masks/good.png", np.ones((70, 90), bool))
    prepare_mask(tmp_path / "masks/a b.png.png")
    arguments = ["--image-path", photo_path.parent, "--output-path", tmp_path / "out"]
    code = main(
        ["extract", *map(str, arguments), "--mask-path", str(tmp_path / "masks"), "-q"]
    )
    assert code == 1
    assert "could not read 1 of the images: a b.png" in capfd.readouterr().err
    store = FeatureStore(tmp_path / "out" / "features.h5")
    assert store.names() == ["good.png"]
    log = (tmp_path / "out" / "run.log").read_text()
    assert re.search(message, log)


def test_photographs_without_a_mask_are_used_whole_and_named(
    photo_path: Path, tmp_path: Path, call: Call
) -> None:
    write_image(photo_path.with_name("good.png"), texture((90, 70), 1))
    arguments = [
        "extract",
        "--image-path",
        photo_path.parent,
        "--output-path",
        tmp_path / "out",
    ]
    arguments += ["--mask-path", tmp_path / "masks"]
    write_mask(tmp_path / "masks" / "other.png", np.zeros((70, 90), bool))
    done = call(*arguments)
    assert done.code == 2
    assert "has no mask of any image, such as " in done.errors[0]
    write_mask(tmp_path / "masks" / "good.png", np.zeros((70, 90), bool))
    done = call(*arguments)
    assert done.code == 0
    assert (
        "WARNING: masks: 1 images have none and are used whole, as a b.png is"
        in done.stderr
    )
    store = FeatureStore(tmp_path / "out" / "features.h5")
    assert len(store.read("a b.png")) > 100
    assert len(store.read("good.png")) == 0


def test_gps_position_and_focal_length_of_exif_are_taken_over(tmp_path: Path) -> None:
    exif = PIL.Image.Exif()
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[PIL.ExifTags.Base.FocalLengthIn35mmFilm] = 50
    exif.get_ifd(PIL.ExifTags.IFD.GPSInfo).update(
        {
            PIL.ExifTags.GPS.GPSLatitudeRef: "S",
            PIL.ExifTags.GPS.GPSLatitude: (33.0, 51.0, 36.0),
            PIL.ExifTags.GPS.GPSLongitudeRef: "E",
            PIL.ExifTags.GPS.GPSLongitude: (151.0, 12.0, 0.0),
            PIL.ExifTags.GPS.GPSAltitudeRef: b"\0",
            PIL.ExifTags.GPS.GPSAltitude: 40.0,
        }
    )
    photos = tmp_path / "photos"
    photos.mkdir()
    PIL.Image.fromarray(texture((240, 160), 1)).save(photos / "a.jpg", exif=exif)
    path = tmp_path / "a.db"
    colmap_affrect.extract_features(path, photos)
    colmap_affrect.extract_features(tmp_path / "b.db", photos, from_database=path)
    for copy in (path, tmp_path / "b.db"):
        with pycolmap.Database.open(copy) as database:
            (prior,) = database.read_all_pose_priors()
            np.testing.assert_allclose(prior.position, [-33.86, 151.2, 40.0], atol=1e-6)
            (camera,) = database.read_all_cameras()
            assert camera.has_prior_focal_length
            # 35 mm film has a diagonal of 43.27 mm.
            assert camera.focal_length == pytest.approx(
                50 / 43.27 * np.hypot(240, 160), rel=1e-3
            )


def test_list_images_finds_images_in_folders_and_passes_over_the_rest(
    tmp_path: Path,
) -> None:
    taken = ["a b.png", "deep/er/č.tif", "folder.png/inside.bmp", "z.JPG"]
    touch(tmp_path, *taken, ".hidden.png", ".git/x.png", "notes.txt", "a.webp")
    assert list_images(tmp_path) == taken


def test_list_images_takes_those_of_a_list(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "b c.png", "deep/č.png")
    listed = tmp_path / "list.txt"
    text = "\ufeff# comment\nb c.png\n\n./deep//č.png\nb c.png\n"
    listed.write_text(text, encoding="utf-8")
    assert list_images(tmp_path, listed) == ["b c.png", "deep/č.png"]


@pytest.mark.parametrize("line", ["d.png", "../photos/a.png", ""])
def test_list_images_refuses_a_list_of_what_is_not_there(
    tmp_path: Path, line: str
) -> None:
    folder = tmp_path / "photos"
    touch(folder, "a.png")
    listed = tmp_path / "list.txt"
    listed.write_text(line.format(folder=folder))
    with pytest.raises(OptionError, match=r"list\.txt: (lists .* not in|is empty)"):
        list_images(folder, listed)


def test_videos_are_named_with_what_to_do(photo_path: Path) -> None:
    touch(photo_path.parent, "film.MP4", "side.mov")
    assert left_out(photo_path.parent) == [
        StageWarning("video", "*.mp4", {"num": 1, "example": "film.MP4"}),
        StageWarning("video", "*.mov", {"num": 1, "example": "side.mov"}),
    ]


def test_photograph_that_is_a_link_in_a_circle_keeps_no_other_one_back(
    tmp_path: Path,
) -> None:
    touch(tmp_path, "a.png", "c.png")
    (tmp_path / "b.png").symlink_to("b.png")
    assert photograph_files(tmp_path) == ["a.png", "b.png", "c.png"]
    with pytest.raises(ImageError, match=r"b\.png: cannot be read"):
        read_photograph(tmp_path / "b.png")


def test_linked_folders_are_followed_and_each_folder_is_taken_once(
    tmp_path: Path,
) -> None:
    photos = tmp_path / "photos"
    other = tmp_path / "other"
    touch(photos, "a.png", "side/b.png")
    touch(other, "c.png", "deep/d.png")
    (photos / "0 side again").symlink_to(photos / "side")
    (photos / "linked").symlink_to(other)
    (photos / "same").symlink_to(other)
    (photos / "up").symlink_to(tmp_path)
    (photos / "side" / "round").symlink_to(photos)
    (other / "back").symlink_to(photos)
    (photos / "gone").symlink_to(tmp_path / "nowhere")
    assert list_images(photos) == [
        "a.png",
        "linked/c.png",
        "linked/deep/d.png",
        "side/b.png",
    ]
    (warning,) = left_out(photos)
    assert warning.code == "folder_linked_twice"
    assert "0 side again/" in warning.about


def test_folders_of_systems_are_left_out_and_named(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "a.jpg",
        "@eaDir/a.jpg/SYNOPHOTO_THUMB_XL.jpg",
        "in/@eaDir/b.jpg/x.jpg",
    )
    touch(tmp_path, "#recycle/old.jpg")
    assert list_images(tmp_path) == ["a.jpg"]
    found = {warning.about: warning.code for warning in left_out(tmp_path)}
    assert found == {"@eaDir/, in/@eaDir/": "thumbnails", "#recycle/": "deleted_folder"}


def test_names_that_lists_cannot_hold_are_told_apart_and_none_is_lost(
    tmp_path: Path,
) -> None:
    touch(tmp_path, "a.png", "b\nc.png", os.fsdecode(b"\xfe.png"))
    found = left_out(tmp_path)
    codes = {warning.code: warning.values["example"] for warning in found}
    assert codes == {
        "control_character": "b\\u000ac.png",
        "name_not_utf_8": "\\udcfe.png",
    }
    (text,) = texts_by_subject(found).values()
    assert text == f"{found[0].text()}; {found[1].text()}"


def write_transparent(path: Path, mask: Mask, mode: str = "RGBA") -> None:
    alpha = PIL.Image.fromarray(np.where(mask, 255, 100).astype(np.uint8))
    gray = texture(mask.shape[::-1], 5)
    image = PIL.Image.fromarray(np.repeat(gray[:, :, None], 3, axis=2))
    image.putalpha(alpha)
    path.parent.mkdir(parents=True, exist_ok=True)
    image.convert(mode).save(path)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_the_alpha_channel_is_the_mask_where_there_is_no_file_of_one(
    tmp_path: Path, name: str, mode: str
) -> None:
    mask = diagonal_mask((120, 90))
    write_transparent(tmp_path / "photos" / name, mask, mode)
    photographs = Photographs(
        tmp_path / "photos", MaskOptions(path=str(tmp_path / "masks"))
    )
    np.testing.assert_array_equal(photographs.mask(name), mask)
    write_mask(tmp_path / "masks" / "a.png", ~mask)
    np.testing.assert_array_equal(photographs.mask(name), ~mask)


def test_an_alpha_channel_that_is_one_value_all_over_is_no_mask(tmp_path: Path) -> None:
    for name, is_seen in (("opaque.png", True), ("empty.png", False)):
        write_transparent(tmp_path / name, np.full((90, 120), is_seen))
        assert Photographs(tmp_path).mask(name) is None


def test_masks_that_are_white_all_over_are_named_in_one_line(
    photo_path: Path, tmp_path: Path, call: Call
) -> None:
    write_mask(tmp_path / "masks" / "a b.png", np.ones(IMAGE_SIZE[::-1], bool))
    arguments = ["--image-path", photo_path.parent, "--mask-path", tmp_path / "masks"]
    done = call("extract", *arguments, "--output-path", tmp_path / "out")
    assert done.code == 0
    (line,) = [line for line in done.stderr if "white" in line]
    assert line.startswith(
        "WARNING: white masks: 1 masks are white all over, such as that of a b"
    )


@pytest.mark.parametrize("place", ["photos", "photos/masks"])
def test_masks_that_are_photographs_are_refused(tmp_path: Path, place: str) -> None:
    touch(tmp_path / "photos", "a.png", "b.jpg", "masks/a.png")
    names = list_images(tmp_path / "photos")
    for masks in (
        MaskOptions(path=str(tmp_path / place)),
        MaskOptions(camera_path=str(tmp_path / "photos" / "b.jpg")),
    ):
        with pytest.raises(OptionError, match="is one of the photographs in"):
            Photographs(tmp_path / "photos", masks).without_mask(names)
    beside = MaskOptions(path=str(tmp_path / "photos" / "masks"))
    assert Photographs(tmp_path / "photos", beside).without_mask(
        ["a.png", "b.jpg"]
    ) == ["b.jpg"]
