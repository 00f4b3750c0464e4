"""Databases become files of hloc, and output folders have such files."""

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
)
from numpy.testing import assert_allclose, assert_array_equal
from small_scene import INTRINSICS

import colmap_affrect
from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import DatabaseError, OptionError, StoreError
from colmap_affrect.interop.hdf5 import export_h5, import_h5
from colmap_affrect.pipeline import RunOptions

pytestmark = pytest.mark.long


@pytest.fixture
def targets(tmp_path: Path) -> tuple[Path, Path]:
    return tmp_path / "features.h5", tmp_path / "matches.h5"


@pytest.fixture(scope="module")
def finished(
    photos: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Path]:
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


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the content of the files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.parametrize("source", ["folder", "database"])
def test_files_of_a_run_and_of_its_database_give_the_same_database(
    finished: tuple[Path, Path], tmp_path: Path, source: str
) -> None:
    photos, out = finished
    before = files_of(out)
    folder = out
    if source == "database":
        folder = tmp_path
        exported = export_h5(
            out / "database.db", folder / "features.h5", folder / "matches.h5"
        )
    imported = import_h5(
        photos,
        folder / "features.h5",
        folder / "matches.h5",
        tmp_path / "new.db",
        cameras=PINHOLE,
    )
    assert files_of(out) == before
    assert (imported.num_pairs, imported.num_verified) == (6, 6)
    if source == "database":
        assert exported.num_keypoints == imported.num_keypoints
        assert exported.num_matches == imported.num_matches
        assert files_of(tmp_path).keys() == {"features.h5", "matches.h5", "new.db"}
    keypoints, pairs = read_database(out / "database.db")
    new_keypoints, new_pairs = read_database(tmp_path / "new.db")
    assert new_pairs == pairs
    assert new_keypoints.keys() == keypoints.keys()
    for name, columns in keypoints.items():
        assert_allclose(new_keypoints[name], columns, rtol=1e-6, atol=1e-6)


def test_descriptors_of_a_database_become_real_ones(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    columns = {name: points(2) for name in ("a.png", "b.png", "c.png")}
    database = make_database(tmp_path / "x.db", columns, {})
    bytes128 = np.arange(256, dtype=np.uint8).reshape(2, 128)
    reals = np.linspace(-1, 1, 128).reshape(2, 64).astype(np.float32)
    sift, aliked = (
        getattr(pycolmap.FeatureExtractorType, n) for n in ("SIFT", "ALIKED_N32")
    )
    database.write_descriptors(1, pycolmap.FeatureDescriptors(type=sift, data=bytes128))
    database.write_descriptors(
        2, pycolmap.FeatureDescriptors(type=aliked, data=reals.view(np.uint8))
    )
    database.close()
    export_h5(tmp_path / "x.db", *targets)
    with h5py.File(targets[0], "r") as file:
        assert_array_equal(file["a.png/descriptors"][()], bytes128.T / np.float32(512))
        assert_array_equal(file["b.png/descriptors"][()], reals.T)
        assert "descriptors" not in file["c.png"]


def test_second_match_of_a_keypoint_is_left_out(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    columns = {name: points(3) for name in ("a.png", "b.png")}
    pairs = {("a.png", "b.png"): [[1, 2], [0, 1], [1, 0]]}
    make_database(tmp_path / "x.db", columns, pairs).close()
    export_h5(tmp_path / "x.db", *targets)
    assert hloc_matches(targets[1], "a.png", "b.png")[0].tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a/b-c.png", "a-b/c.png"], "have the same key"),
        (["a.png", "a.png/b.png"], r"a\.png: is an image and the folder of another"),
        (["../a.png"], r"no plain relative paths: \.\./a\.png"),
        (["/photos/a.png"], r"no plain relative paths: /photos/a\.png"),
        (["./a.png"], r"no plain relative paths: \./a\.png"),
    ],
)
def test_names_that_hlocs_files_cannot_hold_are_refused(
    tmp_path: Path, targets: tuple[Path, Path], names: list[str], message: str
) -> None:
    make_database(tmp_path / "x.db", {name: points(1) for name in names}, {}).close()
    with pytest.raises(StoreError, match=message) as error:
        export_h5(tmp_path / "x.db", *targets)
    one_line(error)
    assert {path.name for path in tmp_path.iterdir()} == {"x.db"}


def test_wrong_database_is_refused_and_no_half_file_stays(
    tmp_path: Path, targets: tuple[Path, Path]
) -> None:
    columns = {"a.png": points(2), "b.png": points(2)}
    make_database(
        tmp_path / "range.db", columns, {("a.png", "b.png"): [[1, 2]]}
    ).close()
    with pytest.raises(
        DatabaseError, match=r"range\.db: pairs with matches of keypoints that do"
    ):
        export_h5(tmp_path / "range.db", *targets)
    database = make_database(tmp_path / "rows.db", {"a.png": points(2)}, {})
    data = np.zeros((3, 128), np.uint8)
    sift = pycolmap.FeatureExtractorType.SIFT
    database.write_descriptors(1, pycolmap.FeatureDescriptors(type=sift, data=data))
    database.close()
    with pytest.raises(
        DatabaseError, match=r"a\.png has 2 keypoints and 3 descriptors"
    ):
        export_h5(tmp_path / "rows.db", *targets)
    with pytest.raises(OptionError, match="no such file"):
        export_h5(tmp_path / "none.db", *targets)
    assert {path.suffix for path in tmp_path.iterdir()} == {".db"}


def test_export_overwrites_nothing(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    features, matches = targets
    database = finished[1] / "database.db"
    matches.write_bytes(b"mine")
    with pytest.raises(OptionError, match=r"matches\.h5: exists"):
        export_h5(database, features, matches)
    assert matches.read_bytes() == b"mine"
    assert not features.exists()
    with pytest.raises(OptionError, match="need a file each"):
        export_h5(database, features, features)
    matches.unlink()
    made = export_h5(database, features.parent / "new" / "f.h5", matches)
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
    export_h5(Path(sys.argv[3]), Path(sys.argv[1]), Path(sys.argv[2]))
except AffrectError as error:
    print(error)
"""


@pytest.mark.long
def test_full_disk_is_one_line_and_leaves_nothing(
    finished: tuple[Path, Path], targets: tuple[Path, Path]
) -> None:
    arguments = [
        sys.executable,
        "-c",
        FULL_DISK,
        *map(str, targets),
        str(finished[1] / "database.db"),
    ]
    done = subprocess.run(
        arguments, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"{targets[0]}: cannot be written (")
    assert done.stdout.count("\n") == 1
    assert not list(targets[0].parent.iterdir())


def test_commands_export_and_import_and_print_no_more_than_progress(
    finished: tuple[Path, Path], tmp_path: Path, call: Call
) -> None:
    photos, out = finished
    files = (
        "--features-path", tmp_path / "f.h5", "--matches-path", tmp_path / "m.h5",
    )  # fmt: skip
    done = call("export-h5", "--database-path", out / "database.db", *files, "--quiet")
    assert (done.code, done.stderr) == (0, [])
    assert done.stdout.startswith("exported: 4 images, ")
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
