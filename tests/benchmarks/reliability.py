"""Fit how sure a model is of its photographs, and show how far that holds on other scenes.

Makes sets of photographs from the scenes (plain, aged, and spoilt on purpose), runs
``colmap-affrect run`` on each once, and maps many small parts of their verified pairs: with unknown
cameras, with the true ones and with a wrong focal length. Each registered photograph is a row: the
numbers that the mapper knows of it, and whether ground truth says that it is right. A logistic
regression is fitted to them with one scene after the other left out, and at last to all. Usage:

    python tests/benchmarks/reliability.py --scenes-path ../shared/scenes --work-path out/sets \
        --diagram-path out/reliability.png

The coefficients go to the file that the package reads. What is found in --work-path is used again:
after a change of the mapper or of a term remove its files ``*.jsonl``, after one of the features
all of it.
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
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import CameraRecord, read_camera_records
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.model_files import (
    model_poses,
    pose_errors,
    read_poses,
    relative_pose,
)
from colmap_affrect.comparison import results
from colmap_affrect.mappers.base import MAPPERS, MappedModel, MappingTask
from colmap_affrect.mappers.reliability import COEFFICIENTS, TERMS, unfitted_factor
from colmap_affrect.mappers.reliability_features import features_of
from colmap_affrect.project.report import DOUBTFUL, SURE
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context
from colmap_affrect.stages.map import unmeasured_pairs


def mirrored(paths: Sequence[Path], out: Path, _: Sequence[Path]) -> None:
    """Add mirrored copies of every third photograph."""
    for number, path in enumerate(paths):
        shutil.copy(path, out)
        if number % 3 == 0:
            cv2.imwrite(
                str(out / f"mirrored-{path.name}"), cv2.imread(str(path))[:, ::-1]
            )


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
        yaw, pitch = np.deg2rad(
            [4.0 * number - 2.0 * len(paths), 5.0 * (number % 3 - 1)]
        )
        rotation, _ = cv2.Rodrigues(np.array([pitch, yaw, 0.02 * number]))
        warp = inner @ rotation @ np.linalg.inv(inner)
        view = cv2.warpPerspective(image, warp, (width, height))
        inner_part = view[height // 8 : -height // 8, width // 8 : -width // 8]
        cv2.imwrite(str(out / f"turned-{path.name}"), inner_part)


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
    recipe: str = "rectified"


FOUNTAIN = "strecha_fountain_p11"
HERZ = "strecha_herz_jesus_p25"
TEMPLE = "temple_sparse_ring"
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
    "temple-learned": Set(TEMPLE, 2, recipe="default"),
    "saharov-learned": Set("saharov32", 5, 1, recipe="default"),
    "herz-learned": Set(HERZ, 8, recipe="default"),
    "fountain-learned": Set(FOUNTAIN, 5, recipe="default"),
    "kitchen-learned": Set("kitchen", 2, recipe="default"),
    "dunes-learned": Set("copr_kap", 2, recipe="default"),
    "sacre_coeur-learned": Set("sacre_coeur", 2, recipe="default"),
    "kermit-learned": Set("kermit", 2, recipe="default"),
}


def make(name: str, scenes_path: Path, work_path: Path) -> Path:
    """Return the output folder of a run on a set, which is made if it is not there."""
    some = SETS[name]
    out = work_path / name
    if (out / "report.json").exists():
        return out
    paths = sorted((scenes_path / some.scene / "images").iterdir())[
        some.first :: some.step
    ]
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "images"
        images.mkdir()
        if some.spoil in SPOILS:
            others = (
                sorted((scenes_path / some.other / "images").iterdir())
                if some.other
                else []
            )
            SPOILS[some.spoil](paths, images, others[::2])
        else:
            for path in paths:
                shutil.copy(path, images)
        if some.spoil == "aged":
            plain = images
            images = Path(folder) / "aged"
            tool = scenes_path.parent / "tools" / "age.py"
            subprocess.run([sys.executable, tool, plain, images], check=True)
        command = ["run", "--quiet", "--image-path", images, "--output-path", out]
        options = [*command, "--recipe", some.recipe, "--device", "cpu"]
        program = [sys.executable, "-m", "colmap_affrect"]
        ended = subprocess.run([*program, *map(str, options)], check=False)
        if not (out / "report.json").exists():
            raise SystemExit(f"{name}: exit code {ended.returncode}")
    return out


CAMERAS = (
    "unknown",
    "known",
    "wrong",
)  # focal lengths: nothing is said, true ones, a wrong one
WRONG_FACTORS = (0.7, 0.8, 1.25, 1.45)
SIZES = (3, 4, 5, 6, 8, 10)  # photographs of a part
MAX_ITERATIONS = 80
MAX_STEP = 1.0  # of a weight, which would else jump to where nothing is likely
MIN_CHANCE = 1e-9  # chances are divided by


def truth_of(
    name: str, scenes_path: Path, images: Sequence[str]
) -> dict[str, tuple[str, Any] | None]:
    """Return scene and pose of each image, None where it has no place; others are not known.

    Aged photographs have other extensions.
    """
    some = SETS[name]
    found: dict[str, tuple[str, Any] | None] = {}
    for prefix, scene in (("", some.scene), ("other-", some.other)):
        for folder in ("ground_truth", "pseudo_ground_truth"):
            if scene and (scenes_path / scene / folder).exists():
                poses = read_poses(scenes_path / scene / folder)
                found |= {
                    prefix + Path(i).stem: (scene, pose) for i, pose in poses.items()
                }
    copies = ("mirrored-", "turned-")
    known = {i: found.get(Path(i).stem) for i in images}
    return {i: place for i, place in known.items() if place or i.startswith(copies)}


def correct_images(
    poses: Mapping[str, Any], truth: Mapping[str, Any]
) -> dict[str, bool]:
    """Tell of each image whether it is registered correctly; those without a place are not."""
    names = sorted(poses.keys() & truth.keys())
    errors = {}
    for one, two in itertools.combinations(names, 2):
        first = truth[one]
        second = truth[two]
        errors[one, two] = (180.0, 180.0)
        if first and second and first[0] == second[0]:
            relative = relative_pose(poses[one], poses[two])
            errors[one, two] = pose_errors(relative, relative_pose(first[1], second[1]))
    right = results.correct_images(errors)
    return {name: name in right for name in names}


def parts_of(
    images: Sequence[str], kind: str, number: int, rng: np.random.Generator
) -> list[list[str]]:
    """Draw parts of a set, all of it first; small ones only where no model will be certain."""
    parts = [] if kind == "wrong" else [list(images)]
    while len(parts) < number:
        size = min(
            int(rng.choice(SIZES[:4] if kind == "wrong" else SIZES)), len(images)
        )
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
    changed = {}
    cameras = {}
    for key, record in records.items():
        if kind == "unknown":
            changed[key] = replace(record, source="guess", given=())
            continue
        given = truth.get(Path(record.names[0]).stem)
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


def observe(
    name: str, scenes_path: Path, work_path: Path, num_parts: int
) -> list[dict[str, Any]]:
    """Map parts of a set; return a row for each photograph whose place is known or is none."""
    pycolmap.logging.minloglevel = 3
    out = make(name, scenes_path, work_path)
    rows = []
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    records = read_camera_records(out / "cameras.json")
    with open_database(out / "database.db") as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
    truth = truth_of(name, scenes_path, list(images))
    true_cameras = calibration(SETS[name], scenes_path)
    unmeasured = unmeasured_pairs(Context(Workspace(out)))
    with tempfile.TemporaryDirectory() as folder:
        small = Path(folder) / "small.db"
        shutil.copy(out / "database.db", small)
        connection = sqlite3.connect(small)
        connection.executescript(
            "DELETE FROM descriptors; DELETE FROM matches; VACUUM;"
        )
        connection.close()
        for kind in CAMERAS:  # and "misplaced": one photograph of a model is moved
            if kind != "unknown" and not true_cameras:
                continue
            num = (
                num_parts // 2 if kind == "wrong" else num_parts
            )  # most given ones fit
            for number, part in enumerate(parts_of(sorted(images), kind, num, rng)):
                told = cameras_of(kind, records, true_cameras, rng)
                if told is None:
                    break
                path = Path(folder) / "part.db"
                write_part(small, path, {images[i] for i in part}, told[1])
                task = MappingTask(
                    path,
                    None,
                    unmeasured_pairs=frozenset(
                        pair for pair in unmeasured if {*part} >= {*pair}
                    ),
                    cameras=told[0],
                    may_share=kind == "unknown",
                )
                mapper = MAPPERS.make(MAPPERS.options("sparse"))
                models = mapper.map(task, Path(folder), number, lambda _: None)
                if not models:
                    continue
                best = max(models, key=lambda m: m.reconstruction.num_reg_images())
                about = {
                    "set": name,
                    "scene": SETS[name].scene,
                    "cameras": kind,
                    "part": number,
                }
                rows += [{**about, **row} for row in rows_of(best, task, truth)]
                if kind == "unknown" and number % 2 == 0:
                    misplaced = misplace(best.reconstruction, rng)
                    about["cameras"] = "misplaced"
                    found = rows_of(best, task, truth)
                    rows += [
                        {**about, **row} for row in found if row["image"] == misplaced
                    ]
    return rows


def rows_of(
    mapped: MappedModel, task: MappingTask, truth: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the terms of each photograph whose place is known, and whether it is right."""
    right = correct_images(model_poses(mapped.reconstruction), truth)
    if len(right) < 2:
        return []
    return [
        {
            "image": image,
            "right": right[image],
            "terms": {key: term.value(features) for key, term in TERMS.items()},
            "factor": unfitted_factor(features),
        }
        for image, features in features_of(mapped, task).items()
        if image in right
    ]


