"""Which pairs are matched: by features, by position, by name, together, and when images come."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from command import FAST, Call
from small_scene import photograph
from synthetic import write_image

from colmap_affrect.cli import main
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import image_ids, nearest_positions, open_database
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.pairs.lists import PairOptions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context
from colmap_affrect.stages import pairs as stage

WGS84 = pycolmap.PosePriorCoordinateSystem.WGS84
CARTESIAN = pycolmap.PosePriorCoordinateSystem.CARTESIAN

ROOM_OF = {"1.png": 0, "2.png": 10, "3.png": 0, "4.png": 10, "10.png": 0}
"""Two rooms, photographed in turn."""
OF_ONE_ROOM = ["1.png 10.png", "1.png 3.png", "10.png 3.png", "2.png 4.png"]


def write_rooms(folder: Path, names: list[str]) -> None:
    folder.mkdir(exist_ok=True)
    for index, name in enumerate(ROOM_OF):
        if name in names:
            position = (0.2 * index - 0.4, -0.1 * index, 0.05 * index)
            write_image(
                folder / name, photograph(position, -2.0 * index, ROOM_OF[name])
            )


@pytest.fixture(scope="module")
def extracted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with four of the five photographs and their features; nothing may be changed in it."""
    folder = tmp_path_factory.mktemp("rooms")
    write_rooms(folder / "photos", ["1.png", "2.png", "3.png", "4.png"])
    extract(folder)
    return folder


@pytest.fixture
def rooms(extracted: Path, tmp_path: Path) -> Workspace:
    """A copy of the features, to be changed."""
    return Workspace(Path(shutil.copytree(extracted / "out", tmp_path / "out")))


def extract(folder: Path) -> None:
    command = [
        "extract",
        "--image-path",
        folder / "photos",
        "--output-path",
        folder / "out",
    ]
    assert main([str(argument) for argument in [*command, "-q", *FAST]]) == 0


def choose(call: Call, workspace: Workspace, *arguments: object) -> list[str]:
    code, _, stderr = call("pairs", "--output-path", workspace.path, "-q", *arguments)
    assert (code, stderr) == (0, [])
    return workspace.pairs.read_text().splitlines()


def test_photographs_of_one_room_are_chosen_by_their_features(
    rooms: Workspace, call: Call
) -> None:
    arguments = ["--pairs", "retrieval", "--num-neighbors", 1]
    assert choose(call, rooms, *arguments) == ["1.png 3.png", "2.png 4.png"]


