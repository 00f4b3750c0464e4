"""Fit how sure a model is of its photographs, and show how far that holds on other scenes.

Makes sets of photographs from the scenes (plain, aged, and spoilt on purpose), runs
``colmap-affrect run`` on each once, and maps many small parts of their verified pairs: with unknown
cameras, with the true ones and with a wrong focal length. Each registered photograph is a row: the
numbers that the mapper knows of it, and whether ground truth says that it is right. A logistic
regression is fitted to them with one scene after the other left out, and at last to all. Usage:

    python tests/benchmarks/reliability.py --scenes-path ../shared/scenes --work-path out/sets \
        --diagram-path out/reliability.png

The coefficients go to the file that the package reads. What is found in --work-path is used again:
after a change of the mapper remove its files ``*.jsonl``, after one of the features all of it.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord, read_camera_records
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.poses import model_poses, pose_errors, read_poses, relative_pose
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.reliability import measure


def mirrored(paths: Sequence[Path], out: Path, _: Sequence[Path]) -> None:
    """Add mirrored copies of every third photograph."""
    for number, path in enumerate(paths):
        shutil.copy(path, out)
        if number % 3 == 0:
            cv2.imwrite(str(out / f"mirrored-{path.name}"), cv2.imread(str(path))[:, ::-1])


def cropped(paths: Sequence[Path], out: Path, _: Sequence[Path]) -> None:
    """Replace every second photograph by an enlarged corner of it."""
    for number, path in enumerate(paths):
        image = cv2.imread(str(path))
        height, width = image.shape[:2]
        if number % 2:
            corner = image[: int(0.65 * height), int(0.35 * width) :]
            image = cv2.resize(corner, (width, height), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / path.name), image)


def turned(paths: Sequence[Path], out: Path, _: Sequence[Path]) -> None:
    """Turn a camera: views of one photograph from one place."""
    image = cv2.imread(str(paths[0]))
    height, width = image.shape[:2]
    focal = 1.2 * width
    inner = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    for number, path in enumerate(paths):
        yaw, pitch = np.deg2rad([4.0 * number - 2.0 * len(paths), 5.0 * (number % 3 - 1)])
        rotation, _ = cv2.Rodrigues(np.array([pitch, yaw, 0.02 * number]))
        warp = inner @ rotation @ np.linalg.inv(inner)
        cv2.imwrite(
            str(out / f"turned-{path.name}"), cv2.warpPerspective(image, warp, (width, height))
        )


def mixed(paths: Sequence[Path], out: Path, others: Sequence[Path]) -> None:
    """Put photographs of two scenes into one folder."""
    for prefix, group in (("", paths), ("other-", others)):
        for path in group:
            shutil.copy(path, out / f"{prefix}{path.name}")


SPOILS: Mapping[str, Callable[[Sequence[Path], Path, Sequence[Path]], None]] = {
    spoil.__name__: spoil for spoil in (mirrored, cropped, turned, mixed)
}


@dataclass(frozen=True)
class Set:
    """Some photographs of a scene, and what is done to them."""

    scene: str
    step: int = 1
    first: int = 0
    spoil: str = ""  # a key of SPOILS, or "aged"
    other: str = ""  # scene that is mixed in
    recipe: str = "default"


FOUNTAIN, HERZ, TEMPLE = "strecha_fountain_p11", "strecha_herz_jesus_p25", "temple_sparse_ring"
SETS = {
    "fountain": Set(FOUNTAIN),
    "herz": Set(HERZ, 2),
    "temple": Set(TEMPLE),
    "saharov": Set("saharov32", 2),
    "sceaux": Set("sceaux"),
    "kermit": Set("kermit"),
    "kitchen": Set("kitchen"),
    "dunes": Set("copr_kap", 2),
    "et": Set("et"),
    "sacre_coeur": Set("sacre_coeur"),
    "sceaux-mirrored": Set("sceaux", 2, spoil="mirrored"),
    "herz-cropped": Set(HERZ, 3, spoil="cropped"),
    "kermit-cropped": Set("kermit", spoil="cropped"),
    "toys-mixed": Set("et", 2, spoil="mixed", other="kermit"),
    "facades-mixed": Set(FOUNTAIN, 2, spoil="mixed", other="sacre_coeur"),
    "herz-turned": Set(HERZ, 4, spoil="turned"),
    "kitchen-turned": Set("kitchen", 2, 1, spoil="turned"),
    "herz-aged": Set(HERZ, 3, spoil="aged"),
    "sceaux-aged": Set("sceaux", spoil="aged"),
    "temple-aged": Set(TEMPLE, 2, spoil="aged"),
    "saharov-aged": Set("saharov32", 3, spoil="aged"),
    "fountain-aged": Set(FOUNTAIN, 2, spoil="aged"),
    "kitchen-mirrored": Set("kitchen", 2, spoil="mirrored"),
    "temple-learned": Set(TEMPLE, 2, recipe="on-demand-learned"),
    "saharov-learned": Set("saharov32", 5, 1, recipe="on-demand-learned"),
    "herz-learned": Set(HERZ, 8, recipe="on-demand-learned"),
    "fountain-learned": Set(FOUNTAIN, 5, recipe="on-demand-learned"),
    "kitchen-learned": Set("kitchen", 2, recipe="on-demand-learned"),
    "dunes-learned": Set("copr_kap", 2, recipe="on-demand-learned"),
    "sacre_coeur-learned": Set("sacre_coeur", 2, recipe="on-demand-learned"),
    "kermit-learned": Set("kermit", 2, recipe="on-demand-learned"),
}


def make(name: str, scenes_path: Path, work_path: Path) -> Path:
    """Return the output folder of a run on a set, which is made if it is not there."""
    some, out = SETS[name], work_path / name
    if (out / "report.json").exists():
        return out
    paths = sorted((scenes_path / some.scene / "images").iterdir())[some.first :: some.step]
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        images.mkdir()
        if some.spoil in SPOILS:
            others = sorted((scenes_path / some.other / "images").iterdir()) if some.other else []
            SPOILS[some.spoil](paths, images, others[::2])
        else:
            for path in paths:
                shutil.copy(path, images)
        if some.spoil == "aged":
            plain, images = images, Path(folder) / "aged"
            tool = scenes_path.parent / "tools" / "age.py"
            subprocess.run([sys.executable, tool, plain, images], check=True)
        command = ["run", "--quiet", "--image-path", images, "--output-path", out]
        options = [*command, "--recipe", some.recipe, "--device", "cpu"]
        program = [sys.executable, "-m", "colmap_affrect"]
        ended = subprocess.run([*program, *map(str, options)], check=False)
        if not (out / "report.json").exists():
            raise SystemExit(f"{name}: exit code {ended.returncode}")
    return out


CAMERAS = ("unknown", "known", "wrong")  # focal lengths: nothing is said, true ones, a wrong one
WRONG_FACTORS = (0.7, 0.8, 1.25, 1.45)
SIZES = (3, 4, 5, 6, 8, 10)  # photographs of a part
MAX_CORRECT_ERROR_DEG = 5.0


def truth_of(
    name: str, scenes_path: Path, images: Sequence[str]
) -> dict[str, tuple[str, Any] | None]:
    """Return scene and pose of each image, None where it has no place; others are not known."""
    some = SETS[name]
    found: dict[str, tuple[str, Any] | None] = {}
    for prefix, scene in (("", some.scene), ("other-", some.other)):
        for folder in ("ground_truth", "pseudo_ground_truth"):
            if scene and (scenes_path / scene / folder).exists():
                poses = read_poses(scenes_path / scene / folder)
                found |= {prefix + image: (scene, pose) for image, pose in poses.items()}
    copies = ("mirrored-", "turned-")
    return {i: found.get(i) for i in images if i in found or i.startswith(copies)}


def correct_images(poses: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, bool]:
    """Tell of each image whether its relative poses to at least half of the others are right."""
    names = sorted(poses.keys() & truth.keys())
    num_right = dict.fromkeys(names, 0)
    for one, two in itertools.combinations(names, 2):
        first, second = truth[one], truth[two]
        if first and second and first[0] == second[0]:
            relative = relative_pose(poses[one], poses[two])
            errors = pose_errors(relative, relative_pose(first[1], second[1]))
            right = max(errors) <= MAX_CORRECT_ERROR_DEG
            num_right[one] += right
            num_right[two] += right
    return {name: 2 * count >= len(names) - 1 for name, count in num_right.items()}


def parts_of(
    images: Sequence[str], kind: str, number: int, rng: np.random.Generator
) -> list[list[str]]:
    """Draw parts of a set, all of it first; small ones only where no model will be certain."""
    parts = [] if kind == "wrong" else [list(images)]
    while len(parts) < number:
        size = min(int(rng.choice(SIZES[:4] if kind == "wrong" else SIZES)), len(images))
        parts.append(sorted(rng.choice(images, size, replace=False).tolist()))
    return parts


def cameras_of(
    kind: str,
    records: Mapping[int, CameraRecord],
    truth: Mapping[str, Any],
    rng: np.random.Generator,
) -> tuple[dict[int, CameraRecord], dict[int, Any]] | None:
    """Return records and cameras of a part with known or with wrong focal lengths."""
    factor = float(rng.choice(WRONG_FACTORS)) if kind == "wrong" else 1.0
    changed, cameras = {}, {}
    for key, record in records.items():
        if kind == "unknown":
            changed[key] = replace(record, source="guess", given=())
            continue
        given = truth.get(record.names[0])
        if given is None:
            return None
        camera = copy.copy(given)
        camera.camera_id = key
        for index in camera.focal_length_idxs():
            camera.params[index] *= factor
        focal_px = float(camera.mean_focal_length())
        parts: tuple[Any, ...] = ("focal", "principal-point", "distortion")
        changed[key] = replace(record, source="given", focal_px=focal_px, given=parts)
        cameras[key] = camera
    return changed, cameras


def observe(name: str, scenes_path: Path, work_path: Path, num_parts: int) -> list[dict[str, Any]]:
    """Map parts of a set; return a row for each photograph whose place is known or is none."""
    pycolmap.logging.minloglevel = 3
    out = make(name, scenes_path, work_path)
    rows, rng = [], np.random.default_rng(zlib.crc32(name.encode()))
    records = read_camera_records(out / "cameras.json")
    with open_database(out / "database.db") as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
    truth = truth_of(name, scenes_path, list(images))
    true_cameras = calibration(SETS[name], scenes_path)
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "small.db"
        shutil.copy(out / "database.db", small)
        connection = sqlite3.connect(small)
        connection.executescript("DELETE FROM descriptors; DELETE FROM matches; VACUUM;")
        connection.close()
        for kind in CAMERAS:
            if kind != "unknown" and not true_cameras:
                continue
            for number, part in enumerate(parts_of(sorted(images), kind, num_parts, rng)):
                told = cameras_of(kind, records, true_cameras, rng)
                if told is None:
                    break
                path = Path(folder) / "part.db"
                write_part(small, path, {images[i] for i in part}, told[1])
                task = MappingTask(path, None, cameras=told[0], may_share=kind == "unknown")
                start = time.perf_counter()
                models = MAPPERS.make(MAPPERS.options("sparse")).map(
                    task, Path(folder), number, len_
                )
                seconds = time.perf_counter() - start
                if not models:
                    continue
                best = max(models, key=lambda m: m.reconstruction.num_reg_images())
                right = correct_images(model_poses(best.reconstruction), truth)
                rows += [
                    {"set": name, "scene": SETS[name].scene, "cameras": kind, "part": number,
                     "size": len(part), "image": image, "right": right[image], "seconds": seconds,
                     **asdict(measures)}
                    for image, measures in measure(best, task).items()
                    if image in right and len(right) > 1
                ]  # fmt: skip
    return rows


def len_(_: int) -> None:
    """Tell nobody how far mapping is."""


def write_part(source: Path, path: Path, images: set[int], cameras: Mapping[int, Any]) -> None:
    """Copy a database with the verified pairs of some images only, and other cameras."""
    shutil.copy(source, path)
    with open_database(path) as database:
        for pair_id in database.read_two_view_geometries()[0]:
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            if not images.issuperset(ids):
                database.delete_two_view_geometry(*ids)
        for camera in cameras.values():
            database.update_camera(camera)


def calibration(some: Set, scenes_path: Path) -> dict[str, Any]:
    """Return the true camera of each photograph, of scenes that have one and whole images."""
    path = scenes_path / some.scene / "ground_truth"
    if not path.exists() or some.spoil not in ("", "aged"):
        return {}
    model = pycolmap.Reconstruction(path)
    return {image.name: model.cameras[image.camera_id] for image in model.images.values()}
