"""Layouts of datasets, whole and damaged: EVD, SVP, IMC, a set made from a model, pairs.json."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import posed_photographs as scenes
import pytest
from posed_photographs import SIZE, TRUTH, pose, write_extreme_views, write_pair
from small_scene import FOCAL_PX

from colmap_affrect.colmap.model_files import relative_pose
from colmap_affrect.errors import AffrectError
from colmap_affrect.evaluation.datasets import (
    Pairs,
    load_evd,
    load_imc,
    load_pairs,
    load_svp,
)

SCRIPT = (
    Path(__file__).parents[2] / "recipes" / "own-evaluation-set" / "imc_from_model.py"
)
Entry = dict[str, Any]
INTRINSICS = [[FOCAL_PX, 0, 159.5], [0, FOCAL_PX, 119.5], [0, 0, 1]]
"""Of the photographs of the small scene, in pixel-centre px."""


def categories(dataset: Pairs) -> dict[str, str]:
    return {pair.name: pair.category for pair in dataset}


def require_pose(found: Any, first: int, second: int) -> None:
    rotation, translation = found.pose
    np.testing.assert_allclose(rotation @ pose(first)[0], pose(second)[0], atol=1e-9)
    moved = rotation @ pose(first)[1] + translation
    np.testing.assert_allclose(moved, pose(second)[1], atol=1e-9)


def test_layouts_of_pairs_with_homographies(tmp_path: Path) -> None:
    write_extreme_views(tmp_path, ["cafe"])
    np.savetxt(tmp_path / "h" / "cafe.txt", -3.0 * TRUTH)
    write_pair(tmp_path / "my_wall_1.png", tmp_path / "my_wall_3.png", seed=1)
    np.savetxt(tmp_path / "H_my_wall_1_3.txt", TRUTH)
    cafe, wall = load_evd(tmp_path)
    assert (cafe.name, cafe.images) == ("cafe", ("1/cafe.png", "2/cafe.png"))
    np.testing.assert_allclose(
        cafe.truth.matrix, 3.0 * TRUTH
    )  # positive where it is visible
    assert cafe.truth.size1 == SIZE == (160, 120)
    assert (wall.name, wall.images[1]) == ("my_wall 1-3", "my_wall_3.png")


@pytest.mark.parametrize(("change", "message"), [
    (lambda f: (f / "2" / "cafe.png").unlink(), r"cafe\.png: "),
    (lambda f: (f / "h" / "cafe.txt").unlink(), r"cafe\.txt: damaged"),
    (lambda f: (f / "1" / "cafe.png").write_bytes(b"no image"), "not a readable image"),
    (lambda f: np.savetxt(f / "h" / "cafe.txt", np.array([[1, 0, 900], [0, 1, 0], [0, 0, 1]])),
     "shows no part of image 1"),
])  # fmt: skip
def test_pairs_that_cannot_be_used_are_refused(
    change: Any, message: str, tmp_path: Path
) -> None:
    write_extreme_views(tmp_path, ["cafe", "dance"])
    change(tmp_path)
    with pytest.raises(AffrectError, match=message):
        load_evd(tmp_path)


@pytest.mark.parametrize(("load", "message"), [
    (load_evd, r"holds neither 1/NAME\.png"),
    (load_svp, r"it has no \*_image_pairs\.txt"),
    (load_imc, "it has no set_100/new-vis-pairs"),
    (load_pairs, r"pairs\.json: damaged"),
])  # fmt: skip
def test_other_folders_are_refused(load: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(AffrectError, match=message):
        load(tmp_path)


@pytest.fixture
def svp(tmp_path: Path) -> Path:
    return scenes.write_svp(tmp_path / "set" / "scene4")


@pytest.mark.parametrize("path", [".", "scene4"])
def test_svp_scene_or_folder_of_scenes_is_read(svp: Path, path: str) -> None:
    dataset = load_svp(svp.parent / path)
    assert list(categories(dataset).items()) == [
        ("scene4/a.png scene4/b.png", "0°"),
        ("scene4/b.png scene4/d.png", "10°"),
        ("scene4/a.png scene4/d.png", "20°"),
    ]
    assert dataset[0].paths[1] == svp / "images" / "b.png"
    np.testing.assert_allclose(dataset[0].intrinsics[1], INTRINSICS)
    require_pose(dataset[2].truth, 0, 3)


def test_pairs_without_an_image_or_pose_are_left_out_and_named(
    svp: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (svp / "images" / "d.png").unlink()
    (svp / "images" / "unlisted.txt").write_text("")
    dataset = load_svp(svp)
    assert list(categories(dataset).values()) == ["0°"]
    note = "scene4: 2 of 3 listed pairs are left out, without an image or its camera: d"
    assert caplog.messages == [note]


@pytest.mark.parametrize(("file", "old", "new"), [
    ("cameras.txt", "SIMPLE_RADIAL", "ROUND"),
    ("cameras.txt", "300.0", "nan"),
    ("images.txt", "1 0.99", "1 one"),
])  # fmt: skip
def test_unusable_cameras_and_poses_are_refused(
    svp: Path, file: str, old: str, new: str
) -> None:
    path = svp / "0" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(AffrectError, match=r"damaged|not finite"):
        load_svp(svp)


def test_points_of_images_are_passed_over_and_bad_lines_are_refused(svp: Path) -> None:
    images = svp / "0" / "images.txt"
    images.write_text(
        images.read_text().replace("png\n", "png\n10.5 20.5 1 30.5 40.5 -1\n")
    )
    assert len(load_svp(svp)) == 3
    (svp / "scene4_image_pairs.txt").write_text("a.png b.png 0\nb.png\n")
    with pytest.raises(
        AffrectError, match=r"scene4_image_pairs\.txt: 'b\.png' is no pair"
    ):
        load_svp(svp)


@pytest.fixture
def imc(tmp_path: Path) -> Path:
    return scenes.write_imc(tmp_path / "set" / "garden")


@pytest.mark.parametrize("path", [".", "garden"])
def test_imc_scene_or_folder_of_scenes_is_read(imc: Path, path: str) -> None:
    dataset = load_imc(imc.parent / path)
    assert list(categories(dataset).items()) == [
        ("garden/a.png garden/d.png", "0.1"),
        ("garden/b.png garden/c.png", "0.2"),
    ]
    np.testing.assert_allclose(dataset[0].intrinsics[0], INTRINSICS)
    require_pose(dataset[0].truth, 0, 3)


def test_names_with_dashes_and_pairs_of_unknown_images(imc: Path) -> None:
    root = imc / "set_100"
    for name in scenes.NAMES:
        (root / "images" / f"{name}.png").rename(root / "images" / f"x-{name}.png")
        path = root / "calibration" / f"calibration_{name}.h5"
        path.rename(path.with_name(f"calibration_x-{name}.h5"))
    scenes.write_lists(imc, {1: ["x-a-x-d", "x-a-e"], 2: []})
    dataset = load_imc(imc)
    assert categories(dataset) == {"garden/x-a.png garden/x-d.png": "0.1"}


@pytest.mark.parametrize(("changes", "fault"), [
    ({"K": np.diag([300.0, 300, 1])}, r"K is not \[\[fx, 0, cx\]"),
    ({"T": None}, "damaged"),
    ({"R": np.eye(2)}, r"R has shape \(2, 2\)"),
])  # fmt: skip
def test_unusable_calibration_is_refused(imc: Path, changes: Entry, fault: str) -> None:
    scenes.write_calibration(imc, 0, **changes)
    with pytest.raises(AffrectError, match=rf"calibration_a\.h5: .*{fault}"):
        load_imc(imc)


def convert(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def write_model(folder: Path, camera: str) -> None:
    """Write a model of a.png, b.png, c.png; a and b have a box of half by a quarter in common."""
    folder.mkdir()
    (folder / "cameras.txt").write_text(camera)
    box = "10 10 1 170 10 2 170 70 3 10 70 4"  # 160 x 60 of 320 x 240
    whole = "0 0 1 320 0 2 320 240 3 0 240 4"
    (folder / "images.txt").write_text(
        f"1 1 0 0 0 0 0 0 1 a.png\n{box}\n2 0.8 0.6 0 0 1 2 3 1 b.png\n{whole}\n"
        "3 1 0 0 0 4 0 0 1 c.png\n\n"
    )
    tracks = (f"{k + 1} 0 0 {k} 9 9 9 1 1 {k} 2 {k}\n" for k in range(4))
    (folder / "points3D.txt").write_text("".join(tracks))


def test_set_made_from_a_model_is_read_back(imc: Path, tmp_path: Path) -> None:
    write_model(tmp_path / "model", "1 PINHOLE 320 240 300 310 150 110")
    write_model(tmp_path / "bent", "1 SIMPLE_RADIAL 320 240 300 160 120 0.1")
    done = convert(tmp_path / "bent", imc / "set_100" / "images", tmp_path / "castle")
    assert done.stderr.startswith("a.png: a camera with distortion; undistort")
    done = convert(tmp_path / "model", imc / "set_100" / "images", tmp_path / "castle")
    assert done.returncode == 0, done.stderr
    assert re.findall(r"0\.(\d): (\d) pairs", done.stdout) == [
        (str(limit), {0: "2", 1: "1"}.get(limit, "0")) for limit in range(10)
    ]
    dataset = load_imc(tmp_path / "castle")
    assert categories(dataset) == {
        "castle/a.png castle/b.png": "0.1",  # 160 * 60 / (320 * 240) = 0.125
        "castle/a.png castle/c.png": "0.0",
        "castle/b.png castle/c.png": "0.0",
    }
    pair = next(pair for pair in dataset if pair.category == "0.1")
    expected = [[300, 0, 149.5], [0, 310, 109.5], [0, 0, 1]]
    np.testing.assert_allclose(pair.intrinsics[0], expected)
    rotation, translation = pair.truth.pose
    np.testing.assert_allclose(rotation, [[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]])
    np.testing.assert_allclose(translation, [1, 2, 3])


def listed(folder: Path, *entries: Entry, **top: Any) -> Pairs:
    (folder / "pairs.json").write_text(
        json.dumps({"pairs": entries, **top}), encoding="utf-8"
    )
    return load_pairs(folder)


@pytest.fixture
def planar(tmp_path: Path) -> Entry:
    write_pair(tmp_path / "a.png", tmp_path / "b.png", seed=3)
    return {"image1": "a.png", "image2": "b.png"}


def test_homography_of_corner_pixels(tmp_path: Path, planar: Entry) -> None:
    corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    matrix = corner @ TRUTH @ np.linalg.inv(corner)
    np.savetxt(tmp_path / "h.txt", matrix)
    given = {"of file": "h.txt", "of numbers": matrix.tolist()}
    entries = [{**planar, "name": name, "homography": h} for name, h in given.items()]
    for pair in listed(tmp_path, *entries, pixel_origin="corner"):
        np.testing.assert_allclose(pair.truth.matrix, TRUTH, atol=1e-9)


def posed(**changes: Any) -> Entry:
    rotation, translation = relative_pose(pose(0), pose(3))
    values = {
        "rotation": rotation.tolist(),
        "translation": translation.tolist(),
        "intrinsics1": INTRINSICS,
        "intrinsics2": [[2 * FOCAL_PX, 0, 100], [0, FOCAL_PX, 110], [0, 0, 1]],
    }
    return {**values, **changes}


@pytest.mark.parametrize(("origin", "offset_px"), [("center", 0.0), ("corner", -0.5)])
def test_poses_and_points_in_pixels_of_both_origins(
    origin: str, offset_px: float, tmp_path: Path, planar: Entry
) -> None:
    marked = {
        **planar,
        "name": "c",
        "category": "night",
        "correspondences": [[10, 20, 30, 40]],
    }
    pose_given = {**planar, "relative_pose": posed()}
    pair, points = listed(
        tmp_path, pose_given, marked, pixel_origin=origin, convention="mine"
    )
    np.testing.assert_array_equal(
        points.truth.points, np.array([[10, 20, 30, 40]]) + offset_px
    )
    assert (points.name, points.category) == ("c", "night")
    require_pose(pair.truth, 0, 3)
    for matrix, (x, y) in zip(
        pair.intrinsics, ((159.5, 119.5), (100, 110)), strict=True
    ):
        np.testing.assert_allclose(matrix[:2, 2], np.array([x, y]) + offset_px)
    np.testing.assert_allclose(np.diag(pair.intrinsics[1]), [2 * FOCAL_PX, FOCAL_PX, 1])


@pytest.mark.parametrize(("changes", "problem"), [
    ({"homography": [[1, 2], [3, 4]]}, r"has shape \(2, 2\)"),
    ({"relative_pose": posed(centre=[0, 0, 0])}, "relative_pose needs"),
    ({"correspondences": "../points.txt"}, "must be a file in the folder"),
])  # fmt: skip
def test_unusable_truth_is_refused(
    changes: Entry, problem: str, tmp_path: Path, planar: Entry
) -> None:
    with pytest.raises(AffrectError, match=problem):
        listed(tmp_path, {**planar, **changes})


SAME = '{"image1": "a.png", "image2": "b.png", "homography": "h.txt"}'


@pytest.mark.parametrize(("content", "message"), [
    ("[]", "damaged"),
    ('{"pairs": []}', "has no pairs"),
    ('{"pairs": [1]}', r"pairs\[0\]: expected options, got 1"),
    ('{"pairs": [{"image1": "../a.png", "image2": "b.png", "homography": []}]}', "must be path"),
    ('{"pairs": [{"image1": "a", "image2": "b"}]}', "needs homography, correspondences or"),
    (f'{{"pairs": [{SAME}, {SAME}]}}', "two pairs are called 'a b'"),
])  # fmt: skip
def test_bad_list_is_one_line(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "pairs.json").write_text(content)
    with pytest.raises(AffrectError, match=message):
        load_pairs(tmp_path)
