"""Lines of single photographs: numbers from paths and arrays, pictures, and what is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from line_scenes import SIZE, Building
from PIL import ExifTags, Image
from synthetic import write_image

from colmap_affrect.data import GrayImage
from colmap_affrect.errors import ImageError, OptionError
from colmap_affrect.images.lines import lines_of
from colmap_affrect.project.line_report import line_report
from colmap_affrect.report.line_pictures import (
    HORIZON,
    UPRIGHT,
    camera_from_lines,
    line_sheet,
    report_lines,
)

BUILDING = Building(focal=0.85, num_each=30, noise_px=0.0)


@pytest.fixture(scope="module")
def drawing() -> GrayImage:
    image = np.full(SIZE[::-1], 230, np.uint8)
    for x1, y1, x2, y2 in BUILDING.edges(11).round().astype(int).tolist():
        cv2.line(image, (x1, y1), (x2, y2), 30, 3, cv2.LINE_AA)
    return image


def test_paths_and_arrays_say_the_same(tmp_path: Path, drawing: GrayImage) -> None:
    path = write_image(tmp_path / "a.png", drawing)
    report = camera_from_lines(path)
    assert report.is_known
    assert report.focal_px == pytest.approx(0.85 * 1500.0, rel=0.1)
    assert camera_from_lines(np.repeat(drawing[:, :, None], 3, axis=2)) == report
    nothing = camera_from_lines(drawing, np.zeros(drawing.shape, np.bool_))
    assert (nothing.num_segments, nothing.focal_px) == (0, None)


def test_what_is_no_photograph_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"a\.jpg: not a readable image"):
        camera_from_lines(tmp_path / "a.jpg")
    for image in (
        np.zeros((9, 9)),
        np.zeros((9, 9, 4), np.uint8),
        np.zeros((0, 9), np.uint8),
    ):
        with pytest.raises(OptionError, match=r"image: is an array of the shape"):
            camera_from_lines(image)
    with pytest.raises(OptionError, match=r"mask: has the shape \(9, 8\)"):
        camera_from_lines(np.zeros((8, 9), np.uint8), np.ones((9, 8), np.bool_))


def test_a_picture_has_lines_in_the_colours_of_their_directions(
    drawing: GrayImage,
) -> None:
    lines = lines_of(drawing)
    data = line_sheet(drawing, lines, line_report(lines.findings(), SIZE))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    panel = picture[48:, :1592]  # below the sentence and the legend
    scale = 1592 / SIZE[0]
    edges = BUILDING.edges(11)[1::3]  # every third is upright
    middles = (edges[:, :2] + edges[:, 2:]) / 2.0
    num_green = 0
    for x, y in (middles * scale).round().astype(int).tolist():
        around = panel[max(0, y - 6) : y + 7, max(0, x - 6) : x + 7].reshape(-1, 3)
        num_green += bool((np.abs(around.astype(int) - UPRIGHT).sum(axis=1) < 40).any())
    assert num_green > 0.8 * len(edges)
    # The horizon: level directions before the camera vanish on it.
    rows, columns = np.nonzero(np.abs(panel.astype(int) - HORIZON).sum(axis=2) < 40)
    slope, height = np.polyfit(columns, rows, 1)
    x, y, z = BUILDING.rotation[:, 2] / BUILDING.rotation[2, 2] * 0.85 * SIZE[0] * scale
    expected = y + SIZE[1] * scale / 2.0
    assert slope * (x + 796.0) + height == pytest.approx(expected, abs=25.0)
    assert z > 0.0


def test_what_cannot_be_read_is_passed_over_and_nothing_is_overwritten(
    tmp_path: Path, drawing: GrayImage
) -> None:
    (tmp_path / "photos").mkdir()
    good = write_image(tmp_path / "photos" / "a.png", drawing[:400, :600])
    blank = write_image(tmp_path / "photos" / "b.png", np.full((60, 90), 128, np.uint8))
    bad = tmp_path / "photos" / "bad.png"
    bad.write_bytes(b"")
    found = report_lines([bad, good, blank, good], tmp_path / "out")
    assert list(found.photographs) == [str(good), str(blank)]
    assert list(found.failures) == [str(bad)]
    assert str(bad) not in found.failures[str(bad)]  # the summary names it before
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "a.png-lines.png",
        "b.png-lines.png",
    ]
    lines = found.summary().splitlines()
    assert len(lines) == 5
    assert "0 straight lines are too few" in lines[1]
    assert f"{bad}: not read: " in lines[2]
    assert found.to_mapping()["photographs"][str(blank)]["focal_px"] is None
    with pytest.raises(OptionError, match=r"a\.png-lines\.png"):
        report_lines([good], tmp_path / "out")
    with pytest.raises(OptionError):
        report_lines([good], tmp_path / "photos" / "a.png" / "x")


def test_photographs_of_one_name_have_pictures_of_their_own(
    tmp_path: Path, drawing: GrayImage
) -> None:
    paths = []
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        paths.append(write_image(tmp_path / name / "1.png", drawing[:400, :600]))
    found = report_lines(paths, tmp_path / "out")
    assert [found.pictures[str(path)] for path in paths] == [
        tmp_path / "out" / "left" / "1.png-lines.png",
        tmp_path / "out" / "right" / "1.png-lines.png",
    ]
    assert all(path.is_file() for path in found.pictures.values())


def test_a_place_that_is_taken_is_refused_before_anything_is_drawn(
    tmp_path: Path, drawing: GrayImage
) -> None:
    paths = []
    for name in ("a.png", "b.png"):
        (tmp_path / name[0]).mkdir()
        paths.append(write_image(tmp_path / name[0] / name, drawing[:400, :600]))
    with pytest.raises(OptionError, match="lies in the folder of the photographs"):
        report_lines(paths, tmp_path / "b" / "out")
    assert not (tmp_path / "b" / "out").exists()


def test_a_photograph_that_is_stored_on_its_side_has_the_upright_of_its_picture(
    tmp_path: Path, drawing: GrayImage
) -> None:
    upright = camera_from_lines(write_image(tmp_path / "a.png", drawing)).up
    assert upright is not None
    right, down, ahead = upright
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # the camera was turned to the right
    path = tmp_path / "b.png"
    Image.fromarray(np.rot90(drawing)).save(path, exif=exif)
    found = camera_from_lines(path).up
    assert found == pytest.approx((down, -right, ahead), abs=0.03)
    reports = report_lines([path])
    assert reports.photographs[str(path)].up == found
