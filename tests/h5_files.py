"""Files of hloc as it writes them, and its readers, for tests."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import INTRINSICS
from synthetic import write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.errors import AffrectError
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.interop.hdf5 import InterchangeReport, import_h5

Array = NDArray[Any]
Datasets = Mapping[str, Any]

NAMES = ["a.png", "sub/b c.png", "sub/č.png", "sub_x/d.png"]
SIZE = (64, 48)
"""(width, height) of the photographs; not square, so that swapped sizes are found out."""

PINHOLE = CameraOptions(mode="single", model="PINHOLE", params=INTRINSICS)


# hloc's readers, written anew from the description of its files.


def hloc_names(path: Path) -> set[str]:
    found = set()

    def visit(_: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset):
            found.add(item.parent.name.strip("/"))

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    return found


def hloc_matches(path: Path, name0: str, name1: str) -> tuple[Array, Array]:
    first = name0.replace("/", "-")
    second = name1.replace("/", "-")
    with h5py.File(path, "r") as file:
        is_reversed = f"{first}/{second}" not in file
        group = file[f"{second}/{first}" if is_reversed else f"{first}/{second}"]
        matches = group["matches0"][()]
        scores = group["matching_scores0"][()]
    rows = np.flatnonzero(matches != -1)
    pairs = np.stack([rows, matches[rows]], axis=-1)
    return pairs[:, ::-1] if is_reversed else pairs, scores[rows]


# Files as hloc writes them.


def write_h5(path: Path, groups: Mapping[str, Datasets]) -> Path:
    with h5py.File(path, "w") as file:
        for key, datasets in groups.items():
            group = file.create_group(key) if key else file
            for name, values in datasets.items():
                group.create_dataset(name, data=values)
    return path


def points(count: int, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    return rng.uniform((0, 0), SIZE, (count, 2)).astype(np.float32)


def hloc_group(count: int, seed: int = 0, **more: Any) -> dict[str, Any]:
    return {
        "keypoints": points(count, seed),
        "descriptors": np.zeros((8, count), np.float16),
        "scores": np.ones(count, np.float32),
        "image_size": np.array(SIZE),
        **more,
    }


def match_group(matches0: list[int], dtype: type = np.int16) -> dict[str, Any]:
    return {
        "matches0": np.array(matches0, dtype),
        "matching_scores0": np.full(len(matches0), 0.5, np.float16),
    }


def write_photos(folder: Path, names: list[str], size: tuple[int, int] = SIZE) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(folder / name, np.full(size[::-1], 90, np.uint8))
    return folder


class Files:
    """Photographs, files of features and matches, and the database to be made from them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.photos = write_photos(folder / "photos", NAMES)
        self.features = folder / "features.h5"
        self.matches = folder / "matches.h5"
        self.database = folder / "new.db"
        write_h5(
            self.features, {name: hloc_group(3 + n, n) for n, name in enumerate(NAMES)}
        )
        write_h5(self.matches, {"a.png/sub-b c.png": match_group([2, -1, 0])})

    def import_all(self, **options: Any) -> InterchangeReport:
        options = {"skip_verification": True, **options}
        return import_h5(
            self.photos, self.features, self.matches, self.database, **options
        )

    def keypoints(self, name: str) -> Array:
        return read_database(self.database)[0][name]

    def pairs(self) -> dict[tuple[str, str], list[list[int]]]:
        return read_database(self.database)[1]


def read_database(
    path: Path,
) -> tuple[dict[str, Array], dict[tuple[str, str], list[list[int]]]]:
    """Keypoints by image, and matches by pair of sorted names."""
    with pycolmap.Database.open(path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        keypoints = {
            name: database.read_keypoints(image_id) for name, image_id in ids.items()
        }
        pairs = {
            pair: database.read_matches(*(ids[name] for name in pair)).tolist()
            for pair in itertools.combinations(sorted(ids), 2)
            if database.exists_matches(*(ids[name] for name in pair))
        }
    return keypoints, pairs


def one_line(error: pytest.ExceptionInfo[AffrectError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def make_database(
    path: Path, keypoints: Mapping[str, Array], matches: Mapping[tuple[str, str], Any]
) -> pycolmap.Database:
    """Make a database of images of 64 x 48 px; it is left open."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 70.0, *SIZE)
    camera_id = database.write_camera(camera)
    ids = {}
    for name, columns in keypoints.items():
        ids[name] = database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        database.write_keypoints(ids[name], np.asarray(columns, np.float32))
    for (first, second), indices in matches.items():
        database.write_matches(ids[first], ids[second], np.asarray(indices, np.uint32))
    return database
