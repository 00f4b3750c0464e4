"""Layouts of datasets, as docs/own-evaluation-set.md has them: EVD, SVP, IMC, and any pairs."""

import json
import logging
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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
PAIR_LIST_SUFFIX = "_image_pairs.txt"  # of SVP
CATEGORY_DEG = 10  # of rotation, in a category of SVP; paper
CALIBRATION_PREFIX = "calibration_"  # of IMC
NUM_COVISIBILITY_LIMITS = 10  # of IMC: 0.0, 0.1, ... 0.9; paper
# Format of our own
ORIGIN_PX = {"center": 0.0, "corner": float(pixel_from_colmap(np.zeros(1))[0])}
"""What is added to coordinates of ``pairs.json`` for pixel-centre px, by its ``pixel_origin``."""


@dataclass(frozen=True)
class EvaluationPair:
    """Two images whose matches are scored."""

    name: str
    images: Names  # keys of their features and depth maps
    paths: tuple[Path, Path]
    truth: Truth
    category: str = ""  # of difficulty, as tables group pairs; empty for none

    @property
    def intrinsics(self) -> list[Array | None]:
        """(3, 3) camera matrices in pixel-centre px, without distortion; None if not known."""
        if not isinstance(self.truth, TruePose):
            return [None, None]
        return [camera_matrix(camera) for camera in self.truth.cameras]


Pairs = list[EvaluationPair]


class _Entry(Options):
    """A pair of ``pairs.json``."""

    image1: str
    image2: str
    name: str = ""
    category: str = ""
    homography: Any = None
    correspondences: Any = None
    relative_pose: Any = None


def load_evd(folder: Path) -> Pairs:
    """Read pairs with homographies, in folders 1, 2 and h or by the names of homographies.

    AffrectError when the layout is another one.
    """
    names = set()
    for part in ("1", "2", "h"):
        for file in (folder / part).glob("*"):
            if file.suffix.lower() in (".txt", *IMAGE_SUFFIXES):
                names.add(file.stem)
    entries = list[_Entry]()
    for name in sorted(names):
        entries.append(
            _evd_entry(
                folder=folder,
                name=name,
                stem1=f"1/{name}",
                stem2=f"2/{name}",
                homography=f"h/{name}.txt",
            )
        )
    for file in sorted(folder.glob("H_*.txt")):
        parts = re.fullmatch(r"H_(.+)_([^_]+)_([^_]+)", file.stem)
        if parts:
            scene, view1, view2 = parts.groups()
            name = f"{scene} {view1}-{view2}"
            entries.append(
                _evd_entry(
                    folder=folder,
                    name=name,
                    stem1=f"{scene}_{view1}",
                    stem2=f"{scene}_{view2}",
                    homography=file.name,
                )
            )
    if not entries:
        layouts = "1/NAME.png, 2/NAME.png, h/NAME.txt nor NAME_1.png, NAME_2.png, H_NAME_1_2.txt"
        raise OptionError(f"holds neither {layouts}", where=folder)
    return _load(entries, folder, 0.0)


def _evd_entry(
    folder: Path, name: str, stem1: str, stem2: str, homography: str
) -> _Entry:
    """Return a pair of images by their paths without suffix."""
    paths = []
    for path in (stem1, stem2):
        possible = [path + suffix for suffix in IMAGE_SUFFIXES]
        known = [name for name in possible if (folder / name).is_file()]
        paths.append(known[0] if known else f"{path}.png")
    return _Entry(name=name, image1=paths[0], image2=paths[1], homography=homography)


def _load_scenes(pattern: str, load: Callable[[Path], Pairs], path: Path) -> Pairs:
    """Read one scene, or all scenes of a folder.

    Args:
        pattern: of the file that every scene has.
        load: reads a scene by this file.
        path: folder of a scene, or of scenes.

    Raises:
        AffrectError: there is no pair.
    """
    files = []
    pairs = []
    for folder in [path, *sorted(path.glob("*/"))]:
        files += sorted(folder.glob(pattern))
    for file in files:
        pairs += load(file)
    if not pairs:
        why = f"; it has no {pattern}, nor has a folder in it" if not files else ""
        raise AffrectError(f"no pair can be evaluated{why}", where=path)
    return pairs


