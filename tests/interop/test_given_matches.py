"""Matches in files of other programs, and images that come with descriptors only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from h5_files import Files, hloc_group, match_group, write_h5, write_photos
from numpy.testing import assert_array_equal
from synthetic import unit_rows

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.errors import OptionError, StoreError
from colmap_affrect.interop.hdf5 import import_h5
from colmap_affrect.project.match_store import MatchStore

PAIR = ("a.png", "sub/b c.png")


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


@pytest.mark.parametrize(
    ("key", "matches0", "expected"),
    [("a.png_sub-b c.png", [3, -1, 0], [[0, 3], [2, 0]]),
     ("sub-b c.png_a.png", [2, -1, -1, 0], [[0, 3], [2, 0]]),
     ("sub_x-d.png_sub-b c.png", [1, -1, -1, -1, -1, -1], [[1, 0]])],
)  # fmt: skip
def test_pair_names_of_older_hloc_are_read(
    files: Files, key: str, matches0: list[int], expected: list[list[int]]
) -> None:
    write_h5(files.matches, {key: match_group(matches0)})
    assert files.import_all().num_pairs == 1
    ((pair, indices),) = files.pairs().items()
    assert sorted(indices) == expected
    assert pair in (PAIR, ("sub/b c.png", "sub_x/d.png"))


def test_features_that_escalation_of_a_run_has_added_follow_those_of_its_matches(
    files: Files,
) -> None:
    write_h5(files.matches, {"sub-b c.png/a.png": match_group([2, -1])})
    with pytest.raises(StoreError, match="matches0 has shape"):
        files.import_all()
    with h5py.File(files.matches, "a") as file:
        file.attrs["format"] = MatchStore.format
    assert files.import_all().num_pairs == 1
    ((_, indices),) = files.pairs().items()
    assert sorted(indices) == [[2, 0]]


def test_older_pair_name_that_stands_for_two_pairs_is_refused(tmp_path: Path) -> None:
    names = ["a.png", "a.png_a.png"]
    write_photos(tmp_path / "photos", names)
    write_h5(tmp_path / "f.h5", {name: hloc_group(3) for name in names})
    write_h5(tmp_path / "m.h5", {"a.png_a.png_a.png": match_group([0, 1, 2])})
    with pytest.raises(
        StoreError, match=r"may stand for a\.png, a\.png_a\.png and a\.png_a\.png"
    ):
        import_h5(
            tmp_path / "photos",
            tmp_path / "f.h5",
            tmp_path / "m.h5",
            tmp_path / "new.db",
        )


def test_files_of_deep_image_matching_are_read(files: Files) -> None:
    for old in ("sub/č.png", "sub_x/d.png"):
        (files.photos / old).unlink()
    group = {"tile_idx": np.zeros(3), "image_size": np.array([48, 64])}  # height, width
    write_h5(
        files.features,
        {"a.png": {**hloc_group(3), **group}, "b c.png": {**hloc_group(4), **group}},
    )
    write_h5(files.matches, {"a.png": {"b c.png": np.array([[0, 3], [2, 1]])}})
    report = files.import_all()
    assert (report.num_pairs, report.num_matches) == (1, 2)
    assert files.pairs() == {PAIR: [[0, 3], [2, 1]]}


def two_folders(tmp_path: Path, names: list[str]) -> Path:
    """Write photographs and features of these names; return where matches go."""
    write_photos(tmp_path / "photos", names)
    write_h5(tmp_path / "f.h5", {name: hloc_group(3) for name in names})
    return tmp_path / "matches"


def import_two_folders(tmp_path: Path, matches: Path) -> int:
    paths = (tmp_path / "photos", tmp_path / "f.h5", matches, tmp_path / "new.db")
    return import_h5(*paths, skip_verification=True).num_pairs


@pytest.mark.parametrize("kind", ["hloc", "hloc, older", "deep-image-matching", "list"])
def test_names_without_folders_are_read_where_one_image_is_called_so(
    tmp_path: Path, kind: str
) -> None:
    def write(path: Path) -> None:
        if kind == "list":
            path.write_text("x.png y.png\n0 2\n", encoding="utf-8")
            return
        nested = {"x.png": {"y.png": np.array([[0, 2]])}}
        separator = "_" if "older" in kind else "/"
        flat = {f"x.png{separator}y.png": match_group([2, -1, -1])}
        write_h5(path, nested if kind == "deep-image-matching" else flat)

    clear = two_folders(tmp_path / "clear", ["a/x.png", "b/y.png"])
    write(clear)
    assert import_two_folders(clear.parent, clear) == 1
    open_to_both = two_folders(tmp_path / "both", ["a/x.png", "b/x.png", "b/y.png"])
    write(open_to_both)
    with pytest.raises(StoreError, match=r"images that have (no )?features"):
        import_two_folders(open_to_both.parent, open_to_both)


def test_whole_names_come_before_names_without_folders_that_look_like_them(
    tmp_path: Path,
) -> None:
    matches = two_folders(tmp_path, ["a.png", "x/y.png", "z/x-y.png"])
    write_h5(matches, {"x-y.png/a.png": match_group([2, -1, -1])})
    assert import_two_folders(tmp_path, matches) == 1
    with open_database(tmp_path / "new.db") as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        assert database.exists_matches(ids["a.png"], ids["x/y.png"])


LIST = """
a.png sub/b c.png
0 3
2 1

