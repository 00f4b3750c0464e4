"""Pictures of pairs: lines where the matches are, in the colour of their kind, and which pairs."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from filelock import FileLock
from small_comparison import write_scene
from small_run import small_report
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.errors import OptionError
from colmap_affrect.geometry.arrays import Indices
from colmap_affrect.project.guided_store import GuidedPair
from colmap_affrect.project.reasons import Doubt, Missing
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.report import pairs
from colmap_affrect.report.pair_choice import backed_pairs, pairs_to_check
from colmap_affrect.report.pair_lines import (
    MAX_NUM_PAIRS,
    MAX_NUM_PAIRS_IN_FILES,
    MIN_NUM_LINES_OF_PAIR,
    NUM_PAIRS_OF_FILE,
    LinesOfRun,
    num_lines_of_pair,
)
from colmap_affrect.report.pair_matches import MatchedPair, MatchKind, PairReader
from colmap_affrect.report.pairs import COLORS, draw_matches
from colmap_affrect.report.sheets import WIDTH_PX, rgb
from colmap_affrect.session import view_graph
from colmap_affrect.session.view_graph import ViewGraph
from colmap_affrect.stages.map import agreements

NAMES = ("a.png", "b.png", "c.png", "d.png", "e.png", "f.png")
SIZES = [(400, 300), (150, 300)]
PHOTOGRAPHS = [np.zeros((height, width, 3), np.uint8) for width, height in SIZES]
SIDE = WIDTH_PX // 2 - 4  # longest side of what is drawn of a photograph


def matched(first: Any, second: Any, kinds: Any) -> MatchedPair:
    points = [np.asarray(side, np.float64) for side in (first, second)]
    return MatchedPair(SIZES, points, np.asarray(kinds, np.int64), "")


def test_lines_join_the_matches_in_the_colours_of_their_kinds() -> None:
    """One photograph is wide and one high: their scales differ."""
    pair = matched(
        [(100.0, 30.0), (390.0, 290.0)],
        [(30.0, 150.0), (140.0, 10.0)],
        [MatchKind.OWN, MatchKind.GUIDED],
    )
    drawn = draw_matches(pair, PHOTOGRAPHS)
    assert drawn.shape == (SIDE, WIDTH_PX, 3)
    scales = (SIDE / 400, SIDE / 300)
    distances = np.full(drawn.shape[:2], np.inf)  # of pixels from the nearest line
    rows, columns = np.indices(distances.shape)
    for index, kind in enumerate((MatchKind.OWN, MatchKind.GUIDED)):
        first, second = (
            pair.points[side][index] * scales[side] - 0.5 for side in (0, 1)
        )
        second[0] += WIDTH_PX // 2
        for share in (0.0, 0.3, 1.0):
            x, y = np.rint(first + share * (second - first)).astype(int)
            around = drawn[y - 1 : y + 2, x - 1 : x + 2].reshape(-1, 3).astype(int)
            assert np.abs(around - rgb(COLORS[kind])).sum(axis=1).min() < 30
        normal = np.array([first[1] - second[1], second[0] - first[0]])
        normal /= np.linalg.norm(normal)
        offsets = (columns - first[0]) * normal[0] + (rows - first[1]) * normal[1]
        distances = np.minimum(distances, np.abs(offsets))
    drawn[int(scales[0] * 300) :, : WIDTH_PX // 2] = (
        0  # white below the wide photograph
    )
    drawn[:, SIDE : WIDTH_PX // 2] = drawn[
        :, WIDTH_PX // 2 + int(scales[1] * 150) :
    ] = 0
    assert distances[drawn.any(axis=2)].max() < 6


def test_photographs_that_were_shrunk_get_the_same_lines() -> None:
    pair = matched([(100.0, 30.0)], [(30.0, 150.0)], [MatchKind.WARPED])
    small = [np.ascontiguousarray(image[::2, ::2]) for image in PHOTOGRAPHS]
    np.testing.assert_array_equal(
        draw_matches(pair, small), draw_matches(pair, PHOTOGRAPHS)
    )


@pytest.mark.parametrize("count", [0, 1, 199, 1001])
def test_numbers_of_lines_are_bounded_for_inliers_and_the_others(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(pairs.cv2, "line", lambda *given: drawn.append(given[3]))
    kinds = [MatchKind.OWN] * count + [MatchKind.REJECTED] * 3 * count
    points = np.full((len(kinds), 2), 40.0)
    draw_matches(matched(points, points, kinds), PHOTOGRAPHS)
    for kind, num in ((MatchKind.OWN, count), (MatchKind.REJECTED, 3 * count)):
        assert drawn.count(rgb(COLORS[kind])) == min(num, 200)


def num_keypoints(path: Path) -> dict[str, int]:
    """Keypoints in a database by image."""
    with open_database(path) as database:
        images = database.read_all_images()
        return {i.name: database.num_keypoints_for_image(i.image_id) for i in images}


class Stores(SimpleNamespace):
    """Of a run whose odd features are of warps; from number 60 on they have no shapes."""

    def __init__(self, folder: Path, begun: list[str]) -> None:
        levels = [
            SimpleNamespace(
                name=name, features=SimpleNamespace(has_shapes=name == "first")
            )
            for name in ("first", "second")
        ]
        super().__init__(
            workspace=SimpleNamespace(
                sparse=folder / "sparse", started_stages=begun, is_changed=False
            ),
            extraction=SimpleNamespace(levels=levels),
            counts=num_keypoints(folder / "database.db"),
            features=self,
            matches=self,
        )

    def read_rectification_ids(self, name: str) -> Indices:
        return np.arange(self.counts[name]) % 2

    def level_ranges(self, _: str) -> dict[int, range]:
        return {0: range(60), 1: range(60, 1000)}

    def levels_of_stored(
        self, asked: list[tuple[str, str]]
    ) -> dict[tuple[str, str], int]:
        return dict.fromkeys(asked, 1)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a database and a model, with one tie point in the photographs 2 and 3.

    Of their matches the first is found by guided matching only, and one raw match is wrong.
    """
    folder = tmp_path_factory.mktemp("scene")
    model, _ = write_scene(folder / "database.db", NAMES)
    ids = [model.find_image_with_name(name).image_id for name in NAMES[2:4]]
    with open_database(folder / "database.db") as database:
        raw = np.asarray(database.read_matches(*ids))
        wrong = np.array([[raw[0, 0], raw[1, 1]]], raw.dtype)
        database.delete_matches(*ids)
        database.write_matches(*ids, np.concatenate([raw[1:], wrong]))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    model.write_text(sparse)
    lines = (sparse / "images.txt").read_text().splitlines()
    track = "99999 0 0 0 0 0 0 0"
    for number, line in enumerate(lines):
        if line.endswith(NAMES[2:4]):
            image_id = int(line.split()[0])
            track += f" {image_id} {len(lines[number + 1].split()) // 3}"
            lines[number + 1] += f" {10 + image_id} 20 99999"
    (sparse / "images.txt").write_text("\n".join([*lines, ""]))
    with (sparse / "points3D.txt").open("a") as file:
        file.write(f"{track}\n")
    return folder