def _posed_pairs(
    scene: str,
    folder: Path,
    views: Views,
    listed: Collection[Names],
    category: Callable[..., str],
) -> Pairs:
    """Return the listed pairs of images that are there and posed; a warning tells of the others.

    Args:
        scene: name of the scene.
        folder: of its images.
        views: poses of images.
        listed: pairs of names without suffix.
        category: of difficulty, by both names.

    Returns:
        Pairs, ordered by their category.
    """
    images = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.suffix.lower() in IMAGE_SUFFIXES and stem(name) in views:
            images[stem(name)] = (f"{scene}/{name}", path)
    pairs = {}
    lacking = []
    for name1, name2 in listed:
        if name1 not in images or name2 not in images:
            lacking.append(name2 if name1 in images else name1)
            continue
        camera1, pose1 = views[name1]
        camera2, pose2 = views[name2]
        truth = TruePose((camera1, camera2), relative_pose(pose1, pose2))
        key1, path1 = images[name1]
        key2, path2 = images[name2]
        title = f"{key1} {key2}"
        pairs[title] = EvaluationPair(
            name=title,
            images=(key1, key2),
            paths=(path1, path2),
            truth=truth,
            category=category(name1, name2),
        )
    if lacking:
        logger.warning(
            "%s: %d of %d listed pairs are left out, without an image or its camera: %s",
            scene, len(lacking), len(listed), such_as(dict.fromkeys(lacking)),
        )  # fmt: skip
    return sorted(
        pairs.values(), key=lambda pair: (float(pair.category.rstrip("°")), pair.name)
    )


def load_svp(path: Path) -> Pairs:
    """Read one or all scenes of Strong ViewPoint Changes; AffrectError says what is wrong."""
    return _load_scenes(f"*{PAIR_LIST_SUFFIX}", _load_svp_scene, path)


def _load_svp_scene(list_path: Path) -> Pairs:
    folder = list_path.parent
    scene = list_path.name.removesuffix(PAIR_LIST_SUFFIX)
    views = read_views(folder / "0")
    listed = []
    for line in _lines(list_path):
        words = line.split()
        if len(words) not in (2, 3):
            raise AffrectError(
                f"'{' '.join(words)}' is no pair of images", where=list_path
            )
        listed.append((stem(words[0]), stem(words[1])))

    def category(name1: str, name2: str) -> str:  # tens of degrees of rotation
        rotation, _ = relative_pose(views[name1][1], views[name2][1])
        angle_deg = np.rad2deg(pycolmap.Rotation3d(rotation).angle())
        return f"{CATEGORY_DEG * int(angle_deg // CATEGORY_DEG)}°"

    return _posed_pairs(
        scene=scene,
        folder=folder / "images",
        views=views,
        listed=listed,
        category=category,
    )


def read_views(folder: Path) -> Views:
    """Read ``images.txt`` and ``cameras.txt``; AffrectError when that cannot be done."""
    cameras = {}
    views = {}
    image_lines = _lines(folder / "images.txt")
    with _damaged(folder):
        for line in _lines(folder / "cameras.txt"):
            key, model, width, height, *words = line.split()
            params = finite_numbers(
                words, (-1,), f"{folder / 'cameras.txt'}: camera {key}"
            )
            cameras[key] = pycolmap.Camera(
                model=model,
                params=params.tolist(),
                width=int(width),
                height=int(height),
            )
            if not cameras[key].verify_params():
                raise ValueError(f"camera {key} has {len(params)} parameters")
        for line in image_lines:
            if stem(line) == line:  # keypoints of the image in the line before
                continue
            _, w, x, y, z, *translation, key, name = line.split(maxsplit=9)
            rotation = pycolmap.Rotation3d(np.array([x, y, z, w], dtype=np.float64))
            rotation.normalize()
            pose = (rotation.matrix(), np.array(translation, dtype=np.float64))
            views[stem(name)] = (cameras[key], pose)
    return views


def stem(name: str) -> str:
    """Return the name of an image without its suffix; other text as it is."""
    path = PurePosixPath(name)
    is_image = path.suffix.lower() in IMAGE_SUFFIXES
    return path.with_suffix("").as_posix() if is_image else name