sub/b c.png a.png
1 1
sub_x/d.png sub/č.png
5 0

a.png a.png
0 0
"""


@pytest.mark.parametrize("match_type", ["raw", "inliers"])
def test_lists_of_matches_importer_are_read(files: Files, match_type: str) -> None:
    files.matches = files.folder / "matches.txt"
    files.matches.write_text(LIST, encoding="utf-8")
    report = files.import_all(match_type=match_type)
    assert (report.num_pairs, report.num_matches) == (2, 3)
    assert files.pairs() == {
        PAIR: [[0, 3], [2, 1]],
        ("sub/č.png", "sub_x/d.png"): [[0, 5]],
    }
    with open_database(files.database) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        geometry = database.read_two_view_geometry(ids[PAIR[0]], ids[PAIR[1]])
    found = geometry.inlier_matches.tolist()
    assert found == ([[0, 3], [2, 1]] if match_type == "inliers" else [])
    if match_type == "inliers":
        assert geometry.config == pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED


@pytest.mark.parametrize("line", [
    "{folder}/a.png {folder}/sub/b c.png", "{folder}\\a.png {folder}\\sub\\b c.png",
    ".\\a.png .\\sub\\b c.png", "photos/a.png\tphotos/sub/b c.png", "a.png,sub/b c.png,0.93",
])  # fmt: skip
def test_lists_of_matches_may_name_paths_into_the_folder_as_lists_of_pairs(
    files: Files, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    monkeypatch.chdir(files.photos.parent)
    files.matches = files.folder / "matches.txt"
    named = line.format(folder=files.photos)
    files.matches.write_bytes(f"{named}\r\n0 3\r\n2 1\r\n\r\n".encode())
    files.import_all()
    assert files.pairs() == {PAIR: [[0, 3], [2, 1]]}


def test_lists_of_matches_in_another_encoding_are_refused_with_advice(
    files: Files,
) -> None:
    files.matches = files.folder / "matches.txt"
    files.matches.write_text(LIST, encoding="utf-16")
    with pytest.raises(OptionError, match=r"no text in UTF-8; save it as UTF-8"):
        files.import_all()
    assert not files.database.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [("a.png gone.png\n0 0\n", r"line 1: 'a.png gone.png' is not two names of images"),
     ("a.png sub/b c.png\n0 -1\n", r"line 2: '0 -1' is not two names .* nor two numbers"),
     ("a.png sub/b c.png\n0 99\n", r"a\.png, sub/b c\.png: .* keypoints that do not exist"),
     ("a.png sub/b c.png\n0 99999999999999999999\n", r"matches\.txt: "),
     ("# nothing\n", r"holds no matches; give an HDF5 file, or a list of COLMAP")],
)  # fmt: skip
def test_fault_of_a_list_is_one_clear_line_and_no_database(
    files: Files, text: str, message: str
) -> None:
    files.matches = files.folder / "matches.txt"
    files.matches.write_text(text, encoding="utf-8")
    with pytest.raises(StoreError, match=message) as error:
        files.import_all()
    assert "\n" not in str(error.value)
    assert not files.database.exists()


def described(files: Files, size: int, **more: Any) -> dict[str, list[int]]:
    """Write features of the same things in another order in each image; return the orders."""
    random = np.random.default_rng(0)
    things = unit_rows(random.gamma(0.4, size=(30, size)))
    orders = {}
    groups = {}
    for number, name in enumerate(("a.png", "sub/b c.png", "sub/č.png", "sub_x/d.png")):
        order = random.permutation(30)
        places = random.permutation(64 * 48)[:30]
        points = np.stack([places % 64, places // 64], axis=1).astype(np.float32)
        values = things[order] + 0.01 * random.random((30, size))
        data = values if number % 2 else values.T  # both ways are in use
        groups[name] = {"keypoints": points, "descriptors": data, **more}
        orders[name] = order.tolist()
    write_h5(files.features, groups)
    return orders


@pytest.mark.parametrize("size", [128, 64])
def test_features_without_matches_are_matched_and_descriptors_kept_or_named(
    files: Files, size: int
) -> None:
    orders = described(files, size)
    files.matches = None
    report = files.import_all()
    assert report.num_pairs == 6
    for (first, second), indices in files.pairs().items():
        assert len(indices) > 10
        assert all(orders[first][i] == orders[second][j] for i, j in indices)
    with open_database(files.database) as database:
        kept = [database.num_descriptors_for_image(i) for i in range(1, 5)]
    assert kept == [30 * (size == 128)] * 4
    assert ("descriptors are not kept" in report.summary()) == (size != 128)


def test_listed_pairs_alone_are_matched(files: Files) -> None:
    described(files, 64)
    files.matches = None
    (files.folder / "pairs.txt").write_text("a.png sub_x/d.png\n")
    files.import_all(match_list_path=files.folder / "pairs.txt")
    assert list(files.pairs()) == [("a.png", "sub_x/d.png")]
    files.matches = files.folder / "matches.h5"
    with pytest.raises(OptionError, match="only without"):
        files.import_all(match_list_path=files.folder / "pairs.txt")


def test_features_without_descriptors_and_matches_are_refused(files: Files) -> None:
    write_h5(
        files.features,
        {"a.png": {"keypoints": [[1.0, 2.0]]}, "sub/b c.png": hloc_group(3)},
    )
    files.matches = None
    with pytest.raises(StoreError, match=r"no descriptors to match by .*: a\.png$"):
        files.import_all()
    write_h5(files.features, {"a.png": hloc_group(3), "sub/b c.png": hloc_group(3)})
    write_h5(
        files.features, {"a.png": {**hloc_group(3), "descriptors": np.zeros((8, 2))}}
    )
    with pytest.raises(
        StoreError, match=r"descriptors has shape \(8, 2\), expected \(D, 3\)"
    ):
        files.import_all()


def test_descriptors_that_are_not_finite_are_named_with_their_file(
    files: Files,
) -> None:
    described(files, 64)
    with h5py.File(files.features, "a") as file:
        file["sub/b c.png/descriptors"][0, 0] = np.nan
    files.matches = None
    with pytest.raises(
        StoreError, match=r"features\.h5: sub/b c\.png: .* are not finite"
    ):
        files.import_all()


def arrays_of(
    order: np.ndarray, things: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    points = random.uniform(0.0, 500.0, (len(order), 2))
    return points, things[order] + 0.01 * random.random((len(order), things.shape[1]))


def test_arrays_of_two_images_and_of_a_set_are_matched() -> None:
    random = np.random.default_rng(3)
    things = random.gamma(0.4, size=(40, 32))
    orders = {name: random.permutation(40)[:30] for name in "cab"}
    features = {
        name: arrays_of(o, things, n) for n, (name, o) in enumerate(orders.items())
    }
    found = colmap_affrect.match_feature_sets(features)
    assert set(found) == {("a", "b"), ("a", "c"), ("b", "c")}
    for (first, second), matches in found.items():
        rows, columns = matches.indices.T
        assert len(rows) > 15
        assert_array_equal(orders[first][rows], orders[second][columns])
    alone = colmap_affrect.match_descriptors(*features["a"], *features["b"])
    assert_array_equal(alone.indices, found["a", "b"].indices)
    turned = colmap_affrect.match_feature_sets(features, [("b", "a")])
    assert_array_equal(np.sort(turned["b", "a"].indices[:, 1]), alone.indices[:, 0])


def test_whole_numbers_are_sift_and_lengths_do_not_matter() -> None:
    random = np.random.default_rng(4)
    sift = (100 * random.gamma(0.4, size=(30, 128))).clip(0, 255).astype(np.uint8)
    points = random.uniform(0.0, 500.0, (30, 2))
    found = colmap_affrect.match_descriptors(points, sift, points, 3.0 * sift)
    assert_array_equal(found.indices[:, 0], found.indices[:, 1])
    assert len(found.indices) > 25


POINTS = np.arange(12.0).reshape(6, 2)


@pytest.mark.parametrize(
    ("points", "descriptors", "message"),
    [(POINTS, np.ones((5, 8)), r"keypoints \(6, 2\) and descriptors \(5, 8\) do not fit"),
     (POINTS, np.ones((6, 32), np.uint8), r"uint8 of 32 values; .*of bits -1\.0 and 1\.0"),
     (POINTS, np.full((6, 8), np.nan), "not finite"),
     (POINTS, np.ones((6, 16)), r"descriptors of 8 values and .* of 16")],
)  # fmt: skip
def test_arrays_that_do_not_fit_are_refused(
    points: np.ndarray, descriptors: np.ndarray, message: str
) -> None:
    with pytest.raises(OptionError, match=message):
        colmap_affrect.match_descriptors(POINTS, np.ones((6, 8)), points, descriptors)
