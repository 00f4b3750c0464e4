"""Files of hloc and deep-image-matching go into databases and out again, exactly and safely."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command import Call
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from small_scene import INTRINSICS, write_photographs
from synthetic import write_image

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError, DatabaseError, OptionError, StoreError
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.interop.hdf5 import InterchangeReport, export_h5, import_h5
from colmap_affrect.interop.hdf5_layouts import ForeignFiles, Source
from colmap_affrect.pipeline import RunOptions

Array = NDArray[Any]
Datasets = Mapping[str, Any]

NAMES = ["a.png", "sub/b c.png", "sub/č.png", "sub_x/d.png"]
SIZE = (64, 48)
"""(width, height) of the photographs; not square, so that swapped sizes are found out."""

PINHOLE = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)


# hloc's readers, written anew from the description of its files.


def hloc_names(path: Path) -> set[str]:
    found = set()

    def visit(_: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found.add(item.parent.name.strip("/"))

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return found


def hloc_matches(path: Path, name0: str, name1: str) -> tuple[Array, Array]:
    first, second = name0.replace("/", "-"), name1.replace("/", "-")
    with h5py.File(path, "r") as file:
        is_reversed = f"{first}/{second}" not in file
        group = file[f"{second}/{first}" if is_reversed else f"{first}/{second}"]
        matches, scores = group["matches0"][()], group["matching_scores0"][()]
    rows = np.flatnonzero(matches != -1)
    pairs = np.stack([rows, matches[rows]], axis=-1)
    return pairs[:, ::-1] if is_reversed else pairs, scores[rows]


# Files as those programs write them.


def write_h5(path: Path, groups: Mapping[str, Datasets]) -> Path:
    with h5py.File(path, "w") as file:
        for key, datasets in groups.items():
            group = file.create_group(key) if key else file
            for name, values in datasets.items():
                group.create_dataset(name, data=values)
    return path


def points(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform((0, 0), SIZE, (count, 2)).astype(np.float32)


def hloc_group(count: int, seed: int = 0, **more: Any) -> dict[str, Any]:
    return {
        "keypoints": points(count, seed),
        "descriptors": np.zeros((8, count), np.float16),
        "scores": np.ones(count, np.float32),
        "image_size": np.array(SIZE),
        **more,
    }


def match_group(matches0: list[int], dtype: type = np.int16) -> dict[str, Any]:
    return {
        "matches0": np.array(matches0, dtype),
        "matching_scores0": np.full(len(matches0), 0.5, np.float16),
    }


def write_photos(folder: Path, names: list[str], size: tuple[int, int] = SIZE) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, np.full(size[::-1], 90, np.uint8))
    return folder


class Files:
    """Photographs, files of features and matches, and the database to be made from them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.photos = write_photos(folder / "photos", NAMES)
        self.features = folder / "features.h5"
        self.matches = folder / "matches.h5"
        self.database = folder / "new.db"
        groups = {name: hloc_group(3 + n, n) for n, name in enumerate(NAMES)}
        write_h5(self.features, groups)
        write_h5(self.matches, {"a.png/sub-b c.png": match_group([2, -1, 0])})

    def import_all(self, **options: Any) -> InterchangeReport:
        options = {"skip_verification": True, **options}
        return import_h5(self.photos, self.features, self.matches, self.database, **options)

    def keypoints(self, name: str) -> Array:
        return read_database(self.database)[0][name]

    def pairs(self) -> dict[tuple[str, str], list[list[int]]]:
        return read_database(self.database)[1]


def read_database(path: Path) -> tuple[dict[str, Array], dict[tuple[str, str], list[list[int]]]]:
    database = pycolmap.Database.open(path)
    images = database.read_all_images()
    keypoints = {image.name: database.read_keypoints(image.image_id) for image in images}
    pairs = {}
    for first in images:
        for second in images:
            ids = first.image_id, second.image_id
            if first.name < second.name and database.exists_matches(*ids):
                pairs[first.name, second.name] = database.read_matches(*ids).tolist()
    database.close()
    return keypoints, pairs


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


