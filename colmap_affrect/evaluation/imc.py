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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.metrics import Pose
from colmap_affrect.errors import EvaluationError, ImageError
from colmap_affrect.evaluation.protocol import Dataset, EvaluationPair
from colmap_affrect.evaluation.relative_pose import (
    PosedImage,
    RelativePoseProtocol,
    category_start,
    posed_image,
    posed_pair,
)
from colmap_affrect.evaluation.truth_checks import contradictions, counted, rotation_fault
from colmap_affrect.executor import available_cores, map_ordered
from colmap_affrect.imaging import IMAGE_SUFFIXES, read_gray

SET_FOLDER = "set_100"
LIST_FOLDER = "new-vis-pairs"
CALIBRATION_PREFIX = "calibration_"
BINS = tuple(range(10))
"""Lower limits of the categories, in tenths; the list of the first may be missing."""

MAX_OFF_CENTRE = 1.15
"""Twice the principal point and the size of the image may differ by this factor."""

MAX_QUATERNION_ERROR = 1e-3
"""Largest difference of an element of R from that of the quaternion beside it."""

Names = tuple[str, str]
"""Of the images of a pair, without suffix."""


@dataclass(frozen=True)
class Imc(RelativePoseProtocol):
    """Share of pairs with a rotation error below 5 degrees, by covisibility."""

    name = "imc"
    category_title = "covisibility, from"

    def load(self, dataset_path: Path) -> Dataset:
        """Read a scene, or all scenes in a folder.

        Raises:
            EvaluationError: when there is no scene, or no pair can be evaluated.
        """
        folders = [dataset_path, *sorted(dataset_path.glob("*/"))]
        scenes = [folder for folder in folders if (folder / SET_FOLDER / LIST_FOLDER).is_dir()]
        if not scenes:
            raise EvaluationError(
                f"{dataset_path}: has no {SET_FOLDER}/{LIST_FOLDER}, nor has a folder in it; give "
                "a scene of the Phototourism sets, or the folder of its scenes"
            )
        loaded = [_load_scene(folder, check_truth=self.check_truth) for folder in scenes]
        return Dataset.united(loaded, dataset_path)


@dataclass(frozen=True)
class Calibration:
    """What a calibration file says, after all checks.

    Attributes:
        matrix: (3, 3) K, px with the origin in the corner.
        pose: camera_from_world.
        doubt: what is odd though usable; empty for nothing.
    """

    matrix: NDArray[np.float64]
    pose: Pose
    doubt: str = ""


def disjoint_bins(lists: Mapping[int, list[str]]) -> dict[str, int]:
    """Turn cumulative lists into the category of each of their pairs: the largest one.

    Args:
        lists: pairs by the lower limit of their covisibility, in tenths.

    >>> disjoint_bins({1: ["a-b", "a-c"], 2: ["a-c"]})
    {'a-b': 1, 'a-c': 2}
    """
    return {key: limit for limit in sorted(lists) for key in lists[limit]}


def read_calibration(path: Path) -> Calibration:
    """Read and check a calibration file.

    Raises:
        EvaluationError: when it cannot be used, saying why but not of which file.
    """
    try:
        with h5py.File(path) as file:
            values = {
                key: np.asarray(file[key][()], dtype=np.float64)
                for key in ("K", "R", "T", "q")
                if key in file
            }
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
    doubt = _quaternion_doubt(rotation, values.get("q"))
    return Calibration(matrix, (rotation, values["T"].ravel()), doubt)


def _quaternion_doubt(rotation: NDArray[np.float64], q: NDArray[np.float64] | None) -> str:
    """Compare R with the quaternion (w, x, y, z) that the challenge's files have beside it."""
    if q is None or q.size != 4 or not np.isfinite(q).all() or not q.any():
        return ""
    expected = pycolmap.Rotation3d(q.ravel()[[1, 2, 3, 0]] / np.linalg.norm(q)).matrix()
    if np.abs(rotation - expected).max() < MAX_QUATERNION_ERROR:
        return ""
    if np.abs(rotation.T - expected).max() < MAX_QUATERNION_ERROR:
        return "R is transposed, by the quaternion beside it"
    return "R and the quaternion beside it differ"


