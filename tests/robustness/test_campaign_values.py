"""Campaign (tests/campaign.py): databases and models of others that contradict themselves."""

from __future__ import annotations

import random
import shutil
import sqlite3
import sys
from contextlib import suppress
from pathlib import Path

import pytest
from campaign import CAMPAIGN, TIMES, assert_clear
from command import Call
from damaged import execute

from colmap_affrect.colmap import pycolmap

pytestmark = CAMPAIGN

IDS_OF_TABLES = (
    "cameras.camera_id", "images.camera_id", "rigs.rig_id", "rigs.ref_sensor_id",
    "rigs.ref_sensor_type", "frames.frame_id", "frames.rig_id", "frame_data.frame_id",
    "frame_data.data_id", "frame_data.sensor_id", "frame_data.sensor_type", "keypoints.rows",
    "keypoints.cols", "matches.rows", "two_view_geometries.config", "images.name",
)  # fmt: skip
ODD = (
    "0",
    "-1",
    "1",
    "2",
    "99",
    "5000000000",
    "4294967295",
    "NULL",
    "'x'",
    "1.5",
    "x'00ff'",
)
ADDED = (
    "INSERT INTO rig_sensors VALUES ({}, {}, {}, NULL)",
    "INSERT INTO rigs VALUES ({}, {}, {})",
    "INSERT INTO frames VALUES ({}, {})",
    "INSERT INTO frame_data VALUES ({}, {}, {}, {})",
    "INSERT INTO pose_priors VALUES ({}, {}, {}, {}, zeroblob(24), NULL, NULL, {})",
    "CREATE TRIGGER t AFTER INSERT ON {2} BEGIN DELETE FROM images; END",
)  # fmt: skip


def contradict(path: Path, chance: random.Random) -> str:
    """Change an id, or add a row, by chance; return what was done."""
    while True:
        table, _, column = chance.choice(IDS_OF_TABLES).partition(".")
        where = chance.choice(("", f" WHERE rowid = (SELECT max(rowid) FROM {table})"))
        statement = f"UPDATE {table} SET {column} = {chance.choice(ODD)}{where}"
        if chance.random() < 0.5:
            values = [chance.choice(ODD[:7]) for _ in range(5)]
            values = [chance.choice((value, "1")) for value in values]
            statement = chance.choice(ADDED).replace("{2}", table).format(*values)
        with suppress(sqlite3.Error):  # the tables themselves refuse much of it
            execute(path, statement)
            return statement


@pytest.mark.parametrize("number", range(40 * TIMES))
def test_database_that_contradicts_itself_is_mapped_or_named(
    scene: Path, tmp_path: Path, call: Call, number: int
) -> None:
    chance = random.Random(f"contradict {number}")
    path = Path(shutil.copy(scene / "any.db", tmp_path / "any.db"))
    out = tmp_path / "out"
    done = contradict(path, chance)
    before = path.read_bytes()
    for words in (
        ["map", "--from-database", path, "--output-path", out, "--no-page"],
        ["export-h5", "--database-path", path, "--features-path", tmp_path / "f.h5",
         "--matches-path", tmp_path / "m.h5"],
        ["export-database", path, tmp_path / "old.db"],
    ):  # fmt: skip
        end = call(*words, "-q")
        sys.stdout.write(
            f"{done}; then {words[0]}: {end.stderr}\n"
        )  # shown when the test fails
        assert_clear(end, 0, 1, 2, 3)
        if end.code in (1, 2) and words[0] == "map":
            assert call("doctor", "-q", path).code == 1
    assert path.read_bytes() == before


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e308"])
@pytest.mark.parametrize("what", ["pose", "camera", "point", "name", "no image"])
def test_model_that_nothing_can_be_computed_with_is_named(
    scene: Path, tmp_path: Path, call: Call, what: str, value: str
) -> None:
    model = pycolmap.Reconstruction(scene / "plain")
    odd = float(value)
    first, second = [
        model.image(image_id) for image_id in sorted(model.reg_image_ids())[:2]
    ]
    if what == "pose":
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [odd, 0.0, 0.0])
        model.frame(first.frame_id).set_cam_from_world(first.camera_id, pose)
    elif what == "camera":
        model.cameras[first.camera_id].params = [odd, odd, 160.0, 120.0]
    elif what == "point":
        model.points3D[min(model.points3D)].xyz = [odd, 0.0, 0.0]
    elif what == "name":
        first.name = second.name
    else:
        for frame_id in list(model.reg_frame_ids()):
            model.deregister_frame(frame_id)
    folder = tmp_path / "model"
    folder.mkdir()
    model.write(folder)
    given = ["--model-path", folder, "--output-path", tmp_path / "new"]
    out = ["--output-path", tmp_path / "out", "--extend", folder, "-q"]
    for words in (
        ["export", *given, "--format", "ply,cameras"],
        ["export", *given, "--format", "nerfstudio", "--image-path", scene / "photos"],
        ["align", *given, "--distance", "b-c.png,side/d.png,2.0"],
        ["map", "--from-database", scene / "any.db", *out],
    ):
        assert_clear(call(*words), 1)
    assert not list((tmp_path / "new").glob("*"))
    assert call("doctor", "-q", folder).code == 1
