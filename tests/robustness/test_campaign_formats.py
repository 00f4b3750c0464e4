"""Campaign (tests/campaign.py): files that are what they say in an unusual way, or are not."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import pytest
from campaign import CAMPAIGN, PLAIN, assert_clear
from command import Call, run_in_process_of_its_own

pytestmark = CAMPAIGN


def write_pgm(path: Path, picture: Path, white: int, *, is_text: bool) -> None:
    """Write a picture with other numbers for the same tones."""
    image = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    values = (image.astype(int) * white + 127) // 255
    height, width = values.shape
    header = (
        f"P{2 if is_text else 5}\n# of a scanner\n{width} {height}\n{white}\n".encode()
    )
    numbers = " ".join(map(str, values.ravel())).encode()
    stored = values.astype(">u2" if white > 255 else "u1").tobytes()
    path.write_bytes(header + (numbers if is_text else stored))


@pytest.mark.parametrize(
    ("white", "is_text"), [(31, False), (4095, False), (4095, True)]
)
def test_photographs_with_any_white_are_registered(
    scene: Path, tmp_path: Path, call: Call, white: int, is_text: bool
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    pictures = sorted((scene / "photos").rglob("*.png"))
    for number, picture in enumerate(pictures):
        write_pgm(folder / f"{number}.pgm", picture, white, is_text=is_text)
    out = tmp_path / "out"
    ended = call(
        "run",
        "--image-path",
        folder,
        "--output-path",
        out,
        *PLAIN,
        "--no-page",
        "--json",
    )
    assert_clear(ended, 0)
    assert len(ended.report["registered_names"]) == len(pictures)


def test_database_in_utf_16_is_mapped(scene: Path, tmp_path: Path, call: Call) -> None:
    path = tmp_path / "utf-16.db"
    with (
        closing(sqlite3.connect(scene / "any.db")) as source,
        closing(sqlite3.connect(path)) as target,
    ):
        target.execute("PRAGMA encoding = 'UTF-16'")
        for statement in source.iterdump():
            if "sqlite_sequence" not in statement:
                target.execute(statement)
        (version,) = source.execute("PRAGMA user_version").fetchone()
        target.execute(f"PRAGMA user_version = {version}")
        target.commit()
    out = tmp_path / "out"
    assert_clear(
        call("map", "--from-database", path, "--output-path", out, "-q", "--no-page"), 0
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_text_in_the_place_of_a_database_is_named(
    tmp_path: Path, call: Call, encoding: str
) -> None:
    path = tmp_path / "any.db"
    path.write_text("a.png b.png\n" * 99, encoding=encoding)
    ended = call("map", "--from-database", path, "--output-path", tmp_path / "out")
    assert_clear(ended, 1)
    assert "does not begin as files of SQLite do" in ended.errors[0]


def test_long_file_with_a_small_picture_is_not_copied(
    scene: Path, tmp_path: Path, call: Call
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    picture = next((scene / "photos").rglob("*.png"))
    (folder / "a.png").write_bytes(picture.read_bytes())
    with (folder / "b.png").open("wb") as file:
        file.write(picture.read_bytes())
        file.truncate(3_000_000_000)
    ended = call(
        "convert", "--image-path", folder, "--output-path", tmp_path / "photos"
    )
    assert "3.0 GB long" in ended.stdout + "".join(ended.stderr)
    assert sorted(path.name for path in (tmp_path / "photos").iterdir()) == ["a.png"]


def test_limit_of_the_environment_is_not_called_damage(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", "1000")
    given = ["--image-path", scene / "photos", "--output-path", tmp_path / "out"]
    ended = run_in_process_of_its_own("run", *given, *PLAIN)
    said = ended.stdout + "".join(ended.stderr)
    assert "OPENCV_IO_MAX_IMAGE_PIXELS=1000" in said
    assert "damaged" not in said
    assert "Traceback" not in said