@pytest.fixture
def targets(tmp_path: Path) -> tuple[Path, Path]:
    return tmp_path / "features.h5", tmp_path / "matches.h5"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Photographs of the small scene and the output folder of a run."""
    folder = tmp_path_factory.mktemp("run")
    write_photographs(folder / "photos")
    colmap_affrect.run(folder / "photos", folder / "out", RunOptions(cameras=PINHOLE))
    return folder / "photos", folder / "out"


def one_line(error: pytest.ExceptionInfo[AffrectError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# Import.


def test_centres_move_by_half_a_pixel_once_and_in_float32(files: Files) -> None:
    half = np.array([[3.25, 17.5], [1027.0, 2.0]], np.float16)  # steps of 1 px: no room for 0.5
    write_h5(
        files.features,
        {"a.png": {"keypoints": half}, "sub/b c.png": {"keypoints": [[7.0, 11.125]]}},
    )
    write_h5(files.matches, {})
    files.import_all()
    assert files.keypoints("a.png").tolist() == [[3.75, 18.0], [1027.5, 2.5]]
    assert files.keypoints("sub/b c.png").tolist() == [[7.5, 11.625]]
    files.database.unlink()
    files.import_all(pixel_origin="corner")
    assert files.keypoints("a.png").tolist() == [[3.25, 17.5], [1027.0, 2.0]]


def test_frames_become_affine_shapes_of_one_sigma(files: Files) -> None:
    lafs = np.array([[[6.0, 12.0, 5.0], [-18.0, 24.0, 9.0]]], np.float32)
    data = {"keypoints": [[5.0, 9.0]], "lafs": lafs, "scales": [1.0], "oris": [0.0]}
    write_h5(files.features, {"a.png": data})
    write_h5(files.matches, {})
    files.import_all()
    assert files.keypoints("a.png").tolist() == [[5.5, 9.5, 1.0, 2.0, -3.0, 4.0]]


def test_orientation_has_the_sign_of_colmap_both_ways(files: Files) -> None:
    angle = np.deg2rad(30.0)
    turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    frame = np.concatenate([6 * 2.5 * turned, [[4.0], [8.0]]], axis=1)[None]
    write_h5(
        files.features,
        {
            "a.png": {"keypoints": [[4.0, 8.0]], "scales": [2.5], "oris": [30.0]},
            "sub/b c.png": {"keypoints": [[4.0, 8.0]], "lafs": frame},
        },
    )
    write_h5(files.matches, {})
    files.import_all()
    columns = files.keypoints("a.png")
    assert_allclose(columns, [[4.5, 8.5, 2.5, angle]], rtol=1e-6)
    # COLMAP finds the same orientation in the six columns made of the frame.
    x, y, a11, a12, a21, a22 = files.keypoints("sub/b c.png")[0].tolist()
    colmap = pycolmap.FeatureKeypoint(x=x, y=y, a11=a11, a12=a12, a21=a21, a22=a22)
    assert colmap.compute_orientation() == pytest.approx(angle, rel=1e-6)
    assert colmap.compute_scale() == pytest.approx(2.5, rel=1e-6)
    out = files.folder / "out.h5", files.folder / "out_matches.h5"
    export_h5(*out, database_path=files.database)
    with h5py.File(out[0], "r") as file:
        for name in ("a.png", "sub/b c.png"):
            assert_allclose(file[name]["oris"][()], [30.0], rtol=1e-5)
            assert_allclose(file[name]["scales"][()], [2.5], rtol=1e-5)
        assert "lafs" not in file["a.png"]
        assert_allclose(file["sub/b c.png"]["lafs"][()], frame, rtol=1e-5)


@pytest.mark.parametrize("separator", ["/", "_"])
@pytest.mark.parametrize("is_reversed", [False, True])
def test_all_of_hlocs_keys_are_read(files: Files, separator: str, is_reversed: bool) -> None:
    # Rows of matches0 belong to the first name of the key.
    names = ["sub-b c.png", "a.png"] if is_reversed else ["a.png", "sub-b c.png"]
    matches0 = [2, -1, -1, 0] if is_reversed else [3, -1, 0]
    write_h5(files.matches, {separator.join(names): match_group(matches0)})
    report = files.import_all()
    ((pair, indices),) = files.pairs().items()
    assert (pair, sorted(indices)) == (("a.png", "sub/b c.png"), [[0, 3], [2, 0]])
    assert (report.layout, report.num_pairs, report.num_matches) == ("hloc", 1, 2)


def test_pairs_given_twice_or_of_one_image_are_reported(files: Files) -> None:
    write_h5(
        files.matches,
        {
            "a.png/sub-b c.png": match_group([1, -1, -1]),
            "sub-b c.png/a.png": match_group([2, -1, -1, -1]),
            "a.png_sub-b c.png": match_group([3, -1, -1]),
            "a.png/a.png": match_group([0, 1, 2]),
        },
    )
    report = files.import_all()
    assert files.pairs() == {("a.png", "sub/b c.png"): [[0, 1]]}
    assert report.notes == (
        "pairs that are there twice, the second is left out: sub-b c.png/a.png, a.png_sub-b c.png",
        "images matched with themselves are left out: a.png/a.png",
    )
    assert report.summary().splitlines()[1].startswith("note: pairs that are there twice")


def test_images_without_features_are_imported_and_named_and_not_exported(files: Files) -> None:
    write_h5(files.features, {"a.png": hloc_group(3), "sub/b c.png": hloc_group(0)})
    write_h5(files.matches, {"a.png/sub-b c.png": match_group([-1, -1, -1])})
    report = files.import_all()
    keypoints, pairs = read_database(files.database)
    assert {name: len(values) for name, values in keypoints.items()} == {
        "a.png": 3, "sub/b c.png": 0, "sub/č.png": 0, "sub_x/d.png": 0
    }  # fmt: skip
    assert pairs == {("a.png", "sub/b c.png"): []}
    assert report.notes == (
        "images without features are there without keypoints: sub/č.png, sub_x/d.png",
    )
    assert (report.num_images, report.num_keypoints) == (4, 3)
    targets = files.folder / "out.h5", files.folder / "out_matches.h5"
    report = export_h5(*targets, database_path=files.database)
    assert report.notes == ("images without keypoints are left out: sub/č.png, sub_x/d.png",)
    assert hloc_names(targets[0]) == {"a.png", "sub/b c.png"}


def dim_group(count: int, seed: int = 0) -> dict[str, Any]:
    group = hloc_group(count, seed, tile_idx=np.zeros(count, np.float16))
    return {**group, "image_size": np.array(SIZE[::-1])}


@pytest.mark.parametrize("layout", ["auto", "dim"])
def test_file_names_of_deep_image_matching_are_found_in_folders(files: Files, layout: str) -> None:
    write_h5(files.features, {"a.png": dim_group(3), "b c.png": dim_group(4, 1)})
    write_h5(files.matches, {"b c.png": {"a.png": np.array([[3, 0], [1, 2]])}})
    report = files.import_all(layout=layout)
    assert report.layout == "dim"
    assert files.pairs() == {("a.png", "sub/b c.png"): [[0, 3], [2, 1]]}
    assert_array_equal(files.keypoints("sub/b c.png"), points(4, 1) + np.float32(0.5))


def test_keypoints_without_groups_are_read(files: Files) -> None:
    write_h5(files.features, {"": {"a.png": points(3), "č.png": points(2, 1)}})
    write_h5(files.matches, {"a.png": {"č.png": np.array([[2, 1]], np.int32)}})
    files.import_all()
    assert files.pairs() == {("a.png", "sub/č.png"): [[2, 1]]}
    assert_array_equal(files.keypoints("sub/č.png"), points(2, 1) + np.float32(0.5))


def test_import_writes_the_database_only_and_leaves_an_existing_one(files: Files) -> None:
    before = {path: path.stat().st_mtime_ns for path in files.folder.rglob("*") if path.is_file()}
    files.import_all()
    after = {path: path.stat().st_mtime_ns for path in files.folder.rglob("*") if path.is_file()}
    assert after.pop(files.database)
    assert after == before
    content = files.database.read_bytes()
    with pytest.raises(DatabaseError, match=r"new\.db: exists already"):
        files.import_all()
    assert files.database.read_bytes() == content


def change_features(**datasets: Any) -> Callable[[Files], object]:
    groups = {"a.png": {**hloc_group(3), **datasets}, "sub/b c.png": hloc_group(4)}
    return lambda files: write_h5(files.features, groups)


def change_matches(**groups: Datasets) -> Callable[[Files], object]:
    return lambda files: write_h5(
        files.matches, {k.replace("__", "/"): v for k, v in groups.items()}
    )


def link(files: Files, target: object) -> None:
    with h5py.File(files.features, "a") as file:
        file["sub_x/e.png"] = target


def outside_data(files: Files) -> None:
    (files.folder / "secret").write_bytes(bytes(64))
    with h5py.File(files.features, "w") as file:
        external = [(str(files.folder / "secret"), 0, 64)]
        file.create_dataset("a.png/keypoints", (4, 2), "f8", external=external)


def virtual_data(files: Files) -> None:
    layout = h5py.VirtualLayout((4, 2), "f8")
    layout[:] = h5py.VirtualSource(files.folder / "other.h5", "data", (4, 2))
    with h5py.File(files.features, "w") as file:
        file.create_virtual_dataset("a.png/keypoints", layout)


def huge(files: Files) -> None:
    with h5py.File(files.features, "a") as file:
        del file["a.png/keypoints"]
        file.create_dataset("a.png/keypoints", (10**12, 2), "f4", chunks=(1000, 2))


def bad_name(files: Files) -> None:
    with h5py.File(files.features, "a") as file:
        file.create_group(b"\xff\xfe")


def ambiguous_old_key(files: Files) -> None:
    names = [f"{name}.png" for name in ["a", "b"]] + ["a.png_b.png", "b.png_a.png"]
    write_photos(files.photos, names)
    write_h5(files.features, {name: hloc_group(2) for name in names})
    write_h5(files.matches, {"a.png_b.png_a.png": match_group([0, 1])})


def two_names_one_key(files: Files) -> None:
    names = ["sub/x-y.png", "sub-x/y.png"]
    write_photos(files.photos, names)
    write_h5(files.features, {name: hloc_group(2) for name in names})
    write_h5(files.matches, {})


def two_names_one_file_name(files: Files) -> None:
    write_photos(files.photos, ["sub_x/a.png"])
    write_h5(files.features, {"a.png": dim_group(2), "d.png": dim_group(2)})
    write_h5(files.matches, {"a.png": {"d.png": [[0, 0]]}})


ERRORS: dict[str, tuple[Callable[[Files], object], str]] = {
    "features missing": (lambda f: f.features.unlink(), r"features\.h5: no such file"),
    "no HDF5": (lambda f: f.features.write_bytes(b"PK" * 99), r"features\.h5: not an HDF5 file"),
    "empty": (lambda f: f.matches.write_bytes(b""), r"matches\.h5: not an HDF5 file"),
    "cut": (
        lambda f: f.features.write_bytes(f.features.read_bytes()[:4000]),
        r"features\.h5: (not an HDF5 file|damaged)",
    ),
    "name without UTF-8": (bad_name, r"features\.h5: damaged"),
    "no features": (lambda f: write_h5(f.features, {}), "holds no keypoints"),
    "other images": (
        lambda f: write_h5(f.features, {"a.png": hloc_group(1), "z/y.png": hloc_group(1)}),
        r"images that are not in .*photos: z/y\.png$",
    ),
    "way out": (
        lambda f: write_h5(f.features, {"../a.png": hloc_group(1)}),
        r"images that are not in .*photos: \.\./a\.png$",
    ),
    "soft link": (lambda f: link(f, h5py.SoftLink("/a.png")), r"not followed: sub_x/e\.png"),
    "external link": (
        lambda f: link(f, h5py.ExternalLink("/etc/x.h5", "/a.png")),
        r"not followed: sub_x/e\.png",
    ),
    "data in another file": (outside_data, r"not followed: a\.png/keypoints"),
    "virtual data": (virtual_data, r"not followed: a\.png/keypoints"),
    "huge": (huge, "too large to be true"),
    "three columns": (
        change_features(keypoints=np.zeros((3, 3))),
        r"a\.png/keypoints has shape \(3, 3\), expected \(N, 2\)",
    ),
    "text": (change_features(keypoints=np.full((3, 2), b"x")), "does not hold numbers"),
    "NaN": (
        change_features(keypoints=[[1.0, 2.0], [np.nan, 3.0]]),
        r"a\.png/keypoints holds values that are not finite",
    ),
    "beyond all images": (
        change_features(keypoints=[[1.0, -1e30]]), r"a\.png/keypoints or its shapes hold values"
    ),
    "beyond float32": (
        change_features(keypoints=[[1e300, 2.0]]), r"a\.png/keypoints or its shapes hold values"
    ),
    "frames of others": (
        change_features(lafs=np.zeros((4, 2, 3))),
        r"a\.png/lafs has shape \(4, 2, 3\), expected \(3, 2, 3\)",
    ),
    "negative scale": (
        change_features(scales=[1.0, -1.0, 1.0], oris=np.zeros(3)), "scales holds negative"
    ),
    "other size": (
        change_features(image_size=[65, 48]),
        r"a\.png was 65 x 48 px for the features, and the photograph is 64 x 48 px",
    ),
    "turned": (change_features(image_size=[48, 64]), "turned by its EXIF orientation"),
    "key of two names": (two_names_one_key, r"sub-x/y\.png and sub/x-y\.png have the same key"),
    "file name of two": (
        two_names_one_file_name, r"a\.png may be any of a\.png, sub_x/a\.png"
    ),
    "old key of two pairs": (ambiguous_old_key, r"may be any of .*a\.png \+ b\.png_a\.png"),
    "other pair": (
        change_matches(**{"a.png__z.png": match_group([0, 1, 2])}),
        r"matches of images that have no features: a\.png/z\.png",
    ),
    "pair beyond the end": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, 4, 2])}),
        r"matches of a\.png and sub/b c\.png point at keypoint 4 of sub/b c\.png, which has 4",
    ),
    "16 bits overrun": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, -25536, 2])}),
        "point at keypoint -25536",
    ),
    "other number of keypoints": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, 1, 2, 3])}),
        r"matches0 has shape \(4,\), expected \(3,\)",
    ),
    "real matches": (
        change_matches(**{"a.png__sub-b c.png": match_group([0, 1, 2], np.float32)}),
        "does not hold integers",
    ),
    "rows beyond the end": (
        change_matches(**{"a.png": {"b c.png": [[3, 0]]}}),
        r"point at keypoint 3 of a\.png, which has 3",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", ERRORS)
def test_each_fault_is_one_clear_line_and_no_database(files: Files, case: str) -> None:
    spoil, message = ERRORS[case]
    if case == "rows beyond the end":
        write_h5(files.features, {"a.png": dim_group(3), "b c.png": dim_group(3)})
    spoil(files)
    with pytest.raises(StoreError, match=message) as error:
        files.import_all()
    one_line(error)
    assert not [path for path in files.folder.iterdir() if "import" in path.name]
    assert not files.database.exists()


def test_matches_of_another_layout_than_asked_for_are_refused(files: Files) -> None:
    with pytest.raises(StoreError, match=r"have no features: a\.png/sub-b c\.png/"):
        files.import_all(layout="dim")
    write_h5(files.matches, {"a.png": {"b c.png": [[0, 0]]}})
    with pytest.raises(StoreError, match="holds no 'matches0'"):
        files.import_all(layout="hloc")
    with pytest.raises(OptionError, match="layout 'kapture': not one of auto, hloc, dim"):
        files.import_all(layout="kapture")


WRITER = """
import sys, time, h5py
file = h5py.File(sys.argv[1], "w", libver="latest")
file["a.png/keypoints"] = [[1.0, 2.0]]
file.flush()
print("written", flush=True)
time.sleep(60)
"""


def test_file_in_writing_and_of_a_killed_writer_are_told_apart(files: Files) -> None:
    command = [sys.executable, "-c", WRITER, str(files.features)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout.readline() == "written\n"
        with pytest.raises(StoreError, match="another program is writing it"):
            files.import_all()
        os.kill(writer.pid, signal.SIGKILL)
    with pytest.raises(StoreError, match=r"h5clear --status features\.h5"):
        files.import_all()


# Export.


def test_our_own_files_are_read_by_hlocs_rules(finished: tuple[Path, Path]) -> None:
    _, out = finished
    keypoints, pairs = read_database(out / "database.db")
    assert hloc_names(out / "features.h5") == set(keypoints)
    assert hloc_names(out / "matches.h5") == {
        f"{first}/{second}".replace("side/", "side-") for first, second in pairs
    }
    with h5py.File(out / "features.h5", "r") as file:
        for name, columns in keypoints.items():
            data = {key: values[()] for key, values in file[name].items()}
            assert_array_equal(data["keypoints"] + 0.5, columns[:, :2])
            assert data["image_size"].tolist() == [320, 240]
            assert data["descriptors"].shape == (128, len(columns))
            assert data["scores"].shape == (len(columns),)
            lengths = np.linalg.norm(data["descriptors"].astype(np.float32), axis=0)
            assert_allclose(lengths, 1.0, atol=1e-2)
    for pair, indices in pairs.items():
        found, scores = hloc_matches(out / "matches.h5", *pair)
        assert sorted(found.tolist()) == sorted(indices)
        assert ((scores > 0) & (scores <= 1)).all()
        turned, _ = hloc_matches(out / "matches.h5", *pair[::-1])
        assert_array_equal(turned, found[:, ::-1])


@pytest.mark.parametrize("layout", ["hloc", "dim"])
@pytest.mark.parametrize("source", ["folder", "database"])
def test_export_and_import_give_the_same_database(
    finished: tuple[Path, Path], tmp_path: Path, source: str, layout: str
) -> None:
    photos, out = finished
    before = {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()}
    files = tmp_path / "features.h5", tmp_path / "matches.h5"
    origin = {"output_path": out} if source == "folder" else {"database_path": out / "database.db"}
    exported = export_h5(*files, layout=layout, **origin)
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.is_file()} == before
    assert {path.name for path in tmp_path.iterdir()} == {"features.h5", "matches.h5"}
    imported = import_h5(photos, *files, tmp_path / "new.db", cameras=PINHOLE, layout=layout)
    assert exported.num_keypoints == imported.num_keypoints
    assert exported.num_matches == imported.num_matches
    assert (imported.num_pairs, imported.num_verified, imported.notes) == (6, 6, ())
    keypoints, pairs = read_database(out / "database.db")
    new_keypoints, new_pairs = read_database(tmp_path / "new.db")
    assert new_pairs == pairs
    assert new_keypoints.keys() == keypoints.keys()
    for name, columns in keypoints.items():
        assert_allclose(new_keypoints[name], columns, rtol=1e-6, atol=1e-6)


def test_exported_folder_has_real_descriptors_of_32_bits_and_scales(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    _, out = finished
    export_h5(*targets, output_path=out)
    with h5py.File(targets[0], "r") as new, h5py.File(out / "features.h5", "r") as own:
        group, ours = new["side/č.png"], own["side/č.png"]
        assert set(group) == {
            "keypoints", "descriptors", "scores", "image_size", "lafs", "scales", "oris"
        }  # fmt: skip
        for name in ("keypoints", "descriptors", "scores", "lafs"):
            assert group[name].dtype == np.float32
            assert_array_equal(group[name][()], ours[name][()].astype(np.float32))
        assert group["image_size"].dtype.kind == "i"
    assert targets[0].read_bytes()[8] == 0  # libver "latest" would not be 0


def make_database(
    path: Path, keypoints: Mapping[str, Array], matches: Mapping[tuple[str, str], Any]
) -> pycolmap.Database:
    """Make a database of images of 64 x 48 px; it is left open."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 70.0, *SIZE)
    camera_id = database.write_camera(camera)
    ids = {}
    for name, columns in keypoints.items():
        ids[name] = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        database.write_keypoints(ids[name], np.asarray(columns, np.float32))
    for (first, second), indices in matches.items():
        database.write_matches(ids[first], ids[second], np.asarray(indices, np.uint32))
    return database