def misplace(model: pycolmap.Reconstruction, rng: np.random.Generator) -> str:
    """Move a photograph around what it sees, by 20 to 90 degrees; return its name.

    It is empty where no photograph sees a point.
    """
    seeing = []
    for image_id in sorted(model.reg_image_ids()):
        if model.images[image_id].get_observation_points2D():
            seeing.append(image_id)
    if not seeing:
        return ""
    image = model.images[int(rng.choice(seeing))]
    seen = [model.point3D(p.point3D_id).xyz for p in image.get_observation_points2D()]
    middle = np.median(seen, axis=0)
    axis = rng.normal(size=3)
    turn = pycolmap.Rotation3d(
        np.deg2rad(rng.uniform(20, 90)) * axis / np.linalg.norm(axis)
    )
    around = pycolmap.Rigid3d(turn, middle - turn.matrix() @ middle)
    image.frame.set_cam_from_world(image.camera_id, image.cam_from_world() * around)
    return str(image.name)


def write_part(
    source: Path, path: Path, images: set[int], cameras: Mapping[int, Any]
) -> None:
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
    """Return the true cameras, by photograph without extension, of scenes with whole images."""
    path = scenes_path / some.scene / "ground_truth"
    if not path.exists() or some.spoil not in ("", "aged"):
        return {}
    model = pycolmap.Reconstruction(path)
    return {
        Path(i.name).stem: model.cameras[i.camera_id] for i in model.images.values()
    }


