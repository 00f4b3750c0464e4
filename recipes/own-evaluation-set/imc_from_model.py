"""Make an evaluation set, as the Image Matching Challenge lays them out, from a COLMAP model.

    python imc_from_model.py model photos sets/castle --points out/sparse/0

Poses and intrinsics are those of ``model``; covisibility comes from the points of ``--points``, a
model of the same photographs, if ``model`` itself has none (surveyed ground truth often has none).

The covisibility of two photographs is the share of the image that the bounding box of their common
points covers, in the one of the two where it is smaller.
"""

from __future__ import annotations

import argparse
import itertools
import shutil
from pathlib import Path, PurePosixPath

import h5py
import numpy as np
from numpy.typing import NDArray

from colmap_affrect.colmap import pycolmap

CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE")
"""The layout knows no distortion."""


def covisibility(first: pycolmap.Image, second: pycolmap.Image) -> float:
    """Return the covisibility of two photographs of one model, from 0 to 1."""
    positions = [
        {point.point3D_id: point.xy for point in image.get_observation_points2D()}
        for image in (first, second)
    ]
    common = sorted(positions[0].keys() & positions[1].keys())
    if not common:
        return 0.0
    shares = []
    for image, xy_of_point in zip((first, second), positions, strict=True):
        box = np.ptp([xy_of_point[point] for point in common], axis=0)
        shares.append(float(np.prod(box)) / (image.camera.width * image.camera.height))
    return min(shares)


def write_calibration(path: Path, image: pycolmap.Image) -> None:
    """Write K, R, T and the quaternion (w, x, y, z) of a photograph."""
    pose = image.cam_from_world()
    with h5py.File(path, "w") as file:
        file["K"] = image.camera.calibration_matrix()
        file["R"] = pose.rotation.matrix()
        file["T"] = pose.translation
        file["q"] = pose.rotation.quat[[3, 0, 1, 2]]


def write_set(
    model: pycolmap.Reconstruction,
    points_model: pycolmap.Reconstruction,
    image_path: Path,
    scene_path: Path,
) -> NDArray[np.int64]:
    """Write a scene; return how many pairs are in each cumulative list, from 0.0 on."""
    root = scene_path / "set_100"
    folders = [root / name for name in ("images", "calibration", "new-vis-pairs")]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    images, calibrations, lists = folders
    registered = sorted(
        (model.image(image_id) for image_id in model.reg_image_ids()),
        key=lambda image: image.name,
    )
    stems = {
        image.name: image.name.rsplit(".", 1)[0].replace("/", "_")
        for image in registered
    }
    if len(set(stems.values())) < len(stems):
        raise SystemExit(
            "two photographs would have the same name without folder and suffix"
        )
    for image in registered:
        if image.camera.model.name not in CAMERA_MODELS:
            raise SystemExit(
                f"{image.name}: a camera with distortion; undistort with "
                "colmap-affrect export --format undistorted"
            )
        suffix = PurePosixPath(image.name).suffix
        shutil.copyfile(
            image_path / image.name, images / f"{stems[image.name]}{suffix}"
        )
        write_calibration(calibrations / f"calibration_{stems[image.name]}.h5", image)
    seen = {image.name: image for image in points_model.images.values()}
    names = [image.name for image in registered if image.name in seen]
    pairs = {
        f"{stems[one]}-{stems[two]}": covisibility(seen[one], seen[two])
        for one, two in itertools.combinations(names, 2)
    }
    counts = []
    for limit in range(10):
        keys = [key for key, share in pairs.items() if share >= limit / 10]
        np.save(lists / f"keys-th-0.{limit}.npy", np.array(keys, dtype=str))
        counts.append(len(keys))
    return np.array(counts)


def main() -> None:
    """Read the models, write the set and print how many pairs each bin has."""
    parser = argparse.ArgumentParser(
        description="An evaluation set from a COLMAP model."
    )
    parser.add_argument("model_path", type=Path, help="true poses and intrinsics")
    parser.add_argument("image_path", type=Path, help="folder of the photographs")
    parser.add_argument(
        "scene_path", type=Path, help="folder to write, named as the scene"
    )
    parser.add_argument(
        "--points", type=Path, help="model with points of the same photographs"
    )
    options = parser.parse_args()
    model = pycolmap.Reconstruction(options.model_path)
    points_model = pycolmap.Reconstruction(options.points) if options.points else model
    if not points_model.num_points3D():
        raise SystemExit(
            f"{options.points or options.model_path}: has no points; give --points"
        )
    counts = write_set(model, points_model, options.image_path, options.scene_path)
    for limit, count in enumerate(counts - np.append(counts[1:], 0)):
        print(f"covisibility 0.{limit}: {count} pairs")


if __name__ == "__main__":
    main()