@pytest.mark.long
def test_pairs_stay_and_come_when_photographs_come(
    extracted: Path, tmp_path: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(extracted / "photos", tmp_path / "photos")
    extract(tmp_path)
    rooms = Workspace(tmp_path / "out")
    arguments = ["--pairs", "retrieval", "--num-neighbors", 1]
    before = choose(call, rooms, *arguments)
    with monkeypatch.context() as patch:
        patch.setattr(
            stage, "retrieved_pairs", None
        )  # nothing has come: it is not called
        assert choose(call, rooms, *arguments) == before
    write_rooms(tmp_path / "photos", ["10.png"])
    extract(tmp_path)
    after = choose(call, rooms, *arguments)
    assert set(before) < set(after) <= set(OF_ONE_ROOM)
    assert any("10.png" in pair for pair in after)


def test_methods_and_a_list_are_joined(rooms: Workspace, call: Call) -> None:
    listed = rooms.path.parent / "list.txt"
    listed.write_text("4.png 1.png\n")
    given = [
        "--pairs",
        "retrieval,sequence",
        "--num-neighbors",
        1,
        "--match-list-path",
        listed,
    ]
    pairs = ["1.png 2.png", "1.png 3.png", "1.png 4.png", "2.png 3.png", "2.png 4.png"]
    assert choose(call, rooms, *given) == [*pairs, "3.png 4.png"]
    assert rooms.record()["pairs"] == {
        "match_list_path": str(listed), "methods": ["retrieval", "sequence"], "num_neighbors": 1,
        "max_distance_m": 100.0,
    }  # fmt: skip


def test_gps_without_positions_is_refused_and_nothing_discarded(
    rooms: Workspace, call: Call
) -> None:
    before = choose(call, rooms)
    code, stdout, stderr = call(
        "pairs", "--output-path", rooms.path, "--pairs", "gps,sequence", "--overwrite"
    )
    assert (code, stdout, len(stderr)) == (1, "", 1)
    assert "0 images have a position" in stderr[0]
    assert rooms.pairs.read_text().splitlines() == before


def test_pairs_by_gps_and_sequence_together(rooms: Workspace) -> None:
    write_positions(
        rooms.database, {"1.png": (50.0, 14.0, 0.0), "4.png": (50.0, 14.001, 500.0)}
    )
    stage.choose_pairs(
        Context(rooms), PairOptions(methods=("gps", "sequence"), num_neighbors=1)
    )
    assert rooms.pairs.read_text().splitlines() == [
        "1.png 2.png",
        "1.png 4.png",
        "2.png 3.png",
        "3.png 4.png",
    ]


def write_positions(
    path: Path,
    positions: dict[str, tuple[float, float, float]],
    system: pycolmap.PosePriorCoordinateSystem = WGS84,
) -> None:
    ids = image_ids(path)
    with open_database(path) as database:
        for name, position in positions.items():
            prior = pycolmap.PosePrior(
                position=np.array(position), coordinate_system=system
            )
            prior.corr_data_id = database.read_image(ids[name]).data_id
            database.write_pose_prior(prior)


def test_nearest_positions_are_in_metres_and_few(rooms: Workspace) -> None:
    # A degree of latitude is 111 km; 1, 2 and 4 lie 33 m and 44 m apart, 3 is another 3.3 km away.
    latitudes = {"1.png": 50.0, "2.png": 50.0003, "4.png": 50.0007, "3.png": 50.03}
    write_positions(
        rooms.database, {name: (lat, 14.0, 0.0) for name, lat in latitudes.items()}
    )
    assert nearest_positions(rooms.database, 1, 100.0) == [
        ("1.png", "2.png"),
        ("2.png", "4.png"),
    ]
    assert nearest_positions(rooms.database, 2, 40.0) == [("1.png", "2.png")]
    assert ("3.png", "4.png") in nearest_positions(rooms.database, 1, 10_000.0)
    assert len(nearest_positions(rooms.database, 3, 10_000.0)) == 6


def test_nearest_positions_take_cartesian_ones_and_images_without(
    rooms: Workspace,
) -> None:
    positions = {
        "1.png": (0.0, 0.0, 0.0),
        "2.png": (3.0, 4.0, 9.0),
        "3.png": (0.0, 20.0, 0.0),
    }
    write_positions(rooms.database, positions, CARTESIAN)
    assert nearest_positions(rooms.database, 5, 5.1) == [("1.png", "2.png")]


def test_positions_that_are_none_on_earth_do_not_count(
    rooms: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    nowhere = (0.0, 0.0, 0.0)
    positions = {"1.png": (50.0, 14.0, 0.0), "2.png": nowhere, "3.png": nowhere}
    write_positions(rooms.database, {**positions, "4.png": (50.0, 14.001, 0.0)})
    stage.choose_pairs(Context(rooms), PairOptions(methods=("gps",)))
    assert rooms.pairs.read_text().splitlines() == ["1.png 4.png"]
    assert "2.png (latitude 0, longitude 0: no position was known)" in caplog.text
    assert (
        "gps: 2 of 4 photographs were not taken within 100 m of another one"
        in caplog.text
    )
    assert "; raise pairs.max_distance_m, or choose" in caplog.text


def test_no_pair_by_gps_is_an_error(rooms: Workspace) -> None:
    far = {
        "1.png": (50.0, 14.0, 0.0),
        "2.png": (96.0, 14.0, 0.0),
        "3.png": (14.0, 50.0, 0.0),
    }
    write_positions(rooms.database, far)
    with pytest.raises(
        AffrectError, match="by its position no photograph was taken within 100 m"
    ):
        stage.choose_pairs(Context(rooms), PairOptions(methods=("gps",)))
    assert not rooms.pairs.exists()


@pytest.mark.parametrize(("values", "named"), [
    ({"methods": ("gps", "retrival")}, "'retrival': should be 'exhaustive', 'retrieval'"),
    ({"methods": ()}, "methods"),
    ({"num_neighbors": 0}, "num_neighbors=0"),
])  # fmt: skip
def test_wrong_options_are_refused(values: dict[str, object], named: str) -> None:
    with pytest.raises(OptionError, match=named):
        PairOptions.from_mapping(values, "pairs")
