"""Output folders and databases become files of hloc and deep-image-matching."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import Call
from h5_files import (
    PINHOLE,
    hloc_matches,
    hloc_names,
    make_database,
    one_line,
    points,
    read_database,
    write_photos,
)
from numpy.testing import assert_allclose, assert_array_equal
from small_scene import INTRINSICS

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import DatabaseError, OptionError, StoreError
from colmap_affrect.interop.hdf5 import export_h5, import_h5
from colmap_affrect.pipeline import RunOptions


@pytest.fixture
def targets(tmp_path: Path) -> tuple[Path, Path]:
    return tmp_path / "features.h5", tmp_path / "matches.h5"


@pytest.fixture(scope="module")
def finished(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Photographs of the small scene and the output folder of a run."""
    out = tmp_path_factory.mktemp("run") / "out"
    colmap_affrect.run(photos, out, RunOptions(cameras=PINHOLE), page=False)
    return photos, out


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
            areas = np.linalg.det(columns[:, 2:].reshape(-1, 2, 2))
            assert_allclose(data["scales"], np.sqrt(areas), rtol=1e-4)
            turns = np.rad2deg(np.arctan2(columns[:, 4], columns[:, 2]))
            assert_allclose(data["oris"], turns, atol=1e-3)
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
    assert {path.name for path in tmp_path.iterdir()} == {"features.h5", "matches.h5", "new.db"}
    keypoints, pairs = read_database(out / "database.db")
    new_keypoints, new_pairs = read_database(tmp_path / "new.db")
    assert new_pairs == pairs
    assert new_keypoints.keys() == keypoints.keys()
    for name, columns in keypoints.items():
        assert_allclose(new_keypoints[name], columns, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("count", "dtype"), [(32_767, np.int16), (40_000, np.int32)])
def test_indices_beyond_16_bits_are_written_in_32(
    tmp_path: Path, targets: tuple[Path, Path], count: int, dtype: type
) -> None:
    many = np.column_stack([np.linspace(0.0, 60.0, count), np.zeros(count)])
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
    with pytest.raises(DatabaseError, match=r"do not have 2, 4 or 6 columns.* \(a\.png"):
        export_h5(*targets, database_path=tmp_path / "three.db")
    database = make_database(tmp_path / "rows.db", {"a.png": points(2)}, {})
    data = np.zeros((3, 128), np.uint8)
    sift = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(1, pycolmap.FeatureDescriptors(type=sift, data=data))
    database.close()
    with pytest.raises(DatabaseError, match=r"a\.png has 2 keypoints and 3 descriptors"):
        export_h5(*targets, database_path=tmp_path / "rows.db")
    with pytest.raises(OptionError, match="no such file"):
        export_h5(*targets, database_path=tmp_path / "none.db")
    assert {path.suffix for path in tmp_path.iterdir()} == {".db"}


def test_export_overwrites_nothing_and_needs_one_source(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    features, matches = targets
    _, out = finished
    matches.write_bytes(b"mine")
    with pytest.raises(OptionError, match=r"matches\.h5: exists"):
        export_h5(features, matches, output_path=out)
    assert matches.read_bytes() == b"mine"
    assert not features.exists()
    with pytest.raises(StoreError, match="need a file each"):
        export_h5(features, features, output_path=out)
    matches.unlink()
    with pytest.raises(OptionError, match="either an output folder or a database"):
        export_h5(features, matches)
    made = export_h5(features.parent / "new" / "f.h5", matches, output_path=out)
    assert (features.parent / "new" / "f.h5").is_file()
    assert made.num_images == 4


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
