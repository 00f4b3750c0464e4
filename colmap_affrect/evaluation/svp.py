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

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.metrics import Pose, relative_pose
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import Dataset, EvaluationPair
from colmap_affrect.evaluation.relative_pose import (
    PosedImage,
    RelativePoseProtocol,
    category_start,
    posed_image,
    posed_pair,
    rotation_angle_deg,
)
from colmap_affrect.evaluation.truth_checks import contradictions, counted, size_notes
from colmap_affrect.imaging import IMAGE_SUFFIXES

PAIR_LIST_SUFFIX = "_image_pairs.txt"
CATEGORY_DEG = 10
MAX_NOT_UNIT = 1e-3
"""Largest deviation of the length of a quaternion from 1."""


@dataclass(frozen=True)
class Svp(RelativePoseProtocol):
    """Share of pairs with a rotation error below 5 degrees, by relative rotation."""

    name = "svp"
    category_title = "relative rotation, from [deg]"

    def load(self, dataset_path: Path) -> Dataset:
        """Read a scene, or all scenes in a folder.

        Raises:
            EvaluationError: when there is no pair list, a file of the model is missing or no pair
                can be evaluated.
        """
        folders = (dataset_path, *sorted(dataset_path.glob("*/")))
        lists = [path for folder in folders for path in sorted(folder.glob(f"*{PAIR_LIST_SUFFIX}"))]
        if not lists:
            raise EvaluationError(
                f"{dataset_path}: has no *{PAIR_LIST_SUFFIX}, nor has a folder in it; give a scene "
                "of the Strong ViewPoint Changes dataset, or the folder of its scenes"
            )
        scenes = [_load_scene(path, check_truth=self.check_truth) for path in lists]
        return Dataset.united(scenes, dataset_path)


@dataclass(frozen=True)
class ListedPair:
    """A line of a pair list: names without suffix, and the category as listed, if it is."""

    names: tuple[str, str]
    difficulty: int | None


@dataclass(frozen=True)
class CameraPoses:
    """What the text files of a model say.

    Attributes:
        cameras: usable ones by image name without suffix.
        poses: usable ones by the same.
        faults: why others are not usable, by the same.
    """

    cameras: Mapping[str, pycolmap.Camera]
    poses: Mapping[str, Pose]
    faults: Mapping[str, str] = field(default_factory=dict)


