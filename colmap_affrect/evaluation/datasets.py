"""Layouts of datasets, as docs/own-evaluation-set.md has them: EVD, SVP, IMC, and any pairs."""

import json
import logging
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import camera_matrix
from colmap_affrect.colmap.model_files import Pose, relative_pose
from colmap_affrect.errors import AffrectError, OptionError, damage, such_as
from colmap_affrect.evaluation.truths import Correspondences, TrueHomography, TruePose
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.geometry.conventions import colmap_from_pixel, pixel_from_colmap
from colmap_affrect.images.reading import IMAGE_SUFFIXES
from colmap_affrect.options import Options
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.project.outputs import leads_outside
from colmap_affrect.project.regular_files import read_regular_text, require_regular

logger = logging.getLogger(__name__)

Names = tuple[str, str]  # of the images of a pair
Truth = TrueHomography | TruePose | Correspondences
Views = Mapping[str, tuple[pycolmap.Camera, Pose]]
"""Cameras and cam_from_world poses by the name of the image without suffix."""
PAIR_LIST_SUFFIX = "_image_pairs.txt"
CATEGORY_DEG = 10
CALIBRATION_PREFIX = "calibration_"
ORIGIN_PX = {"center": 0.0, "corner": float(pixel_from_colmap(np.zeros(1))[0])}


@dataclass(frozen=True)
class EvaluationPair:
    """Two images whose matches are scored."""

    name: str
    images: Names  # the keys of their features and depth maps
    paths: tuple[Path, Path]
    truth: Truth
    category: str = ""  # of difficulty, as tables group pairs; empty for none

    @property
    def intrinsics(self) -> list[Array | None]:
        """(3, 3) camera matrices in pixel-centre px, without distortion; None if not known."""
        cameras = self.truth.cameras if isinstance(self.truth, TruePose) else (None, None)
        return [camera_matrix(camera) if camera else None for camera in cameras]


Pairs = list[EvaluationPair]


class _Entry(Options):
    image1: str
    image2: str
    name: str = ""
    category: str = ""
    homography: Any = None
    correspondences: Any = None
    relative_pose: Any = None


def load_evd(folder: Path) -> Pairs:
    """Find pairs with homographies; AffrectError when the layout is another one."""
    files = [file for part in "12h" for file in (folder / part).glob("*")]
    names = {file.stem for file in files if file.suffix.lower() in (".txt", *IMAGE_SUFFIXES)}

    def image(name: str) -> str:  # PNG where there is none
        names = (name + suffix for suffix in IMAGE_SUFFIXES)
        return next((name for name in names if (folder / name).is_file()), f"{name}.png")

    def entry(name: str, one: str, two: str, matrix: str) -> _Entry:
        return _Entry(name=name, image1=image(one), image2=image(two), homography=matrix)

    found = [entry(name, f"1/{name}", f"2/{name}", f"h/{name}.txt") for name in sorted(names)]
    for file in sorted(folder.glob("H_*.txt")):
        if parts := re.fullmatch(r"H_(.+)_([^_]+)_([^_]+)", file.stem):
            name, one, two = parts.groups()
            found.append(entry(f"{name} {one}-{two}", f"{name}_{one}", f"{name}_{two}", file.name))
    if not found:
        layouts = "1/NAME.png, 2/NAME.png, h/NAME.txt nor NAME_1.png, NAME_2.png, H_NAME_1_2.txt"
        raise AffrectError(f"{folder}: holds neither {layouts}")
    return _loaded(found, folder, 0.0)


def _scenes(pattern: str, load: Callable[[Path], Pairs], path: Path) -> Pairs:
    """Read one or all scenes, by the file that makes a folder one; AffrectError if none."""
    folders = [path, *sorted(path.glob("*/"))]
    files = [file for folder in folders for file in sorted(folder.glob(pattern))]
    pairs = [pair for file in files for pair in load(file)]
    if not pairs:
        why = f"; it has no {pattern}, nor has a folder in it" if not files else ""
        raise AffrectError(f"{path}: no pair can be evaluated{why}")
    return pairs


def _posed_pairs(
    scene: str, folder: Path, views: Views, listed: Collection[Names], category: Callable[..., str]
) -> Pairs:
    """Return the listed pairs of images that are there and posed, ordered by their category.

    How many others are listed is a warning.
    """
    images, pairs, lacking = {}, {}, []
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix.lower() in IMAGE_SUFFIXES and stem(name) in views:
            images[stem(name)] = f"{scene}/{name}", path
    for names in listed:
        if gone := [name for name in names if name not in images]:
            lacking.append(gone[0])
            continue
        (camera1, pose1), (camera2, pose2) = (views[name] for name in names)
        truth = TruePose((camera1, camera2), relative_pose(pose1, pose2))
        (key1, path1), (key2, path2) = (images[name] for name in names)
        paths, title = (path1, path2), f"{key1} {key2}"
        pairs[title] = EvaluationPair(title, (key1, key2), paths, truth, category(*names))
    if lacking:
        logger.warning(
            "%s: %d of %d listed pairs are left out, without an image or its camera: %s",
            scene, len(lacking), len(listed), such_as(dict.fromkeys(lacking)),
        )  # fmt: skip
    return sorted(pairs.values(), key=lambda pair: (float(pair.category.rstrip("°")), pair.name))