@pytest.mark.parametrize("turned", [False, True])
def test_a_pair_of_a_run_is_known_with_kinds_level_and_model(
    scene: Path, turned: bool
) -> None:
    stores: Any = Stores(scene, ["match"])
    reader = PairReader(ViewGraph(scene / "database.db"), stores)
    names = NAMES[3:1:-1] if turned else NAMES[2:4]
    pair = reader.read(names)
    with open_database(scene / "database.db") as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        ids = [images[name] for name in names]
        inliers = np.asarray(
            database.read_two_view_geometry(*ids).inlier_matches, np.int64
        )
        points = [np.asarray(database.read_keypoints(i)[:, :2]) for i in ids]
        raw = {tuple(row) for row in database.read_matches(*ids).tolist()}
    expected = np.where((inliers % 2).any(axis=1), MatchKind.WARPED, MatchKind.OWN)
    expected[(inliers >= 60).any(axis=1)] = MatchKind.LEARNED
    expected[[tuple(row) not in raw for row in inliers.tolist()]] = MatchKind.GUIDED
    assert np.count_nonzero(expected == MatchKind.GUIDED) == 1
    np.testing.assert_array_equal(
        pair.kinds, [*expected, MatchKind.REJECTED, MatchKind.BY_HAND]
    )
    np.testing.assert_allclose(pair.points[1][: len(inliers)], points[1][inliers[:, 1]])
    marks = [(10.0 + image_id, 20.0) for image_id in ids]
    np.testing.assert_allclose([places[-1] for places in pair.points], marks)
    count = len(inliers)
    assert pair.text == (
        f"{count} matches by second, {count} inliers, 100% of them agree with the model"
    )