def difficulty(poses: Mapping[str, Pose], name1: str, name2: str) -> int:
    """Return the category of two images with cam_from_world poses: tens of degrees of rotation."""
    rotation, _ = relative_pose(poses[name1], poses[name2])
    return int(rotation_angle_deg(rotation) // CATEGORY_DEG)


def read_pair_list(path: Path) -> tuple[list[ListedPair], list[int]]:
    """Read a pair list; also return the numbers of the lines that could not be understood."""
    pairs, bad = [], []
    for number, line in _lines(path):
        words = line.split()
        if len(words) == 3 and words[2].isdigit():
            pairs.append(ListedPair((_stem(words[0]), _stem(words[1])), int(words[2])))
        elif len(words) == 2:
            pairs.append(ListedPair((_stem(words[0]), _stem(words[1])), None))
        else:
            bad.append(number)
    return pairs, bad


def read_camera_poses(model_path: Path) -> CameraPoses:
    """Read ``images.txt`` and ``cameras.txt`` of a folder.

    Raises:
        EvaluationError: when one of them cannot be read.
    """
    read: dict[str, pycolmap.Camera | str] = {}
    for _, line in _lines(model_path / "cameras.txt"):
        camera_id, *rest = line.split()
        read[camera_id] = _camera(rest)
    cameras: dict[str, pycolmap.Camera] = {}
    poses: dict[str, Pose] = {}
    faults: dict[str, str] = {}
    for _, line in _lines(model_path / "images.txt"):
        words = line.split(maxsplit=9)
        # Lines of points end in a number.
        if len(words) < 10 or not line.lower().endswith(IMAGE_SUFFIXES):
            continue
        name = _stem(words[9])
        camera = read.get(words[8], "has no camera")
        pose = _pose(words[1:8])
        if isinstance(camera, str) or isinstance(pose, str):
            faults[name] = camera if isinstance(camera, str) else str(pose)
        else:
            cameras[name], poses[name] = camera, pose
    return CameraPoses(cameras, poses, faults)


def _load_scene(list_path: Path, *, check_truth: bool) -> Dataset:
    folder, scene = list_path.parent, list_path.name.removesuffix(PAIR_LIST_SUFFIX)
    listed, bad_lines = read_pair_list(list_path)
    known = read_camera_poses(folder / "0")
    files = {
        _stem(path.relative_to(folder / "images").as_posix()): path
        for path in sorted((folder / "images").rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES
    }
    posed = {
        name: posed_image(
            f"{scene}/{path.relative_to(folder / 'images').as_posix()}",
            path,
            known.cameras[name],
            known.poses[name],
        )
        for name, path in files.items()
        if name in known.poses
    }
    pairs = [
        posed_pair(
            posed[first], posed[second], f"{CATEGORY_DEG * difficulty(known.poses, first, second)}°"
        )
        for first, second in (pair.names for pair in listed)
        if first in posed and second in posed
    ]
    pairs = sorted({pair.name: pair for pair in pairs}.values(), key=_order)
    notes = [
        *counted(
            bad_lines,
            f"lines that are no pair of {list_path.name}",
            [f"line {number}" for number in bad_lines],
        ),
        *_missing_notes(listed, files, known),
        *_difficulty_notes(listed, known.poses),
        *size_notes(_images_of(pairs)),
        *(contradictions(pairs) if check_truth else ()),
        *_empty_notes(listed, pairs),
    ]
    return Dataset(tuple(pairs), tuple(f"{scene}: {note}" for note in notes))


def _order(pair: EvaluationPair) -> tuple[float, str]:
    return category_start(pair.category), pair.name


def _images_of(pairs: Iterable[EvaluationPair]) -> list[PosedImage]:
    """Return the images of pairs, each once."""
    return list({image.image.name: image for pair in pairs for image in pair.truth}.values())


def _missing_notes(
    listed: list[ListedPair], files: Mapping[str, Path], known: CameraPoses
) -> Iterator[str]:
    """Count what is listed and not there."""
    names = list(dict.fromkeys(name for pair in listed for name in pair.names))
    without_file = [name for name in names if name not in files]
    without_pose = [name for name in names if name not in known.poses]
    lost = [
        pair
        for pair in listed
        if any(name not in files or name not in known.poses for name in pair.names)
    ]
    if lost:
        yield f"{len(lost)} of {len(listed)} listed pairs are left out"
    yield from counted(
        without_file, f"of {len(names)} listed images are not in images/", without_file
    )
    yield from counted(
        without_pose,
        f"of {len(names)} listed images have no usable pose or camera",
        [f"{name} ({known.faults.get(name, 'not in images.txt')})" for name in without_pose],
    )


def _difficulty_notes(listed: list[ListedPair], poses: Mapping[str, Pose]) -> Iterator[str]:
    """Say which listed categories contradict the poses, of all listed pairs with poses."""
    wrong = [
        f"{' '.join(pair.names)} (listed {pair.difficulty}, by its poses {found})"
        for pair in listed
        if pair.difficulty is not None and all(name in poses for name in pair.names)
        for found in [difficulty(poses, *pair.names)]
        if found != pair.difficulty
    ]
    yield from counted(
        wrong, f"of {len(listed)} listed difficulties contradict the poses, which are used", wrong
    )


def _empty_notes(listed: list[ListedPair], pairs: list[EvaluationPair]) -> Iterator[str]:
    """Name the listed categories of which no pair is left."""
    wanted = {pair.difficulty for pair in listed if pair.difficulty is not None}
    left = {int(category_start(pair.category)) // CATEGORY_DEG for pair in pairs}
    empty = sorted(wanted - left)
    if empty:
        yield "no pairs are left from " + ", ".join(f"{k * CATEGORY_DEG}°" for k in empty)


def _camera(words: list[str]) -> pycolmap.Camera | str:
    """Return the camera of a line without its id, or what is wrong with it."""
    try:
        model, width, height, *params = words
        values = [float(value) for value in params]
        if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
            return f"its camera is of the unknown model {model}"
        camera = pycolmap.Camera(model=model, width=int(width), height=int(height), params=values)
    except ValueError:
        return "its camera cannot be read"
    if not np.isfinite(values).all():
        return "its camera has values that are not finite"
    if not camera.verify_params() or camera.mean_focal_length() <= 0:
        return f"its camera has wrong parameters for {model}"
    return camera


def _pose(words: list[str]) -> Pose | str:
    """Return the pose QW QX QY QZ TX TY TZ, or what is wrong with it."""
    try:
        values: NDArray[np.float64] = np.array([float(value) for value in words])
    except ValueError:
        return "its pose cannot be read"
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all():
        return "its pose has values that are not finite"
    if abs(length - 1.0) > MAX_NOT_UNIT:
        return f"its quaternion has length {length:.3g}"
    rotation = pycolmap.Rotation3d(values[[1, 2, 3, 0]] / length).matrix()
    return np.asarray(rotation), values[4:]


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix()


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a text file that are not empty or comments, with their numbers.

    Raises:
        EvaluationError: when it cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from error
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]
