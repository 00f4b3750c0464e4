"""A comparison whose photographs, databases and models are on disk, made without running any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.comparison.results import (
    Comparison,
    MethodResult,
    PoseScores,
    SeedResult,
)
from colmap_affrect.pairs.lists import Pair
from colmap_affrect.project.image_failures import ImageFailure

NAMES = (
    "<img src=x onerror=alert(1)>.png",
    "a & b.png",
    "c.png",
    "d.png",
    "e.png",
    "f.png",
)
IMAGE_SIZE = (160, 120)


def make_comparison(folder: Path) -> Comparison:
    """Six photographs; ``sift`` registers four of them, ``default`` five, with one seed four.

    A third method failed. Ground truth says that one photograph which ``default`` registers is at a
    wrong place.
    """
    photographs = folder / "photographs"
    photographs.mkdir(parents=True)
    for number, name in enumerate(NAMES):
        upright = texture((3 * IMAGE_SIZE[0], IMAGE_SIZE[1]), number)
        slanted = cv2.resize(upright, IMAGE_SIZE, interpolation=cv2.INTER_AREA)
        write_image(photographs / name, slanted)
    truth, pair_inliers = write_scene(folder / "all.db")
    sift = _write_method(folder, "sift", truth, NAMES[:4])
    default = _write_method(folder, "default", truth, NAMES[:5])
    first = _seed(0, default, len(pair_inliers), wrong=[NAMES[4]])
    second = _seed(1, default, len(pair_inliers) - 1)
    models = tuple(sorted(NAMES[:4])), tuple(NAMES[4:])
    methods = (
        _method("sift", [_seed(number, sift, 14) for number in (0, 1)]),
        _method("broken", [], failed="weights <affnet> & more are missing"),
        _method("default", [first, replace(second, models=models, points3D=70)]),
    )
    settings = {"camera": {"mode": "auto"}}
    versions = {"pycolmap": pycolmap.__version__}
    return Comparison(
        tuple(sorted(NAMES)), str(photographs), methods, (0, 1), 15, settings, versions
    )


def write_scene(
    database_path: Path, names: Sequence[str] = NAMES
) -> tuple[pycolmap.Reconstruction, dict[Pair, int]]:
    """Write a database of all images; return their model and the inliers of all pairs."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = 1
    options.num_frames_per_rig = len(names)
    options.num_points3D = 90
    options.camera_width, options.camera_height = IMAGE_SIZE
    options.camera_model_id = pycolmap.CameraModelId.PINHOLE
    options.camera_params = [200.0, 200.0, 80.0, 60.0]
    pycolmap.set_random_seed(0)
    with open_database(database_path) as database:
        model = pycolmap.synthesize_dataset(options, database)
        for image, name in zip(database.read_all_images(), names, strict=True):
            image.name = name
            database.update_image(image)
            model.images[image.image_id].name = name
        pairs = {}
        for pair_id, count in zip(
            *database.read_two_view_geometry_num_inliers(), strict=True
        ):
            ids = pycolmap.pair_id_to_image_pair(pair_id)
            name1, name2 = sorted(model.images[image_id].name for image_id in ids)
            pairs[name1, name2] = count
    return model, pairs


def _write_method(
    folder: Path, method: str, truth: pycolmap.Reconstruction, names: Sequence[str]
) -> pycolmap.Reconstruction:
    """Write the database and the model of a method, which registers some of the images."""
    model = pycolmap.Reconstruction(truth)
    for image in list(model.images.values()):
        if image.name not in names:
            model.deregister_frame(image.frame_id)
    seed = folder / "methods" / method / "seed-0"
    (seed / "sparse" / "0").mkdir(parents=True)
    model.write(seed / "sparse" / "0")
    return model


def _seed(
    seed: int, model: pycolmap.Reconstruction, num_pairs: int, wrong: Sequence[str] = ()
) -> SeedResult:
    registered = sorted(
        model.images[image_id].name for image_id in model.reg_image_ids()
    )
    correct = tuple(name for name in registered if name not in wrong)
    name = "default" if len(registered) == 5 else "sift"
    return SeedResult(
        seed=seed,
        models=(tuple(registered),),
        model_path=f"methods/{name}/seed-0/sparse/0",
        verified_pairs=num_pairs,
        points3D=model.num_points3D(),
        mean_track_length=model.compute_mean_track_length(),
        mean_reprojection_error_px=0.21 + seed / 100,
        sure=correct,
        scores=PoseScores(correct, tuple(wrong), 0.5 + seed),
        wall_s={"verify": 0.75, "map": 3.5 + seed},
    )


BROKEN = ImageFailure("damaged", values={"reason": "not a <readable> image"})


def _method(name: str, seeds: Sequence[SeedResult], failed: str = "") -> MethodResult:
    return MethodResult(
        name,
        summary=f"summary of {name}",
        seeds=tuple(seeds),
        wall_s={"extract": 12.25, "match": 1.5},
        peak_memory_bytes=123_400_000,
        failed_images={"broken.png": BROKEN} if name == "sift" else {},
        options={"rectifier": {"name": "dense-shapes"}} if name == "default" else {},
        folder=f"methods/{name}",
        failed=failed,
    )