def fitted(
    values: NDArray[np.float64],
    right: NDArray[np.float64],
    factors: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Fit weights of (N, T) terms, none of which is negative, and the constant.

    Maximum likelihood with a normal prior of the weights, by Fisher scoring; of terms in units of
    their deviation.

    Args:
        values: The terms of each photograph, (N, T).
        right: Whether it is right, 1 or 0, (N,).
        factors: Of its probability, by what is not fitted, (N,).

    Returns:
        The weights, (T,), and the constant.
    """
    mean = values.mean(axis=0)
    deviation = values.std(axis=0) + 1e-9
    scaled = np.column_stack([(values - mean) / deviation, np.ones(len(values))])
    kept = np.arange(scaled.shape[1])
    while True:
        part = scaled[:, kept]
        weights = np.zeros(len(kept))
        prior = np.diag([1.0] * (len(kept) - 1) + [0.0])
        for _ in range(MAX_ITERATIONS):
            fractions = 1.0 / (1.0 + np.exp(-part @ weights))
            probabilities = np.clip(factors * fractions, MIN_CHANCE, 1.0 - MIN_CHANCE)
            slopes = factors * fractions * (1.0 - fractions)
            variances = probabilities * (1.0 - probabilities)
            gradient = (
                part.T @ ((probabilities - right) * slopes / variances)
                + prior @ weights
            )
            information = (part.T * (slopes**2 / variances)) @ part + prior
            step = np.linalg.solve(information, gradient)
            weights -= step * min(1.0, MAX_STEP / np.abs(step).max())
        if (weights[:-1] >= 0.0).all():
            break
        kept = np.delete(kept, weights[:-1].argmin())
    found = np.zeros(scaled.shape[1])
    found[kept] = weights
    slopes = found[:-1] / deviation
    return slopes, float(found[-1] - slopes @ mean)


def left_out(rows: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    """Return the probability of each row by what is fitted to all other scenes."""
    values = np.array([list(row["terms"].values()) for row in rows])
    right = np.array([float(row["right"]) for row in rows])
    factors = np.array([row["factor"] for row in rows])
    scenes = np.array([row["scene"] for row in rows])
    found = np.zeros(len(rows))
    for scene in sorted(set(scenes)):
        out = scenes == scene
        slopes, constant = fitted(values[~out], right[~out], factors[~out])
        fractions = 1.0 / (1.0 + np.exp(-values[out] @ slopes - constant))
        found[out] = factors[out] * fractions
    return found


def fitted_constant(
    log_odds: NDArray[np.float64],
    right: NDArray[np.float64],
    factors: NDArray[np.float64],
) -> float:
    """Fit what is added to log odds, by maximum likelihood, to a hundredth.

    Args:
        log_odds: Of each photograph, by weights that stay, (N,).
        right: Whether it is right, 1 or 0, (N,).
        factors: Of its probability, by what is not fitted, (N,).
    """
    constants = np.linspace(-3.0, 3.0, 601)
    fractions = 1.0 / (1.0 + np.exp(-log_odds[:, None] - constants))
    chances = np.clip(factors[:, None] * fractions, MIN_CHANCE, 1.0 - MIN_CHANCE)
    is_right = right[:, None] > 0.0
    likelihoods = np.log(np.where(is_right, chances, 1.0 - chances)).sum(axis=0)
    return float(constants[likelihoods.argmax()])


def constant_left_out(rows: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    """Return the probability of each row by a constant that is fitted to all other scenes."""
    right = np.array([float(row["right"]) for row in rows])
    factors = np.array([row["factor"] for row in rows])
    fractions = as_committed(rows) / factors
    log_odds = np.log(fractions / (1.0 - fractions))
    scenes = np.array([row["scene"] for row in rows])
    found = np.zeros(len(rows))
    for scene in sorted(set(scenes)):
        out = scenes == scene
        constant = fitted_constant(log_odds[~out], right[~out], factors[~out])
        found[out] = factors[out] / (1.0 + np.exp(-log_odds[out] - constant))
        print(f"without {scene}: {constant:+.2f}")
    return found


def as_committed(rows: Sequence[Mapping[str, Any]]) -> NDArray[np.float64]:
    """Return the probability of each row by the coefficients that the package has."""
    content = json.loads(COEFFICIENTS.read_text(encoding="utf-8"))
    weights = np.array([content["terms"][name]["weight"] for name in TERMS])
    values = np.array([[row["terms"][name] for name in TERMS] for row in rows])
    factors = np.array([row["factor"] for row in rows])
    return factors / (1.0 + np.exp(-values @ weights - content["constant"]))


def scores(
    probabilities: NDArray[np.float64], right: NDArray[np.float64]
) -> dict[str, float]:
    """Return how good probabilities are."""
    sure = probabilities >= SURE
    doubtful = probabilities < DOUBTFUL
    return {
        "photographs": len(right),
        "right": float(right.mean()),
        "Brier score": float(((probabilities - right) ** 2).mean()),
        "sure ones right": float(right[sure].mean()),
        "right ones sure": float(sure[right > 0].mean()),
        "wrong ones doubtful": float(doubtful[right == 0].mean()),
        "wrong and sure": int((sure & (right == 0)).sum()),
    }


def draw(
    probabilities: NDArray[np.float64], right: NDArray[np.float64], path: Path
) -> list[tuple[str, int, float, float]]:
    """Draw the reliability diagram; return its bins: number, mean probability, share of right."""
    edges = [0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0]
    bins = []
    for low, high in itertools.pairwise(edges):
        inside = (probabilities >= low) & ((probabilities < high) | (high == 1.0))
        if inside.any():
            means = float(probabilities[inside].mean()), float(right[inside].mean())
            bins.append((f"{low:g} to {high:g}", int(inside.sum()), *means))
    figure, axes = plt.subplots(figsize=(4.5, 4.5))
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    axes.plot([b[2] for b in bins], [b[3] for b in bins], "o-", color="#1b6ca8")
    for _, number, mean, share in bins:
        axes.annotate(
            str(number), (mean, share), (6, -10), textcoords="offset points", fontsize=8
        )
    axes.set(xlabel="probability that the model states", ylabel="share that is right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    return bins


def rows_of_sets(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of all sets that are wanted; what is missing is observed."""
    rows: list[dict[str, Any]] = []
    for name in options.sets:
        path = options.work_path / f"{name}.jsonl"
        if not path.exists():
            found = observe(name, options.scenes_path, options.work_path, options.parts)
            lines = [json.dumps(row) + "\n" for row in found]
            path.write_text("".join(lines), encoding="utf-8")
        for line in path.read_text(encoding="utf-8").splitlines():
            rows.append(json.loads(line))
    return rows


def write_coefficients(rows: Sequence[Mapping[str, Any]], num_sets: int) -> None:
    """Fit all rows, and write the file that the package reads."""
    right = np.array([float(row["right"]) for row in rows])
    values = np.array([list(row["terms"].values()) for row in rows])
    factors = np.array([row["factor"] for row in rows])
    slopes, constant = fitted(values, right, factors)
    usual = values[right > 0].mean(axis=0)
    terms = {}
    for name, weight, mean in zip(TERMS, slopes, usual, strict=True):
        terms[name] = {
            "weight": round(float(weight), 4),
            "usual": round(float(mean), 4),
        }
    content = {
        "made": f"{datetime.now(UTC):%Y-%m-%d} by tests/benchmarks/reliability.py",
        "data": f"{len(rows)} photographs of {num_sets} sets",
        "constant": round(constant, 4),
        "terms": terms,
    }
    COEFFICIENTS.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def main() -> None:
    """Observe what is missing, fit, write the coefficients and print how good they are."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--scenes-path", type=Path, required=True)
    parser.add_argument("--work-path", type=Path, required=True)
    parser.add_argument("--diagram-path", type=Path, required=True)
    parser.add_argument(
        "--parts", type=int, default=8, help="of each set and kind of cameras"
    )
    parser.add_argument("--sets", nargs="+", choices=list(SETS), default=list(SETS))
    parser.add_argument(
        "--keep", action="store_true", help="the coefficients that the package has"
    )
    parser.add_argument(
        "--constant",
        action="store_true",
        help="show what the constant alone would be; no coefficients are written",
    )
    options = parser.parse_args()
    rows = rows_of_sets(options)
    right = np.array([float(row["right"]) for row in rows])
    before = scores(as_committed(rows), right)
    probabilities = constant_left_out(rows) if options.constant else left_out(rows)
    for key, score in scores(probabilities, right).items():
        print(f"| {key} | {before[key]:.4g} | {score:.4g} |")
    for title, number, mean, share in draw(probabilities, right, options.diagram_path):
        print(f"| {title} | {number} | {mean:.3f} | {share:.3f} |")
    if not (options.keep or options.constant):
        write_coefficients(rows, len(options.sets))


if __name__ == "__main__":
    main()
