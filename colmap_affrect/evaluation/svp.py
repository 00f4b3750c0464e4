"""The Strong ViewPoint Changes dataset (Toft et al., 2020), and scenes that are laid out like it.

A scene is a folder with::

    images/                   photographs
    <scene>_image_pairs.txt   lines "IMAGE1 IMAGE2 DIFFICULTY"
    0/images.txt              poses, COLMAP's text, with or without the lines of points
    0/cameras.txt             cameras, COLMAP's text

A dataset is a scene or a folder of scenes. Images are known by ``<scene>/<name as its file>``, and
so are their depth maps. Names in the lists and files may differ in their suffixes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.poses import Pose, relative_pose
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import Dataset, EvaluationPair, counted
from colmap_affrect.evaluation.relative_pose import (
    Names,
    PosedImage,
    PosedScenes,
    category_start,
    missing_notes,
    posed_image,
    posed_pairs,
    rotation_angle_deg,
    scene_images,
    stem,
)
from colmap_affrect.evaluation.truth_checks import image_sizes, pose_contradictions
from colmap_affrect.images.reading import IMAGE_SUFFIXES

PAIR_LIST_SUFFIX = "_image_pairs.txt"
CATEGORY_DEG = 10
MAX_NOT_UNIT = 1e-3
"""Largest deviation of the length of a quaternion from 1."""


class Svp(PosedScenes):
    """Share of pairs with a rotation error below 5 degrees, by relative rotation."""

    name: ClassVar[str] = "svp"
    category_title: ClassVar[str] = "relative rotation, from [deg]"
    scene_pattern: ClassVar[str] = f"*{PAIR_LIST_SUFFIX}"
    dataset_title: ClassVar[str] = "the Strong ViewPoint Changes dataset"

    def load_scene(self, list_path: Path) -> Dataset:
        """Read a scene by its list of pairs."""
        folder, scene = list_path.parent, list_path.name.removesuffix(PAIR_LIST_SUFFIX)
        listed, bad_lines = read_pair_list(list_path)
        cameras, faults = read_camera_poses(folder / "0")
        poses = {name: pose for name, (_, pose) in cameras.items()}
        images = folder / "images"
        files = scene_images(images)
        posed = {
            name: posed_image(
                f"{scene}/{path.relative_to(images).as_posix()}", path, *cameras[name]
            )
            for name, path in files.items()
            if name in cameras
        }
        listed_names = [pair.names for pair in listed]
        pairs = posed_pairs(
            listed_names, posed, lambda names: f"{CATEGORY_DEG * difficulty(poses, *names)}°"
        )
        left = {int(category_start(pair.category)) // CATEGORY_DEG for pair in pairs}
        wanted = {pair.difficulty for pair in listed if pair.difficulty is not None}
        empty = ", ".join(f"{tens * CATEGORY_DEG}°" for tens in sorted(wanted - left))
        names = list(dict.fromkeys(name for pair in listed_names for name in pair))
        lacking = {n: faults.get(n, "not in images.txt") for n in names if n not in cameras}
        notes = [
            *counted(bad_lines, f"lines that are no pair of {list_path.name}"),
            *missing_notes(listed_names, names, files, lacking, "pose or camera"),
            *_difficulty_notes(listed, poses),
            *_size_notes(pairs),
            *(pose_contradictions(pairs) if self.check_truth else ()),
            *([f"no pairs are left from {empty}"] if empty else []),
        ]
        return Dataset(tuple(pairs), tuple(f"{scene}: {note}" for note in notes))


class ListedPair(NamedTuple):
    """A line of a pair list: names without suffix, and the category as listed, if it is."""

    names: Names
    difficulty: int | None


def difficulty(poses: Mapping[str, Pose], name1: str, name2: str) -> int:
    """Return the category of two images with cam_from_world poses: tens of degrees of rotation."""
    rotation, _ = relative_pose(poses[name1], poses[name2])
    return int(rotation_angle_deg(rotation) // CATEGORY_DEG)


def read_pair_list(path: Path) -> tuple[list[ListedPair], list[str]]:
    """Read a pair list; also name the lines that could not be understood."""
    pairs, bad = [], []
    for number, line in _lines(path):
        words = line.split()
        if len(words) == 2 or (len(words) == 3 and words[2].isdigit()):
            listed = int(words[2]) if len(words) == 3 else None
            pairs.append(ListedPair((stem(words[0]), stem(words[1])), listed))
        else:
            bad.append(f"line {number}")
    return pairs, bad


def read_camera_poses(
    model_path: Path,
) -> tuple[dict[str, tuple[pycolmap.Camera, Pose]], dict[str, str]]:
    """Read ``images.txt`` and ``cameras.txt``; EvaluationError when that cannot be done.

    Returns cameras and poses by image name without suffix, and why others are not usable.
    """
    lines = (line.split() for _, line in _lines(model_path / "cameras.txt"))
    cameras = {camera_id: words for camera_id, *words in lines}
    found: dict[str, tuple[pycolmap.Camera, Pose]] = {}
    faults: dict[str, str] = {}
    for _, line in _lines(model_path / "images.txt"):
        words = line.split(maxsplit=9)
        # Lines of points end in a number.
        if len(words) < 10 or not line.lower().endswith(IMAGE_SUFFIXES):
            continue
        name = stem(words[9])
        try:
            found[name] = _camera(cameras.get(words[8])), _pose(words[1:8])
        except EvaluationError as error:
            faults[name] = str(error)
    return found, faults


def _camera(words: list[str] | None) -> pycolmap.Camera:
    """Return the camera of a line without its id; say what is wrong with it."""
    if words is None:
        raise EvaluationError("has no camera")
    try:
        model, width, height, *params = words
        values = [float(value) for value in params]
        if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
            raise EvaluationError(f"its camera is of the unknown model {model}")
        camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=values)
    except ValueError as error:
        raise EvaluationError("its camera cannot be read") from error
    if not np.isfinite(values).all():
        raise EvaluationError("its camera has values that are not finite")
    if not camera.verify_params() or camera.mean_focal_length() <= 0:
        raise EvaluationError(f"its camera has wrong parameters for {model}")
    return camera


def _pose(words: list[str]) -> Pose:
    """Return the pose QW QX QY QZ TX TY TZ; say what is wrong with it."""
    try:
        values: NDArray[np.float64] = np.array([float(value) for value in words])
    except ValueError as error:
        raise EvaluationError("its pose cannot be read") from error
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all():
        raise EvaluationError("its pose has values that are not finite")
    if abs(length - 1.0) > MAX_NOT_UNIT:
        raise EvaluationError(f"its quaternion has length {length:.3g}")
    rotation = pycolmap.Rotation3d(values[[1, 2, 3, 0]] / length).matrix()
    return np.asarray(rotation), values[4:]


def _difficulty_notes(listed: Sequence[ListedPair], poses: Mapping[str, Pose]) -> list[str]:
    """Say which listed categories contradict the poses, of all listed pairs with poses."""
    wrong = [
        f"{' '.join(pair.names)} (listed {pair.difficulty}, by its poses {found})"
        for pair in listed
        if pair.difficulty is not None and poses.keys() >= set(pair.names)
        if (found := difficulty(poses, *pair.names)) != pair.difficulty
    ]
    return counted(
        wrong, f"of {len(listed)} listed difficulties contradict the poses, which are used"
    )


def _size_notes(pairs: Sequence[EvaluationPair]) -> list[str]:
    """Count images that have another size in px than their intrinsics are for."""
    images: dict[str, PosedImage] = {im.image.name: im for pair in pairs for im in pair.truth}
    paths = [posed.image.path for posed in images.values()]
    wrong = [
        f"{name} ({size[0]} x {size[1]} px, intrinsics for "
        f"{posed.camera.width} x {posed.camera.height} px)"
        for (name, posed), size in zip(images.items(), image_sizes(paths), strict=True)
        if size and size != (posed.camera.width, posed.camera.height)
    ]
    return counted(wrong, "images are of another size than their intrinsics")


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the numbered lines of a text file that are not empty or comments."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from error
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]