@contextmanager
def _damaged(path: Path) -> Iterator[None]:
    """Say of a file or folder that cannot be read that it is damaged; AffrectError."""
    with damage(path, "see docs/own-evaluation-set.md for the format"):
        if not path.is_dir():
            require_regular(path)
        yield


def _lines(path: Path) -> list[str]:
    """Return the lines of a text file that are neither empty nor comments."""
    with _damaged(path):
        lines = map(str.strip, read_regular_text(path, "utf-8-sig").splitlines())
        return [line for line in lines if line and not line.startswith("#")]


def load_imc(path: Path) -> Pairs:
    """Read one or all scenes of the Image Matching Challenge; AffrectError says what is wrong."""
    return _load_scenes("set_100/new-vis-pairs", _load_imc_scene, path)


def _load_imc_scene(lists_path: Path) -> Pairs:
    root = lists_path.parent
    scene = lists_path.absolute().parents[1].name
    views = {}
    for path in sorted((root / "calibration").glob(f"{CALIBRATION_PREFIX}*.h5")):
        views[path.stem.removeprefix(CALIBRATION_PREFIX)] = read_calibration(path)
    # Covisibility; lists are cumulative, and the last counts
    categories: dict[Names, str] = {}
    for limit in range(NUM_COVISIBILITY_LIMITS):
        path = lists_path / f"keys-th-0.{limit}.npy"
        if limit == 0 and not path.exists():  # this list may be missing
            continue
        with _damaged(path):
            for key in np.load(path, allow_pickle=False).ravel().tolist():
                categories[_split(str(key), views)] = f"0.{limit}"
    return _posed_pairs(
        scene=scene,
        folder=root / "images",
        views=views,
        listed=categories,
        category=lambda *names: categories[names],
    )


def _split(key: str, known: Views) -> Names:
    """Split "a-b" where both names are known: names may have dashes in them."""
    words = key.split("-")
    for position in range(1, len(words)):
        name1 = "-".join(words[:position])
        name2 = "-".join(words[position:])
        if name1 in known and name2 in known:
            return name1, name2
    return key, key


def read_calibration(path: Path) -> tuple[pycolmap.Camera, Pose]:
    """Read the camera and cam_from_world of an image; AffrectError says what is wrong."""
    values = {}
    with _damaged(path), h5py.File(path) as file:
        for key, shape in {"K": (3, 3), "R": (3, 3), "T": (3,)}.items():
            values[key] = finite_numbers(
                np.squeeze(file[key][()]), shape, f"{path}: {key}"
            )
    return pinhole(values["K"], f"{path}: K"), (values["R"], values["T"])


def finite_numbers(given: Any, shape: tuple[int, ...], what: str) -> Array:
    """Return numbers out of a file as an array.

    Args:
        given: nested sequences of numbers, or of texts of them.
        shape: of the array; one that begins with -1 has any number of rows.
        what: an error begins with it.

    Returns:
        The float64 array, which is not empty.

    Raises:
        AffrectError: these are not finite numbers, or the shape is another one.
    """
    try:
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise AffrectError(f"{what} is not numbers ({error})") from error
    expected = (*values.shape[:1], *shape[1:]) if shape[0] == -1 else shape
    if values.shape != expected:
        raise AffrectError(f"{what} has shape {values.shape}, expected {shape}")
    if not np.isfinite(values).all() or not values.size:
        raise AffrectError(f"{what} is empty or has values that are not finite")
    return values


def pinhole(matrix: Array, what: str) -> pycolmap.Camera:
    """Return the camera of (3, 3) intrinsics in COLMAP's px; AffrectError when they are others.

    Its size is unknown, and such that the principal point is in the middle.
    """
    (fx, skew, cx), (zero, fy, cy), last = matrix.tolist()
    if min(fx, fy, cx, cy) <= 0 or (skew, zero, *last) != (0, 0, 0, 0, 1):
        raise AffrectError(f"{what} is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return pycolmap.Camera(
        model="PINHOLE",
        width=round(2 * cx),
        height=round(2 * cy),
        params=[fx, fy, cx, cy],
    )


