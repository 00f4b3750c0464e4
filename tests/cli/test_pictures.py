"""Commands that draw: sheets of features and lines, matches of pairs."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
from command import Call
from PIL import Image

from colmap_affrect.colmap.tables import rows_digest

FACADE = (
    Path(__file__).parents[2]
    / "sample_scenes"
    / "facade"
    / "images"
    / "view_5_tilt70.jpg"
)


SMALL = "max_image_size_px=240"


def test_inspect_draws_a_sheet(tmp_path: Path, call: Call) -> None:
    out = tmp_path / "out č"
    done = call(
        "inspect", FACADE, "--output-path", out, "--recipe", "rectified", "--set", SMALL
    )
    assert (done.code, done.stderr) == (0, [])
    sheet = out / "view_5_tilt70-inspection.png"
    assert sheet.stat().st_size > 50_000
    assert str(sheet) in done.stdout


def test_lines_go_on_past_what_cannot_be_read(tmp_path: Path, call: Call) -> None:
    bad = tmp_path / "photographs" / "bad.jpg"
    bad.parent.mkdir()
    bad.write_bytes(b"no image")
    out = tmp_path / "pictures"
    done = call("lines", bad, FACADE, "--output-path", out)
    assert done.code == 1
    assert f"{FACADE}: the lines tell a focal length of " in done.stdout
    assert f"{bad}: not read: " in done.stdout
    assert "could not read 1 of the images" in done.stderr[-1]
    assert (out / f"{FACADE.name}-lines.png").stat().st_size > 50_000
    again = call("lines", FACADE, "--output-path", out)
    assert (again.code, again.stdout) == (2, "")  # a picture is there already
    numbers = json.loads(
        call("lines", FACADE, bad, "--json", "--max-failures", 1).stdout
    )
    assert numbers["photographs"][str(FACADE)]["is_known"]
    assert list(numbers["failures"]) == [str(bad)]


def test_show_pair_draws_matches_of_a_run_and_of_any_database(
    verified: Path, photos: Path, tmp_path: Path, call: Call
) -> None:
    digest = rows_digest(verified / "database.db")
    names = ["a.png", "side/č.png"]
    for _ in range(2):  # the second picture takes the place of the first
        done = call("show-pair", verified, *names)
        assert (done.code, done.stderr) == (0, [])
    said, path = done.stdout.splitlines()
    assert re.match(
        r"a\.png and side/č\.png: \d+ matches by identity, \d+ inliers, \d+% of",
        said,
    )
    assert path == str(verified / "pairs" / "a--side-č.png")
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert picture.width == 1596
        assert 500 < picture.height < 800
    copied = tmp_path / "any.db"
    shutil.copy(verified / "database.db", copied)
    given = ["show-pair", copied, *names, "--image-path", photos, "--output-path"]
    done = call(*given, tmp_path / "pair.png")
    assert (done.code, done.stderr) == (0, [])
    assert (
        done.stdout.splitlines()[0]
        == said.partition(" by ")[0] + ", " + said.split(", ")[1]
    )
    before = (tmp_path / "pair.png").read_bytes()
    done = call(*given, tmp_path / "pair.png")
    assert (done.code, done.stderr[0].endswith("give another name or folder")) == (
        2,
        True,
    )
    assert (tmp_path / "pair.png").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["any.db", "pair.png"]
    assert rows_digest(verified / "database.db") == digest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("OUT a.pgn side/č.png", "a.pgn: no such photograph (did you mean 'a.png'?)"),
        ("OUT a.png a.png", "a.png, a.png: never matched"),
        (
            "OUT/database.db a.png side/č.png",
            "--image-path: give the folder of the photographs",
        ),
        (
            "OUT/database.db a.png side/č.png --image-path PHOTOS",
            "--output-path: give the name",
        ),
        (
            "OUT a.png side/č.png --output-path NEW/pair.jpg",
            "new file that ends in .png",
        ),
        (
            "OUT a.png side/č.png --output-path PHOTOS/pair.png",
            "in the folder of the photographs",
        ),
        (
            "PHOTOS a.png side/č.png",
            "database.db: no such file; give a COLMAP database",
        ),
    ],
)
def test_show_pair_says_what_it_lacks_and_makes_nothing(
    verified: Path,
    photos: Path,
    tmp_path: Path,
    arguments: str,
    message: str,
    call: Call,
) -> None:
    for name, path in {
        "OUT": verified,
        "PHOTOS": photos,
        "NEW": tmp_path / "new",
    }.items():
        arguments = arguments.replace(name, str(path))
    before = sorted(photos.rglob("*"))
    done = call("show-pair", *arguments.split())
    assert (done.code, done.stdout, len(done.stderr)) == (2, "", 1)
    assert message in done.stderr[0]
    assert sorted(photos.rglob("*")) == before
    assert not list(tmp_path.iterdir())
