"""Scenes laid out as the Strong ViewPoint Changes dataset, whole and damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from posed_photographs import image_line, pose, write_svp
from small_scene import FOCAL_PX

from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.posed_scenes import (
    Svp,
    difficulty,
    read_camera_poses,
    read_pair_list,
)
from colmap_affrect.evaluation.relative_pose import true_pose

UNCHECKED = Svp()
SAMPLE = Path(__file__).parents[3] / "shared" / "pairs" / "svp_sample"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_svp(tmp_path / "set" / "scene4")


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


@pytest.mark.parametrize("path", [".", "scene4"])
def test_scene_or_folder_of_scenes_is_read(scene: Path, path: str) -> None:
    dataset = Svp().load(scene.parent / path)
    assert dataset.notes == ()
    assert [(pair.name, pair.category) for pair in dataset.pairs] == [
        ("scene4/a.png scene4/b.png", "0°"),
        ("scene4/b.png scene4/d.png", "10°"),
        ("scene4/a.png scene4/d.png", "20°"),
    ]
    image = dataset.pairs[0].images[1]
    assert image.path == scene / "images" / "b.png"
    np.testing.assert_allclose(
        image.intrinsics, [[FOCAL_PX, 0, 159.5], [0, FOCAL_PX, 119.5], [0, 0, 1]]
    )
    rotation, translation = true_pose(dataset.pairs[2])
    pose_a, pose_d = pose(0), pose(3)
    np.testing.assert_allclose(rotation @ pose_a[0], pose_d[0], atol=1e-9)
    np.testing.assert_allclose(rotation @ pose_a[1] + translation, pose_d[1], atol=1e-9)


def test_model_with_lines_of_points_and_names_of_other_suffixes(scene: Path) -> None:
    images = scene / "0" / "images.txt"
    lines = [
        f"{line.replace('.png', '.jpg')}\n10.5 20.5 1 30.5 40.5 -1 50.5 60.5 7 8.5 9.5 -1"
        for line in images.read_text().splitlines()[1:]
    ]
    images.write_text("\n".join(lines) + "\n")
    assert len(UNCHECKED.load(scene).pairs) == 3


def test_missing_files_are_counted_and_named(scene: Path) -> None:
    (scene / "images" / "d.png").unlink()
    (scene / "images" / "unlisted.txt").write_text("")
    dataset = UNCHECKED.load(scene)
    assert [pair.category for pair in dataset.pairs] == ["0°"]
    assert dataset.notes == (
        "scene4: 2 of 3 listed pairs are left out",
        "scene4: 1 of 3 listed images are not in images/: d",
        "scene4: no pairs are left from 10°, 20°",
    )


@pytest.mark.parametrize(
    ("file", "old", "new", "fault"),
    [
        ("cameras.txt", "SIMPLE_RADIAL", "ROUND", "its camera is of the unknown model ROUND"),
        ("cameras.txt", "300.0", "nan", "its camera has values that are not finite"),
        ("cameras.txt", "300.0", "", "its camera has wrong parameters for SIMPLE_RADIAL"),
        ("cameras.txt", "300.0", "wide", "its camera cannot be read"),
        ("cameras.txt", "1 SIMPLE", "9 SIMPLE", "has no camera"),
        ("images.txt", "1 0.99", "1 2.99", "its quaternion has length 3)"),
        ("images.txt", "1 0.99", "1 inf 0.99", "its pose has values that are not finite"),
    ],
)
def test_unusable_truth_of_an_image_is_named(
    scene: Path, file: str, old: str, new: str, fault: str
) -> None:
    if new == "1 inf 0.99":
        first = image_line(0).split()
        edit(scene / "0" / file, " ".join(first[:2]), f"{first[0]} inf")
    else:
        edit(scene / "0" / file, old, new)
    dataset = UNCHECKED.load(scene)
    assert [pair.category for pair in dataset.pairs] == ["10°"]
    assert f"of 3 listed images have no usable pose or camera: a ({fault}" in dataset.notes[1]


def test_difficulty_is_that_of_the_poses_and_bad_lines_are_named(scene: Path) -> None:
    path = scene / "scene4_image_pairs.txt"
    path.write_text("a.png b.png 0\n\na.png d.png 5\nb.png\n# d.png\na.png c.png\n")
    dataset = UNCHECKED.load(scene)
    assert [pair.category for pair in dataset.pairs] == ["0°", "10°", "20°"]
    assert dataset.notes[0] == "scene4: 1 lines that are no pair of scene4_image_pairs.txt: line 4"


def test_folder_without_a_scene_and_scene_without_images_are_errors(
    scene: Path, tmp_path: Path
) -> None:
    with pytest.raises(EvaluationError, match=r"has no \*_image_pairs.txt"):
        UNCHECKED.load(tmp_path)
    for path in (scene / "images").iterdir():
        path.unlink()
    with pytest.raises(EvaluationError, match="no pair can be evaluated; scene4: 3 of 3 listed"):
        UNCHECKED.load(scene)
    (scene / "0" / "cameras.txt").unlink()
    with pytest.raises(EvaluationError, match=r"cameras\.txt: cannot be read"):
        UNCHECKED.load(scene)


@pytest.mark.shared
@pytest.mark.skipif(not SAMPLE.is_dir(), reason="the sample is not here")
def test_difficulties_of_the_real_list_are_those_of_the_real_poses() -> None:
    scene = SAMPLE / "scene1"
    listed, bad = read_pair_list(scene / "scene1_image_pairs.txt")
    known, faults = read_camera_poses(scene / "0")
    assert (len(listed), bad, len(known), faults) == (3590, [], 1608, {})
    poses = {name: pose for name, (_, pose) in known.items()}
    found = [difficulty(poses, *pair.names) for pair in listed]
    assert found == [pair.difficulty for pair in listed]
    assert np.bincount(found).tolist() == [200] * 17 + [190]


@pytest.mark.shared
@pytest.mark.skipif(not SAMPLE.is_dir(), reason="the sample is not here")
def test_real_sample_has_one_pair_and_says_what_is_missing() -> None:
    dataset = Svp().load(SAMPLE)
    assert [pair.name for pair in dataset.pairs] == [
        "scene1/frame_0000001535_4.jpg scene1/frame_0000000305_1.jpg"
    ]
    assert dataset.notes[0] == "scene1: 3589 of 3590 listed pairs are left out"
    assert dataset.notes[1].startswith("scene1: 1419 of 1421 listed images are not in images/: ")
    assert len(dataset.notes) == 3  # the third: empty categories