def test_of_the_database_of_another_program_inliers_are_of_one_kind(
    scene: Path,
) -> None:
    stores: Any = Stores(scene, [])
    stores.workspace.sparse = scene / "none"
    reader = PairReader(ViewGraph(scene / "database.db"), stores)
    pair = reader.read(NAMES[2:4])
    assert set(pair.kinds.tolist()) == {MatchKind.FOREIGN, MatchKind.REJECTED}
    assert "model" not in pair.text
    stores = Stores(scene, ["match"])
    stores.counts[NAMES[3]] += 1  # the database has others than the run
    pair = PairReader(ViewGraph(scene / "database.db"), stores).read(NAMES[2:4])
    assert set(pair.kinds.tolist()) == {
        MatchKind.FOREIGN,
        MatchKind.REJECTED,
        MatchKind.BY_HAND,
    }
    with pytest.raises(
        OptionError, match=r"c\.jpg: no such photograph \(did you mean 'c\.png'"
    ):
        reader.read(("c.jpg", NAMES[3]))
    with pytest.raises(OptionError, match="never matched"):
        reader.read((NAMES[3], NAMES[3]))


def test_a_pair_without_any_match_is_drawn_too(scene: Path, tmp_path: Path) -> None:
    path = tmp_path / "any.db"
    copy_database(scene / "database.db", path)
    with open_database(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        pair = ids[NAMES[0]], ids[NAMES[1]]
        database.delete_matches(*pair)
        database.delete_two_view_geometry(*pair)
        database.write_matches(*pair, np.zeros((0, 2), np.uint32))
    (tmp_path / "photographs").mkdir()
    for name in NAMES[:2]:
        write_image(tmp_path / "photographs" / name, texture((160, 120), 1))
    said = pairs.draw_pair(
        path, NAMES[:2], tmp_path / "photographs", tmp_path / "pair.png"
    )
    assert said == f"a.png and b.png: 0 matches, 0 inliers\n{tmp_path / 'pair.png'}"


def test_a_model_that_is_turned_contradicts_pairs(scene: Path) -> None:
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    one, other = (model.find_image_with_name(name) for name in NAMES[:2])
    one.frame.rig_from_world = pycolmap.Rigid3d(other.cam_from_world().matrix())
    shares = agreements(ViewGraph(scene / "database.db"), model)
    for pair, share in shares.items():
        assert share < 0.5 if NAMES[0] in pair else share > 0.95


def test_each_sort_of_pairs_is_among_those_to_look_at(tmp_path: Path) -> None:
    model = ModelSummary(
        tuple("abcdef"), 9, 2.0, 0.5, doubtful={"f": (Doubt("few_matches"),)}
    )
    report = replace(
        small_report(tmp_path),
        models=(model,),
        unregistered={"g": Missing("not_registered")},
    )
    verified = {
        ("a", "b"): 900, ("b", "c"): 800, ("c", "d"): 50, ("d", "e"): 40, ("a", "f"): 30,
        ("e", "f"): 20, ("f", "g"): 60, ("a", "c"): 700,
    }  # fmt: skip
    exact = np.zeros((500, 2), np.int64)
    guided = [GuidedPair(("b", "c"), exact, 800), GuidedPair(("a", "b"), exact, 0)]
    agreement = {
        ("a", "c"): 0.1,
        ("a", "e"): 0.0,
        **dict.fromkeys(pairwise("abcde"), 0.9),
    }
    found = pairs_to_check(report, verified, agreement, [("e", "a")], guided)
    assert found == {
        ("a", "c"): "most inliers disagree with the model",
        ("a", "e"): "rejected by hand; most inliers disagree with the model",
        ("a", "f"): "f is doubtful; the strongest pair of f",
        ("f", "g"): "g is missing",
        ("d", "e"): "the strongest pair of e",
        (
            "b",
            "c",
        ): "it alone ties two parts of the model; guided matching found much of it",
        ("c", "d"): "it alone ties two parts of the model; the strongest pair of d",
    }


def test_of_many_pairs_twelve_are_shown_and_without_a_model_the_missing_ones(
    tmp_path: Path,
) -> None:
    names = [f"{number:03d}.jpg" for number in range(150)]
    verified = dict.fromkeys(pairwise(names), 100)
    report = small_report(tmp_path)
    doubtful = dict.fromkeys(names, "why")
    whole = replace(
        report, models=(ModelSummary(tuple(names), 9, 2.0, 0.5, doubtful=doubtful),)
    )
    assert len(pairs_to_check(whole, verified, {})) == 12
    without = replace(
        report, models=(), unregistered={"007.jpg": Missing("not_registered")}
    )
    assert pairs_to_check(without, verified, {}) == {
        ("006.jpg", "007.jpg"): "007.jpg is missing"
    }


def test_what_ties_two_parts_or_a_photograph_alone_is_not_backed_by_the_model() -> None:
    triangles = [*combinations("abc", 2), *combinations("fed", 2)]
    agreement = dict.fromkeys([*triangles, ("d", "c"), ("g", "f")], 0.9)
    agreement[("a", "f")] = 0.4
    backed = {*combinations("abc", 2), *combinations("def", 2)}
    assert backed_pairs(agreement) == backed
    agreement[("a", "f")] = 0.6
    assert backed_pairs(agreement) == backed | {("a", "f"), ("c", "d")}


def test_a_pair_of_long_names_and_of_a_read_only_folder_is_drawn(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(scene, tmp_path / "out"))
    photos = tmp_path / "photos"
    photos.mkdir()
    names = tuple(letter * 240 + ".png" for letter in "xy")
    for old, new in zip(NAMES, names, strict=False):
        write_image(photos / new, texture((320, 240), 1))
        with closing(sqlite3.connect(out / "database.db")) as connection, connection:
            connection.execute("UPDATE images SET name = ? WHERE name = ?", (new, old))
    (out / "run.log").write_text("colmap-affrect 0.1.0: output folder\n")
    shutil.rmtree(out / "sparse")  # which has other names
    said = pairs.draw_pair(out, names, photos)
    picture = Path(said.splitlines()[-1])
    assert picture.is_file()
    assert len(picture.name) < 255

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(FileLock, "acquire", fail)
    pairs.draw_pair(out, names, photos, tmp_path / "pair.png")
    assert (tmp_path / "pair.png").is_file()


def test_a_page_draws_each_pair_and_fewer_lines_of_each_where_there_are_many() -> None:
    """All pairs of 40 photographs fit into the page as it was; more make it grow."""
    assert num_lines_of_pair(0) == num_lines_of_pair(10) == 120
    assert num_lines_of_pair(780) == 30
    assert num_lines_of_pair(MAX_NUM_PAIRS) == 20
    assert MAX_NUM_PAIRS >= 100 * 99 / 2


def test_files_beside_the_page_are_small_and_all_of_them_can_be_kept() -> None:
    """A pair is twenty lines of nine bytes, as base64, and a text of 100 letters."""
    num_bytes = 4 / 3 * 9 * MIN_NUM_LINES_OF_PAIR + 100
    assert 1e6 < num_bytes * NUM_PAIRS_OF_FILE < 3e6
    assert 20e6 < num_bytes * MAX_NUM_PAIRS_IN_FILES < 50e6


def test_images_are_read_once_for_all_pairs_and_levels_together(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stores: Any = Stores(scene, ["match"])
    levels = Mock(wraps=stores.levels_of_stored)
    monkeypatch.setattr(stores, "levels_of_stored", levels)
    images = Mock(wraps=view_graph._read_images)
    monkeypatch.setattr(view_graph, "_read_images", images)
    reader = PairReader(ViewGraph(scene / "database.db"), stores)
    lines = LinesOfRun(reader, NAMES, dict.fromkeys(combinations(NAMES, 2), 30))
    assert len(lines.of_page().pairs) == 15
    assert (images.call_count, levels.call_count) == (1, 1)
