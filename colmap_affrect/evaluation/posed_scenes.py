"""Datasets whose truth is poses: Strong ViewPoint Changes, and the Image Matching Challenge's.

A dataset is a scene or a folder of scenes. Images are known by ``<scene>/<name as its file>``, and
so are their depth maps. Names in lists and files may differ in their suffixes.

Strong ViewPoint Changes (Toft et al., 2020), and scenes that are laid out like it: a folder with::

    images/                   photographs
    <scene>_image_pairs.txt   lines "IMAGE1 IMAGE2 DIFFICULTY"
    0/images.txt              poses, COLMAP's text, with or without the lines of points
    0/cameras.txt             cameras, COLMAP's text

Phototourism sets of the Image Matching Challenge, and the like: a folder ``set_100/`` with::

    images/<image>.jpg
    calibration/calibration_<image>.h5   K (3 x 3), R (3 x 3), T (3): x_camera = R x + T
    new-vis-pairs/keys-th-0.<k>.npy      names "<image 1>-<image 2>" with covisibility >= 0.<k>

Its lists are cumulative; the categories are their differences, from 0.1 on, as in the paper, or
from 0.0 where there is such a list, and
K is COLMAP's: the origin is the corner of the image.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import h5py
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.poses import Pose, relative_pose
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import (
    Dataset,
    EvaluationPair,
    counted,
    rotation_fault,
    stem,
)
from colmap_affrect.evaluation.relative_pose import (
    PosedImage,
    RelativePoseProtocol,
    category_start,
    posed_image,
    posed_pair,
    rotation_angle_deg,
)
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.reading import IMAGE_SUFFIXES

Names = tuple[str, str]  # of the images of a pair, without suffix
PAIR_LIST_SUFFIX = "_image_pairs.txt"
CATEGORY_DEG = 10
MAX_NOT_UNIT = 1e-3  # largest deviation of the length of a quaternion from 1
SET_FOLDER = "set_100"
LIST_FOLDER = "new-vis-pairs"
CALIBRATION_PREFIX = "calibration_"
BINS = tuple(range(10))  # lower limits of the categories, in tenths; the first may have no list


class PosedScenes(RelativePoseProtocol):
    """A protocol whose dataset is a scene or a folder of scenes."""

    scene_pattern: ClassVar[str]
    """Of the file or folder that makes a folder a scene."""
    dataset_title: ClassVar[str]

    def load(self, dataset_path: Path) -> Dataset:
        """Read a scene, or all in a folder; EvaluationError when no pair can be evaluated."""
        folders = [dataset_path, *sorted(dataset_path.glob("*/"))]
        paths = [path for folder in folders for path in sorted(folder.glob(self.scene_pattern))]
        if not paths:
            raise EvaluationError(
                f"{dataset_path}: has no {self.scene_pattern}, nor has a folder in it; give a "
                f"scene of {self.dataset_title}, or the folder of its scenes"
            )
        dataset = Dataset.united(map(self.load_scene, paths))
        if not dataset.pairs:
            notes = "; ".join(dataset.notes)
            raise EvaluationError(f"{dataset_path}: no pair can be evaluated; {notes}")
        return dataset

    @abstractmethod
    def load_scene(self, path: Path) -> Dataset:
        """Read a scene by the path of what makes it one."""


def scene_images(folder: Path) -> dict[str, Path]:
    """Return all images below a folder by their names without suffix."""
    return {
        stem(path.relative_to(folder).as_posix()): path
        for path in sorted(folder.rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES
    }


def posed_pairs(
    listed: Iterable[Names], posed: Mapping[str, PosedImage], category: Callable[[Names], str]
) -> list[EvaluationPair]:
    """Return the pairs of images that are there, by category and name, each once."""
    pairs = [
        posed_pair(posed[names[0]], posed[names[1]], category(names))
        for names in listed
        if posed.keys() >= set(names)
    ]
    unique = {pair.name: pair for pair in pairs}.values()
    return sorted(unique, key=lambda pair: (category_start(pair.category), pair.name))


def missing_notes(
    listed: Sequence[Names],
    names: Sequence[str],
    files: Mapping[str, Path],
    lacking: Mapping[str, str],
    what: str,
) -> list[str]:
    """Count listed pairs, and the names of their images, without a file or a truth (``what``).

    ``files`` has the files by name, ``lacking`` the reasons why there is no truth.
    """
    lost = sum(any(n not in files or n in lacking for n in pair) for pair in listed)
    of = f"of {len(names)} listed images"
    faults = [f"{name} ({why})" for name, why in lacking.items()]
    return [
        *([f"{lost} of {len(listed)} listed pairs are left out"] if lost else []),
        *counted([name for name in names if name not in files], f"{of} are not in images/"),
        *counted(faults, f"{of} have no usable {what}"),
    ]


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
        values: Array = np.array([float(value) for value in words])
    except ValueError as error:
        raise EvaluationError("its pose cannot be read") from error
    length = float(np.linalg.norm(values[:4]))
    if not np.isfinite(values).all():
        raise EvaluationError("its pose has values that are not finite")
    if abs(length - 1.0) > MAX_NOT_UNIT:
        raise EvaluationError(f"its quaternion has length {length:.3g}")
    rotation = pycolmap.Rotation3d(values[[1, 2, 3, 0]] / length).matrix()
    return np.asarray(rotation), values[4:]


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the numbered lines of a text file that are not empty or comments."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from error
    lines = ((number, line.strip()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


class Imc(PosedScenes):
    """Share of pairs with a rotation error below 5 degrees, by covisibility."""

    name: ClassVar[str] = "imc"
    category_title: ClassVar[str] = "covisibility, from"
    scene_pattern: ClassVar[str] = f"{SET_FOLDER}/{LIST_FOLDER}"
    dataset_title: ClassVar[str] = "the Phototourism sets"

    def load_scene(self, lists_path: Path) -> Dataset:
        """Read a scene by the folder of its lists of pairs."""
        root, scene = lists_path.parent, lists_path.absolute().parents[1].name
        lists, list_notes = _read_lists(lists_path)
        calibrations, faults = _read_calibrations(root / "calibration")
        files = scene_images(root / "images")
        known = calibrations.keys() | faults.keys() | files.keys()
        bins: dict[Names, str] = {}
        unclear = []
        for key, limit in disjoint_bins(lists).items():
            if names := _split(key, known):
                bins[names] = f"{limit / 10:.1f}"
            else:
                unclear.append(key)
        posed = _posed(scene, files, calibrations)
        pairs = posed_pairs(bins, posed, lambda names: bins[names])
        wanted = sorted({name for names in bins for name in names})
        uncalibrated = [name for name in wanted if name in files and name not in calibrations]
        lacking = {name: faults.get(name, "no file") for name in uncalibrated}
        used = {pair.category for pair in pairs}
        empty = ", ".join(name for limit in BINS[1:] if (name := f"{limit / 10:.1f}") not in used)
        notes = [
            *list_notes,
            *counted(unclear, "listed pairs are of images that are not there"),
            *missing_notes(list(bins), wanted, files, lacking, "calibration"),
            *([f"no pairs with a covisibility from {empty}"] if empty else []),
        ]
        return Dataset(tuple(pairs), tuple(f"{scene}: {note}" for note in notes))


Calibration = tuple[Array, Pose]  # what a calibration file says: (3, 3) K and camera_from_world


def disjoint_bins(lists: Mapping[int, list[str]]) -> dict[str, int]:
    """Turn cumulative lists, by their lower limits, into the largest limit of each pair.

    >>> disjoint_bins({1: ["a-b", "a-c"], 2: ["a-c"]})
    {'a-b': 1, 'a-c': 2}
    """
    return {key: limit for limit in sorted(lists) for key in lists[limit]}


def read_calibration(path: Path) -> Calibration:
    """Read and check a calibration file; EvaluationError says what is wrong with it."""
    try:
        with h5py.File(path) as file:
            there = [key for key in ("K", "R", "T") if key in file]
            values = {key: np.asarray(file[key][()], dtype=np.float64) for key in there}
    except (OSError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise EvaluationError(f"cannot be read ({error})") from error
    for key, size in (("K", 9), ("R", 9), ("T", 3)):
        if key not in values or values[key].size != size:
            raise EvaluationError(f"has no {key} of {size} values")
        if not np.isfinite(values[key]).all():
            raise EvaluationError(f"{key} has values that are not finite")
    matrix, rotation = values["K"].reshape(3, 3), values["R"].reshape(3, 3)
    if min(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]) <= 0 or np.any(
        matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != (0, 0, 0, 0, 1)
    ):
        raise EvaluationError("K is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    if fault := rotation_fault(rotation):
        raise EvaluationError(fault)
    return matrix, (rotation, values["T"].ravel())


def _read_lists(folder: Path) -> tuple[dict[int, list[str]], list[str]]:
    """Read the cumulative lists by their limits, and say what is odd about them."""
    lists: dict[int, list[str]] = {}
    notes = []
    for limit in BINS:
        path = folder / f"keys-th-0.{limit}.npy"
        try:
            lists[limit] = list(map(str, np.load(path, allow_pickle=False).ravel()))
            continue
        except FileNotFoundError:
            fault = "is missing" if limit else ""
        except (OSError, ValueError, EOFError) as error:
            fault = f"cannot be read ({error})"
        if fault:
            notes.append(f"{path.name} {fault}: its pairs count as of less covisibility")
    return lists, notes


def _read_calibrations(folder: Path) -> tuple[dict[str, Calibration], dict[str, str]]:
    found: dict[str, Calibration] = {}
    faults: dict[str, str] = {}
    for path in sorted(folder.glob(f"{CALIBRATION_PREFIX}*.h5")):
        name = path.stem.removeprefix(CALIBRATION_PREFIX)
        try:
            found[name] = read_calibration(path)
        except EvaluationError as error:
            faults[name] = str(error)
    return found, faults


def _split(key: str, known: set[str]) -> Names | None:
    """Split "a-b" where both names are known: names may have dashes in them."""
    words = key.split("-")
    splits = (("-".join(words[:k]), "-".join(words[k:])) for k in range(1, len(words)))
    return next((names for names in splits if known.issuperset(names)), None)


def _posed(
    scene: str, files: Mapping[str, Path], calibrations: Mapping[str, Calibration]
) -> dict[str, PosedImage]:
    """Give images their cameras."""
    found: dict[str, PosedImage] = {}
    for name in sorted(files.keys() & calibrations.keys()):
        path, (matrix, pose) = files[name], calibrations[name]
        width, height = np.rint(2 * matrix[:2, 2]).astype(int).tolist()
        params = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        found[name] = posed_image(f"{scene}/{path.name}", path, camera, pose)
    return found