def _svp_scene(list_path: Path) -> Pairs:
    folder, scene = list_path.parent, list_path.name.removesuffix(PAIR_LIST_SUFFIX)
    views, listed = read_views(folder / "0"), []
    for words in map(str.split, _lines(list_path)):
        if len(words) not in (2, 3):
            raise AffrectError(f"{list_path}: '{' '.join(words)}' is no pair of images")
        listed.append((stem(words[0]), stem(words[1])))

    def category(name1: str, name2: str) -> str:  # tens of degrees of rotation
        rotation, _ = relative_pose(views[name1][1], views[name2][1])
        angle_deg = np.rad2deg(pycolmap.Rotation3d(rotation).angle())
        return f"{CATEGORY_DEG * int(angle_deg // CATEGORY_DEG)}°"

    return _posed_pairs(scene, folder / "images", views, listed, category)


load_svp: Callable[[Path], Pairs] = partial(_scenes, f"*{PAIR_LIST_SUFFIX}", _svp_scene)


def read_views(folder: Path) -> Views:
    """Read ``images.txt`` and ``cameras.txt``; AffrectError when that cannot be done."""
    cameras, views = {}, {}
    posed = [line for line in _lines(folder / "images.txt") if stem(line) != line]  # not points
    with _damaged(folder):
        for line in _lines(folder / "cameras.txt"):
            key, model, width, height, *words = line.split()
            params = finite_numbers(words, (-1,), f"{folder / 'cameras.txt'}: camera {key}")
            size = {"width": int(width), "height": int(height)}
            cameras[key] = pycolmap.Camera(model=model, params=params.tolist(), **size)
            if not cameras[key].verify_params():
                raise ValueError(f"camera {key} has {len(params)} parameters")
        for line in posed:
            _, w, x, y, z, *translation, key, name = line.split(maxsplit=9)
            turn = pycolmap.Rotation3d(np.array([x, y, z, w], dtype=np.float64))
            turn.normalize()
            pose = turn.matrix(), np.array(translation, dtype=np.float64)
            views[stem(name)] = cameras[key], pose
    return views


def stem(name: str) -> str:
    """Return the name of an image without its suffix; other text as it is."""
    path = PurePosixPath(name)
    is_image = path.suffix.lower() in IMAGE_SUFFIXES
    return path.with_suffix("").as_posix() if is_image else name


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    with damage(path, "see docs/own-evaluation-set.md for the format"):
        if not path.is_dir():
            require_regular(path)
        yield


def _lines(path: Path) -> list[str]:
    with _damaged(path):
        lines = map(str.strip, read_regular_text(path, "utf-8-sig").splitlines())
        return [line for line in lines if line and not line.startswith("#")]


def _imc_scene(lists_path: Path) -> Pairs:
    root, scene = lists_path.parent, lists_path.absolute().parents[1].name
    views = {
        path.stem.removeprefix(CALIBRATION_PREFIX): read_calibration(path)
        for path in sorted((root / "calibration").glob(f"{CALIBRATION_PREFIX}*.h5"))
    }
    bins: dict[Names, str] = {}
    for limit in range(10):
        path = lists_path / f"keys-th-0.{limit}.npy"
        if limit or path.exists():
            with _damaged(path):
                keys = np.load(path, allow_pickle=False).ravel().tolist()
                bins |= {_split(str(key), views): f"0.{limit}" for key in keys}
    return _posed_pairs(scene, root / "images", views, bins, lambda *names: bins[names])


load_imc: Callable[[Path], Pairs] = partial(_scenes, "set_100/new-vis-pairs", _imc_scene)


def _split(key: str, known: Views) -> Names:
    """Split "a-b" where both names are known: names may have dashes in them."""
    words = key.split("-")
    splits = [("-".join(words[:k]), "-".join(words[k:])) for k in range(1, len(words))]
    return next((names for names in splits if known.keys() >= set(names)), (key, key))


def read_calibration(path: Path) -> tuple[pycolmap.Camera, Pose]:
    """Read the camera and cam_from_world of an image; AffrectError says what is wrong."""
    given, shapes = {}, {"K": (3, 3), "R": (3, 3), "T": (3,)}
    with _damaged(path), h5py.File(path) as file:
        for key, shape in shapes.items():
            given[key] = finite_numbers(np.squeeze(file[key][()]), shape, f"{path}: {key}")
    return pinhole(given["K"], f"{path}: K"), (given["R"], given["T"])