def _load_scene(folder: Path, *, check_truth: bool) -> Dataset:
    root, scene = folder / SET_FOLDER, folder.absolute().name
    lists, notes = _read_lists(root / LIST_FOLDER)
    calibrations, faults = _read_calibrations(root / "calibration")
    files = {
        path.stem: path
        for path in sorted((root / "images").glob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES
    }
    bins: dict[Names, int] = {}
    unclear = []
    for key, limit in disjoint_bins(lists).items():
        names = _split(key, calibrations.keys() | faults.keys() | files.keys())
        if names is None:
            unclear.append(key)
        else:
            bins[names] = limit
    posed, size_notes = _posed(scene, files, calibrations)
    pairs = [
        posed_pair(posed[names[0]], posed[names[1]], f"{limit / 10:.1f}")
        for names, limit in bins.items()
        if all(name in posed for name in names)
    ]
    pairs.sort(key=lambda pair: (category_start(pair.category), pair.name))
    wanted = {name for names in bins for name in names}
    without_file = sorted(wanted - files.keys())
    uncalibrated = sorted(wanted & files.keys() - calibrations.keys())
    notes += [
        *_left_out_notes(bins, posed),
        *counted(unclear, "listed pairs are of images that are not there", unclear),
        *counted(without_file, f"of {len(wanted)} listed images are not in images/", without_file),
        *counted(
            uncalibrated,
            f"of {len(wanted)} listed images have no usable calibration",
            [f"{name} ({faults.get(name, 'no file')})" for name in uncalibrated],
        ),
        *_doubt_notes(calibrations, wanted),
        *size_notes,
        *(contradictions(pairs[::-1]) if check_truth else ()),
        *_empty_notes(pairs),
    ]
    return Dataset(tuple(pairs), tuple(f"{scene}: {note}" for note in notes))


def _read_lists(folder: Path) -> tuple[dict[int, list[str]], list[str]]:
    """Read the cumulative lists by their limits, and say what is odd about them."""
    lists: dict[int, list[str]] = {}
    notes = []
    for limit in BINS:
        path = folder / f"keys-th-0.{limit}.npy"
        try:
            values = np.load(path, allow_pickle=False)
        except FileNotFoundError:
            if limit:
                notes.append(f"{path.name} is missing: its pairs count as of less covisibility")
            continue
        except (OSError, ValueError, EOFError) as error:
            notes.append(
                f"{path.name} cannot be read ({error}): its pairs count as of less covisibility"
            )
            continue
        lists[limit] = [str(value) for value in values.ravel()]
    for lower, upper in itertools.pairwise(sorted(lists)):
        extra = sorted(set(lists[upper]) - set(lists[lower]))
        notes += counted(extra, f"pairs of list 0.{upper} are not in list 0.{lower}", extra)
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
    for number in range(1, len(words)):
        names = "-".join(words[:number]), "-".join(words[number:])
        if known.issuperset(names):
            return names
    return None


def _posed(
    scene: str, files: Mapping[str, Path], calibrations: Mapping[str, Calibration]
) -> tuple[dict[str, PosedImage], list[str]]:
    """Give images their cameras; also say whose intrinsics are of another size."""
    names = sorted(files.keys() & calibrations.keys())
    sizes = map_ordered(lambda name: _size(files[name]), names, available_cores())
    found: dict[str, PosedImage] = {}
    scaled, unfitting = [], []
    for name, size in zip(names, sizes, strict=True):
        path, matrix = files[name], calibrations[name].matrix
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
        found[name] = posed_image(f"{scene}/{path.name}", path, camera, calibrations[name].pose)
    notes = [
        *counted(
            scaled,
            "images are of another size than their K, which is scaled",
            scaled,
        ),
        *counted(unfitting, "images are of another shape than their K", unfitting),
    ]
    return found, notes


def _size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) of an image, None if it cannot be read: it fails when it is used."""
    try:
        height, width = read_gray(path).shape
    except ImageError:
        return None
    return width, height


def _scale(matrix: NDArray[np.float64], width: int, height: int) -> float | None:
    """Return what K is to be multiplied by to fit an image; None if nothing makes it fit."""
    ratios = np.array([width, height]) / (2.0 * matrix[:2, 2])
    if np.all(np.maximum(ratios, 1 / ratios) < MAX_OFF_CENTRE):
        return 1.0
    if ratios.max() > MAX_OFF_CENTRE * ratios.min():
        return None
    return float(ratios[0])


def _doubt_notes(calibrations: Mapping[str, Calibration], wanted: set[str]) -> Iterator[str]:
    by_doubt: dict[str, list[str]] = {}
    for name in sorted(wanted & calibrations.keys()):
        by_doubt.setdefault(calibrations[name].doubt, []).append(name)
    for doubt in sorted(by_doubt.keys() - {""}):
        names = by_doubt[doubt]
        yield from counted(names, f"of {len(wanted)} calibrations: {doubt}", names)


def _left_out_notes(bins: Mapping[Names, int], posed: Mapping[str, PosedImage]) -> Iterator[str]:
    lost = [names for names in bins if any(name not in posed for name in names)]
    if lost:
        yield f"{len(lost)} of {len(bins)} listed pairs are left out"


def _empty_notes(pairs: list[EvaluationPair]) -> Iterator[str]:
    """Name the bins without pairs."""
    left = {pair.category for pair in pairs}
    empty = [f"{limit / 10:.1f}" for limit in BINS[1:] if f"{limit / 10:.1f}" not in left]
    if empty:
        yield "no pairs with a covisibility from " + ", ".join(empty)