@pytest.mark.parametrize(("count", "dtype"), [(32_767, np.int16), (40_000, np.int32)])
def test_indices_beyond_16_bits_are_written_in_32(
    tmp_path: Path, targets: tuple[Path, Path], count: int, dtype: type
) -> None:
    many = np.column_stack([np.arange(count), np.zeros(count)])
    pairs = {("a.png", "b.png"): [[0, count - 1], [1, 5]]}
    make_database(tmp_path / "x.db", {"a.png": many[:2], "b.png": many}, pairs).close()
    export_h5(*targets, database_path=tmp_path / "x.db")
    with h5py.File(targets[1], "r") as file:
        assert file["a.png/b.png/matches0"].dtype == dtype
        assert file["a.png/b.png/matches0"][()].tolist() == [count - 1, 5]
        assert file["a.png/b.png/matching_scores0"].dtype == np.float16
        assert file["a.png/b.png/matching_scores0"][()].tolist() == [1.0, 1.0]


def test_descriptors_of_a_database_become_real_ones(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    columns = {name: points(2) for name in ("a.png", "b.png", "c.png")}
    database = make_database(tmp_path / "x.db", columns, {})
    bytes128 = np.arange(256, dtype=np.uint8).reshape(2, 128)
    reals = np.linspace(-1, 1, 128).reshape(2, 64).astype(np.float32)
    sift, aliked = (getattr(pycolmap.FeatureExtractorType, n) for n in ("SIFT", "ALIKED_N32"))
    database.write_descriptors(1, pycolmap.FeatureDescriptors(type=sift, data=bytes128))
    database.write_descriptors(
        2, pycolmap.FeatureDescriptors(type=aliked, data=reals.view(np.uint8))
    )
    database.close()
    export_h5(*targets, database_path=tmp_path / "x.db")
    with h5py.File(targets[0], "r") as file:
        assert_array_equal(file["a.png/descriptors"][()], bytes128.T / np.float32(512))
        assert_array_equal(file["b.png/descriptors"][()], reals.T)
        assert "descriptors" not in file["c.png"]


def test_half_rounds_everything_and_says_so(tmp_path: Path, targets: tuple[Path, Path]) -> None:
    make_database(tmp_path / "x.db", {"a.png": [[1500.75, 3.125]]}, {}).close()
    report = export_h5(*targets, database_path=tmp_path / "x.db", half=True)
    assert "coordinates are rounded: float16" in report.summary()
    with h5py.File(targets[0], "r") as file:
        assert file["a.png/keypoints"].dtype == np.float16
        assert file["a.png/keypoints"][()].tolist() == [[1500.0, 2.625]]
        assert file["a.png/image_size"].dtype.kind == "i"


def test_second_match_of_a_keypoint_is_left_out_of_hlocs_files_only(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    indices = [[1, 2], [0, 1], [1, 0]]
    columns = {name: points(3) for name in ("a.png", "b.png")}
    make_database(tmp_path / "x.db", columns, {("a.png", "b.png"): indices}).close()
    report = export_h5(*targets, database_path=tmp_path / "x.db")
    assert report.num_matches == 2
    assert "1 matches are left out" in report.summary()
    assert hloc_matches(targets[1], "a.png", "b.png")[0].tolist() == [[0, 1], [1, 2]]
    for path in targets:
        path.unlink()
    report = export_h5(*targets, database_path=tmp_path / "x.db", layout="dim")
    assert (report.num_matches, report.notes) == (3, ())
    with h5py.File(targets[1], "r") as file:
        assert file["a.png/b.png"][()].tolist() == indices
    with h5py.File(targets[0], "r") as file:
        assert file["a.png/image_size"][()].tolist() == [48, 64]


@pytest.mark.parametrize(
    ("names", "layout", "message"),
    [
        (["a/b-c.png", "a-b/c.png"], "hloc", "have the same key"),
        (["a/b.png", "c/b.png"], "dim", r"which these share: a/b\.png, c/b\.png"),
        (["a.png", "a.png/b.png"], "hloc", r"a\.png: is an image and the folder of another"),
        (["../a.png"], "hloc", r"no plain relative paths: \.\./a\.png"),
        (["/photos/a.png"], "hloc", r"no plain relative paths: /photos/a\.png"),
        (["./a.png"], "dim", r"no plain relative paths: \./a\.png"),
    ],
)
def test_names_that_the_layout_cannot_hold_are_refused(
    tmp_path: Path, targets: tuple[Path, Path], names: list[str], layout: str, message: str
) -> None:
    make_database(tmp_path / "x.db", {name: points(1) for name in names}, {}).close()
    with pytest.raises(StoreError, match=message) as error:
        export_h5(*targets, database_path=tmp_path / "x.db", layout=layout)
    one_line(error)
    assert {path.name for path in tmp_path.iterdir()} == {"x.db"}


def test_wrong_database_is_refused_and_no_half_file_stays(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    columns = {"a.png": points(2), "b.png": points(2)}
    make_database(tmp_path / "range.db", columns, {("a.png", "b.png"): [[1, 2]]}).close()
    with pytest.raises(DatabaseError, match=r"range\.db: pairs with matches of keypoints that do"):
        export_h5(*targets, database_path=tmp_path / "range.db")
    make_database(tmp_path / "three.db", {"a.png": np.zeros((2, 3))}, {}).close()
    with pytest.raises(DatabaseError, match=r"do not have 2, 4 or 6 columns \(a\.png"):
        export_h5(*targets, database_path=tmp_path / "three.db")
    database = make_database(tmp_path / "rows.db", {"a.png": points(2)}, {})
    data = np.zeros((3, 128), np.uint8)
    sift = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(1, pycolmap.FeatureDescriptors(type=sift, data=data))
    database.close()
    with pytest.raises(DatabaseError, match=r"a\.png has 2 keypoints and 3 descriptors"):
        export_h5(*targets, database_path=tmp_path / "rows.db")
    with pytest.raises(DatabaseError, match="no such file"):
        export_h5(*targets, database_path=tmp_path / "none.db")
    assert {path.suffix for path in tmp_path.iterdir()} == {".db"}


def test_export_overwrites_nothing_and_needs_one_source(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    features, matches = targets
    _, out = finished
    matches.write_bytes(b"mine")
    with pytest.raises(StoreError, match=r"matches\.h5: exists already"):
        export_h5(features, matches, output_path=out)
    assert matches.read_bytes() == b"mine"
    assert not features.exists()
    with pytest.raises(StoreError, match="need a file each"):
        export_h5(features, features, output_path=out)
    matches.unlink()
    with pytest.raises(OptionError, match="either an output folder or a database"):
        export_h5(features, matches)
    with pytest.raises(StoreError, match=r"nowhere: no such folder"):
        export_h5(features.parent / "nowhere" / "f.h5", matches, output_path=out)


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from colmap_affrect.errors import AffrectError
from colmap_affrect.interop.hdf5 import export_h5
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
try:
    export_h5(Path(sys.argv[1]), Path(sys.argv[2]), output_path=Path(sys.argv[3]))
except AffrectError as error:
    print(error)
"""


def test_full_disk_is_one_line_and_leaves_nothing(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    arguments = [sys.executable, "-c", FULL_DISK, *map(str, targets), str(finished[1])]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{targets[0]}: cannot be written (")
    assert done.stdout.count("\n") == 1
    assert not list(targets[0].parent.iterdir())


def test_names_of_all_kinds_come_back(tmp_path: Path, targets: tuple[Path, Path]) -> None:
    names = ["e\u0301🗻 #,'/B_-.png", "b.png"]
    photos = write_photos(tmp_path / "photos", names)
    make_database(tmp_path / "x.db", {name: points(2, n) for n, name in enumerate(names)}, {
        tuple(names): [[1, 0]]
    }).close()  # fmt: skip
    export_h5(*targets, database_path=tmp_path / "x.db")
    assert hloc_names(targets[0]) == set(names)
    import_h5(photos, *targets, tmp_path / "new.db", skip_verification=True)
    keypoints, pairs = read_database(tmp_path / "new.db")
    for n, name in enumerate(names):
        assert_allclose(keypoints[name], points(2, n), atol=1e-5)
    assert pairs == {tuple(sorted(names)): [[0, 1]]}


# Command line.


def test_commands_export_and_import_and_print_no_more_than_progress(
    finished: tuple[Path, Path], tmp_path: Path, call: Call
) -> None:
    photos, out = finished
    files = (
        "--features-path", tmp_path / "f.h5", "--matches-path", tmp_path / "m.h5",
    )  # fmt: skip
    done = call("export-h5", "--output-path", out, *files, "--quiet")
    assert (done.code, done.stderr) == (0, [])
    assert done.stdout.startswith("exported (hloc): 4 images, ")
    done = call(
        "import-h5", "--image-path", photos, *files, "--database-path", tmp_path / "new.db",
        "--camera-mode", "single", "--camera-model", "PINHOLE", "--camera-params", INTRINSICS,
    )  # fmt: skip
    assert done.code == 0, done.stderr
    assert "6 pairs, 6 verified" in done.stdout
    assert {line.split(":")[0] for line in done.stderr} == {
        "keypoints", "matches", "verify"
    }  # fmt: skip
    assert {path.name for path in tmp_path.iterdir()} == {"f.h5", "m.h5", "new.db"}


@pytest.mark.parametrize(("width", "fits"), [(2051, True), (2057, False)])
def test_size_in_float16_is_compared_as_it_is_rounded(
    tmp_path: Path, width: int, fits: bool
) -> None:
    """As deep-image-matching writes it: 2051 px are stored as 2052."""
    path = tmp_path / "features.h5"
    with h5py.File(path, "w") as file:
        file["a/image_size"] = np.array([2051, 1500], np.float16)
    with h5py.File(path, "r") as file:
        source = Source(path, file, {"a/image_size": (2,)})
        files = ForeignFiles(source, source, "hloc", {"a": "a"}, {}, [])
        with nullcontext() if fits else pytest.raises(StoreError, match="was 2052 x 1500 px"):
            files.check_size("a", (width, 1500))
