"""Scenes laid out as the Image Matching Challenge's, whole and damaged, and made from a model."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from posed_photographs import NAMES, pose, write_calibration, write_imc, write_lists
from small_scene import FOCAL_PX

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.posed_scenes import Imc
from colmap_affrect.evaluation.relative_pose import true_pose

SCRIPT = Path(__file__).parents[2] / "recipes" / "own-evaluation-set" / "imc_from_model.py"
UNCHECKED = Imc()
EMPTY = ", ".join(f"0.{limit}" for limit in range(3, 10))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_imc(tmp_path / "set" / "garden")


def notes(scene: Path) -> list[str]:
    """Notes but the last, of the bins that are empty in this small scene."""
    *found, _ = UNCHECKED.load(scene).notes
    return [note.removeprefix("garden: ") for note in found]


def categories(scene: Path) -> dict[str, str]:
    return {pair.name: pair.category for pair in UNCHECKED.load(scene).pairs}


@pytest.mark.parametrize("path", [".", "garden"])
def test_scene_or_folder_of_scenes_is_read(scene: Path, path: str) -> None:
    dataset = Imc().load(scene.parent / path)
    assert dataset.notes == (f"garden: no pairs with a covisibility from {EMPTY}",)
    assert [(pair.name, pair.category) for pair in dataset.pairs] == [
        ("garden/a.png garden/d.png", "0.1"),
        ("garden/b.png garden/c.png", "0.2"),
    ]
    np.testing.assert_allclose(
        dataset.pairs[0].images[0].intrinsics,
        [[FOCAL_PX, 0, 159.5], [0, FOCAL_PX, 119.5], [0, 0, 1]],
    )
    rotation, translation = true_pose(dataset.pairs[0])
    np.testing.assert_allclose(rotation @ pose(0)[0], pose(3)[0], atol=1e-9)
    np.testing.assert_allclose(rotation @ pose(0)[1] + translation, pose(3)[1], atol=1e-9)


def test_scene_in_the_current_folder_has_its_name(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(scene)
    assert UNCHECKED.load(Path()).pairs[0].images[0].name == "garden/a.png"


def test_list_from_zero_is_read_where_there_is_one(scene: Path) -> None:
    path = scene / "set_100" / "new-vis-pairs" / "keys-th-0.0.npy"
    np.save(path, np.array(["a-b", "a-d", "b-c"]))
    assert list(categories(scene).values()) == ["0.0", "0.1", "0.2"]


def test_missing_or_contradictory_lists_are_named(scene: Path) -> None:
    write_lists(scene, {1: ["a-d"], 2: ["b-c"]})
    folder = scene / "set_100" / "new-vis-pairs"
    (folder / "keys-th-0.8.npy").unlink()
    np.save(folder / "keys-th-0.9.npy", np.array(["a-d", None], dtype=object))
    assert list(categories(scene).values()) == ["0.1", "0.2"]
    assert notes(scene)[0] == (
        "keys-th-0.8.npy is missing: its pairs count as of less covisibility"
    )
    assert notes(scene)[1].startswith("keys-th-0.9.npy cannot be read (Object arrays cannot be")
    assert len(notes(scene)) == 2


def test_names_with_dashes_and_pairs_of_unknown_images(scene: Path) -> None:
    root = scene / "set_100"
    for name in NAMES:
        (root / "images" / f"{name}.png").rename(root / "images" / f"x-{name}.png")
        path = root / "calibration" / f"calibration_{name}.h5"
        path.rename(path.with_name(f"calibration_x-{name}.h5"))
    write_lists(scene, {1: ["x-a-x-d", "x-a-e"], 2: []})
    assert categories(scene) == {"garden/x-a.png garden/x-d.png": "0.1"}
    assert notes(scene)[0] == "1 listed pairs are of images that are not there: x-a-e"


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"K": np.diag([np.nan, 300, 1])}, "K has values that are not finite"),
        ({"K": np.eye(2)}, "has no K of 9 values"),
        ({"K": np.diag([300.0, 300, 1])}, "K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        ({"T": None}, "has no T of 3 values"),
        ({"R": 2 * pose(0)[0]}, "the rotation is scaled by 2"),
        ({"R": pose(0)[0] * [1, 1, -1]}, "the rotation is a reflection"),
        ({"R": pose(0)[0] + np.eye(3)[::-1] / 9}, "the rotation is not orthogonal"),
    ],
)
def test_unusable_calibration_is_named(
    scene: Path, changes: dict[str, np.ndarray], fault: str
) -> None:
    write_calibration(scene, 0, **changes)
    assert list(categories(scene).values()) == ["0.2"]
    assert notes(scene) == [
        "1 of 2 listed pairs are left out",
        f"1 of 4 listed images have no usable calibration: a ({fault})",
    ]


def test_damaged_and_missing_files_are_named(scene: Path) -> None:
    (scene / "set_100" / "calibration" / "calibration_a.h5").write_bytes(b"nothing")
    (scene / "set_100" / "images" / "b.png").unlink()
    write_lists(scene, {1: ["a-c", "b-c", "c-d"]})
    assert list(categories(scene).values()) == ["0.1"]
    left_out, without_file, uncalibrated = notes(scene)
    assert left_out == "2 of 3 listed pairs are left out"
    assert without_file == "1 of 4 listed images are not in images/: b"
    assert "1 of 4 listed images have no usable calibration: a (cannot be read (" in uncalibrated


def test_folder_without_a_scene_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="has no set_100/new-vis-pairs, nor has a folder"):
        UNCHECKED.load(tmp_path)


def convert(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


CAMERA_TXT = "1 {} 320 240 {}\n"


def write_model(folder: Path, camera: str) -> None:
    """Write a model of a.png, b.png, c.png; a and b have a box of half by a quarter in common."""
    folder.mkdir()
    (folder / "cameras.txt").write_text(camera)
    corners = [(10, 10), (170, 10), (170, 70), (10, 70)]  # 160 x 60 of 320 x 240
    wide = [(0, 0), (320, 0), (320, 240), (0, 240)]
    points = " ".join(f"{x} {y} {point}" for point, (x, y) in enumerate(corners, 1))
    wide_points = " ".join(f"{x} {y} {point}" for point, (x, y) in enumerate(wide, 1))
    lines = [
        f"1 1 0 0 0 0 0 0 1 a.png\n{points}",
        f"2 0.8 0.6 0 0 1 2 3 1 b.png\n{wide_points}",
        "3 1 0 0 0 4 0 0 1 c.png\n",
    ]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    tracks = [f"{point} 0 0 {point} 9 9 9 1 1 {point - 1} 2 {point - 1}" for point in range(1, 5)]
    (folder / "points3D.txt").write_text("\n".join(tracks) + "\n")


def test_set_made_from_a_model_is_read_back(scene: Path, tmp_path: Path) -> None:
    write_model(tmp_path / "model", CAMERA_TXT.format("PINHOLE", "300 310 150 110"))
    photos = scene / "set_100" / "images"
    done = convert(tmp_path / "model", photos, tmp_path / "castle")
    assert done.returncode == 0, done.stderr
    assert re.findall(r"0\.(\d): (\d) pairs", done.stdout) == [
        (str(limit), {0: "2", 1: "1"}.get(limit, "0")) for limit in range(10)
    ]
    dataset = UNCHECKED.load(tmp_path / "castle")
    found = {pair.name: pair for pair in dataset.pairs}
    assert {name: pair.category for name, pair in found.items()} == {
        "castle/a.png castle/b.png": "0.1",  # 160 * 60 / (320 * 240) = 0.125
        "castle/a.png castle/c.png": "0.0",
        "castle/b.png castle/c.png": "0.0",
    }
    pair = found["castle/a.png castle/b.png"]
    np.testing.assert_allclose(
        pair.images[0].intrinsics, [[300, 0, 149.5], [0, 310, 109.5], [0, 0, 1]]
    )
    rotation, translation = true_pose(pair)
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]])
    np.testing.assert_allclose(translation, [1, 2, 3])


def test_models_that_make_no_set_are_refused(scene: Path, tmp_path: Path) -> None:
    photos = scene / "set_100" / "images"
    write_model(tmp_path / "bent", CAMERA_TXT.format("SIMPLE_RADIAL", "300 160 120 0.1"))
    done = convert(tmp_path / "bent", photos, tmp_path / "castle")
    assert done.stderr.startswith("a.png: a camera with distortion; undistort")
    write_model(tmp_path / "bare", CAMERA_TXT.format("PINHOLE", "300 310 150 110"))
    (tmp_path / "bare" / "points3D.txt").write_text("")
    images = tmp_path / "bare" / "images.txt"
    images.write_text(re.sub(r"(png)\n.*", r"\1\n", images.read_text()))
    done = convert(tmp_path / "bare", photos, tmp_path / "castle")
    assert done.stderr.endswith("bare: has no points; give --points\n")