def finite_numbers(given: Any, shape: tuple[int, ...], what: str) -> Array:
    """Return an array; a shape that begins with -1 has any number of rows. AffrectError."""
    try:
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise AffrectError(f"{what} is not numbers ({error})") from error
    if values.shape != (values.shape[:1] if shape[0] == -1 else shape[:1]) + shape[1:]:
        raise AffrectError(f"{what} has shape {values.shape}, expected {shape}")
    if not np.isfinite(values).all() or not values.size:
        raise AffrectError(f"{what} is empty or has values that are not finite")
    return values


def pinhole(matrix: Array, what: str) -> pycolmap.Camera:
    """Return the camera of a (3, 3) matrix of COLMAP's px; AffrectError when it is none."""
    (fx, skew, cx), (zero, fy, cy), last = matrix.tolist()
    if min(fx, fy, cx, cy) <= 0 or (skew, zero, *last) != (0, 0, 0, 0, 1):
        raise AffrectError(f"{what} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    width, height = round(2 * cx), round(2 * cy)
    return pycolmap.Camera(model="PINHOLE", width=width, height=height, params=[fx, fy, cx, cy])


def load_pairs(folder: Path) -> Pairs:
    """Read ``pairs.json``; AffrectError says what is wrong."""
    path = folder / "pairs.json"
    with _damaged(path):
        content = json.loads(read_regular_text(path, "utf-8-sig"))
        entries = [_entry(each, f"{path}: pairs[{k}]") for k, each in enumerate(content["pairs"])]
        offset_px = ORIGIN_PX[content.get("pixel_origin", "center")]
    names = [entry.name for entry in entries]
    if not names:
        raise AffrectError(f"{path}: has no pairs")
    if twice := [name for name in names if names.count(name) > 1]:
        raise AffrectError(f"{path}: two pairs are called '{twice[0]}'; give them names")
    return _loaded(entries, folder, offset_px)


PROTOCOLS = {"evd": load_evd, "svp": load_svp, "imc": load_imc, "pairs": load_pairs}


def _entry(values: Any, where: str) -> _Entry:
    try:
        entry = _Entry.from_mapping(values, where)
    except OptionError as error:
        raise AffrectError(str(error)) from error
    if leads_outside(entry.image1) or leads_outside(entry.image2):
        raise AffrectError(f"{where}: images must be paths of images in the folder")
    if (entry.homography, entry.correspondences, entry.relative_pose).count(None) != 2:
        raise AffrectError(f"{where}: needs homography, correspondences or relative_pose, and one")
    return entry.changed(name=entry.name or f"{stem(entry.image1)} {stem(entry.image2)}")


def _loaded(entries: Sequence[_Entry], folder: Path, offset_px: float) -> Pairs:
    """Return pairs with their truth; ``offset_px`` is added to coordinates for pixel centres."""

    def pair(entry: _Entry) -> EvaluationPair:
        images = entry.image1, entry.image2
        paths, truth = (folder / images[0], folder / images[1]), _truth(entry, folder, offset_px)
        return EvaluationPair(entry.name, images, paths, truth, entry.category)

    return list(map_ordered(pair, entries, available_cores()))


def _truth(entry: _Entry, folder: Path, offset_px: float) -> Truth:
    name, numbers = entry.name, entry.homography or entry.correspondences
    if isinstance(numbers, str):
        if leads_outside(numbers):
            raise AffrectError(f"{numbers}: must be a file in the folder of the pairs")
        with _damaged(folder / numbers):
            numbers = np.loadtxt(folder / numbers, ndmin=2)
    if entry.homography is not None:
        center = np.array([[1.0, 0.0, offset_px], [0.0, 1.0, offset_px], [0.0, 0.0, 1.0]])
        matrix = center @ finite_numbers(numbers, (3, 3), f"{name}: homography")
        paths = [folder / entry.image1, folder / entry.image2]
        return TrueHomography.of(matrix @ np.linalg.inv(center), paths, f"{name}: homography")
    if entry.correspondences is not None:
        points = finite_numbers(numbers, (-1, 4), f"{name}: correspondences")
        return Correspondences(points + offset_px)
    shapes = {"rotation": (3, 3), "translation": (3,), "intrinsics1": (3, 3), "intrinsics2": (3, 3)}
    given = entry.relative_pose
    if not isinstance(given, Mapping) or given.keys() != shapes.keys():
        raise AffrectError(f"{name}: relative_pose needs {', '.join(shapes)}")
    values = {k: finite_numbers(given[k], shape, f"{name}: {k}") for k, shape in shapes.items()}

    def camera(key: str) -> pycolmap.Camera:
        values[key][:2, 2] = colmap_from_pixel(values[key][:2, 2] + offset_px)
        return pinhole(values[key], f"{name}: {key}")

    pose = values["rotation"], values["translation"]
    return TruePose((camera("intrinsics1"), camera("intrinsics2")), pose)