def load_pairs(folder: Path) -> Pairs:
    """Read ``pairs.json``; AffrectError says what is wrong."""
    path = folder / "pairs.json"
    entries = []
    with _damaged(path):
        content = json.loads(read_regular_text(path, "utf-8-sig"))
        for number, values in enumerate(content["pairs"]):
            entries.append(_entry(values, f"{path}: pairs[{number}]"))
        offset_px = ORIGIN_PX[content.get("pixel_origin", "center")]
    if not entries:
        raise AffrectError("has no pairs", where=path)
    for name, count in Counter(entry.name for entry in entries).items():
        if count > 1:
            raise AffrectError(
                f"two pairs are called '{name}'", where=path, advice="give them names"
            )
    return _load(entries, folder, offset_px)


PROTOCOLS = {"evd": load_evd, "svp": load_svp, "imc": load_imc, "pairs": load_pairs}


def _entry(values: Any, where: str) -> _Entry:
    """Read a pair of ``pairs.json``; AffrectError, which begins with ``where``."""
    try:
        entry = _Entry.from_mapping(values, where)
    except OptionError as error:
        raise AffrectError(str(error)) from error
    if leads_outside(entry.image1) or leads_outside(entry.image2):
        raise AffrectError("images must be paths of images in the folder", where=where)
    if (entry.homography, entry.correspondences, entry.relative_pose).count(None) != 2:
        raise AffrectError(
            "needs homography, correspondences or relative_pose, and one", where=where
        )
    return entry.changed(
        name=entry.name or f"{stem(entry.image1)} {stem(entry.image2)}"
    )


def _load(entries: Sequence[_Entry], folder: Path, offset_px: float) -> Pairs:
    """Return pairs with their truth; ``offset_px`` is added to coordinates for pixel centres."""

    def pair(entry: _Entry) -> EvaluationPair:
        return EvaluationPair(
            name=entry.name,
            images=(entry.image1, entry.image2),
            paths=(folder / entry.image1, folder / entry.image2),
            truth=_truth(entry, folder, offset_px),
            category=entry.category,
        )

    return list(map_ordered(pair, entries, available_cores()))


def _truth(entry: _Entry, folder: Path, offset_px: float) -> Truth:
    """Return the truth that an entry has."""
    if entry.homography is not None:
        what = f"{entry.name}: homography"
        numbers = _numbers(entry.homography, folder)
        center = np.array(
            [[1.0, 0.0, offset_px], [0.0, 1.0, offset_px], [0.0, 0.0, 1.0]]
        )
        matrix = center @ finite_numbers(numbers, (3, 3), what) @ np.linalg.inv(center)
        return TrueHomography.from_files(
            matrix, [folder / entry.image1, folder / entry.image2], what
        )
    if entry.correspondences is not None:
        numbers = _numbers(entry.correspondences, folder)
        points = finite_numbers(numbers, (-1, 4), f"{entry.name}: correspondences")
        return Correspondences(points + offset_px)
    return _true_pose(entry, offset_px)


def _numbers(given: Any, folder: Path) -> Any:
    """Return what is given, or what is in the file that it names."""
    if not isinstance(given, str):
        return given
    if leads_outside(given):
        raise AffrectError("must be a file in the folder of the pairs", where=given)
    with _damaged(folder / given):
        return np.loadtxt(folder / given, ndmin=2)


def _true_pose(entry: _Entry, offset_px: float) -> TruePose:
    """Return the truth of an entry that has a relative pose."""
    given = entry.relative_pose
    shapes = {
        "rotation": (3, 3),
        "translation": (3,),
        "intrinsics1": (3, 3),
        "intrinsics2": (3, 3),
    }
    if not isinstance(given, Mapping) or given.keys() != shapes.keys():
        raise AffrectError(f"relative_pose needs {', '.join(shapes)}", where=entry.name)
    values = {}
    for key, shape in shapes.items():
        values[key] = finite_numbers(given[key], shape, f"{entry.name}: {key}")
    cameras = []
    for key in ("intrinsics1", "intrinsics2"):
        values[key][:2, 2] = colmap_from_pixel(values[key][:2, 2] + offset_px)
        cameras.append(pinhole(values[key], f"{entry.name}: {key}"))
    return TruePose(
        (cameras[0], cameras[1]), (values["rotation"], values["translation"])
    )
