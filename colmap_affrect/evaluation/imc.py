"""The Image Matching Challenge's Phototourism sets, and scenes that are laid out like them.

A scene is a folder with ``set_100/``, and in it::

    images/<image>.jpg
    calibration/calibration_<image>.h5   K (3 x 3), R (3 x 3), T (3): x_camera = R x + T
    new-vis-pairs/keys-th-0.<k>.npy      names "<image 1>-<image 2>" with covisibility >= 0.<k>

The lists are cumulative; the categories are their differences, from 0.1 on, as in the paper, or
from 0.0 where there is such a list. A dataset is a scene or a folder of scenes. Images are known by
``<scene>/<file name>``, and so are their depth maps.

K is COLMAP's: the origin is the corner of the image. Where it is plainly that of another size
(its principal point, taken for the middle, is far from the middle of the image), it is scaled.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.poses import Pose
from colmap_affrect.errors import EvaluationError
from colmap_affrect.evaluation.protocol import Dataset, counted
from colmap_affrect.evaluation.relative_pose import (
    Names,
    PosedImage,
    PosedScenes,
    missing_notes,
    posed_image,
    posed_pairs,
    scene_images,
)
from colmap_affrect.evaluation.truth_checks import (
    image_sizes,
    pose_contradictions,
    rotation_fault,
)

SET_FOLDER = "set_100"
LIST_FOLDER = "new-vis-pairs"
CALIBRATION_PREFIX = "calibration_"
BINS = tuple(range(10))
"""Lower limits of the categories, in tenths; the list of the first may be missing."""

MAX_OFF_CENTRE = 1.15
"""Twice the principal point and the size of the image may differ by this factor."""


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
        posed, size_notes = _posed(scene, files, calibrations)
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
            *size_notes,
            *(pose_contradictions(pairs[::-1]) if self.check_truth else ()),
            *([f"no pairs with a covisibility from {empty}"] if empty else []),
        ]
        return Dataset(tuple(pairs), tuple(f"{scene}: {note}" for note in notes))


Calibration = tuple[NDArray[np.float64], Pose]
"""What a calibration file says: (3, 3) K and camera_from_world."""


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
    for lower, upper in itertools.pairwise(sorted(lists)):
        extra = sorted(set(lists[upper]) - set(lists[lower]))
        notes += counted(extra, f"pairs of list 0.{upper} are not in list 0.{lower}")
    return lists, notes


def _read_calibrations(folder: Path) -> tuple[dict[str, Calibration], dict[str, str]]:
    """Read all calibrations by image name; those that cannot be used with the reason."""
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
) -> tuple[dict[str, PosedImage], list[str]]:
    """Give images their cameras; also say whose intrinsics are of another size."""
    names = sorted(files.keys() & calibrations.keys())
    sizes = image_sizes(files[name] for name in names)
    found: dict[str, PosedImage] = {}
    scaled, unfitting = [], []
    for name, size in zip(names, sizes, strict=True):
        path, (matrix, pose) = files[name], calibrations[name]
        guess = tuple(np.rint(2 * matrix[:2, 2]).astype(int).tolist())
        width, height = size or guess
        example = f"{path.name} ({width} x {height} px, K about {guess[0]} x {guess[1]} px)"
        scale = _scale(matrix, width, height)
        if scale is None:
            unfitting.append(example)
        elif scale != 1.0:
            matrix = np.diag([scale, scale, 1.0]) @ matrix
            scaled.append(example)
        params = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        found[name] = posed_image(f"{scene}/{path.name}", path, camera, pose)
    return found, [
        *counted(scaled, "images are of another size than their K, which is scaled"),
        *counted(unfitting, "images are of another shape than their K"),
    ]


def _scale(matrix: NDArray[np.float64], width: int, height: int) -> float | None:
    """Return what K is to be multiplied by to fit an image; None if nothing makes it fit."""
    ratios = np.array([width, height]) / (2.0 * matrix[:2, 2])
    if np.all(np.maximum(ratios, 1 / ratios) < MAX_OFF_CENTRE):
        return 1.0
    if ratios.max() > MAX_OFF_CENTRE * ratios.min():
        return None
    return float(ratios[0])
