"""Photographs with true poses, and pairs with homographies, laid out as datasets are."""

from __future__ import annotations

from pathlib import Path

import cv2
import h5py
import numpy as np
from numpy.typing import NDArray
from small_scene import FOCAL_PX, IMAGE_SIZE, photograph, world_to_camera
from synthetic import texture, write_image

from colmap_affrect.colmap import pycolmap

POSITIONS = ((-0.8, 0.0, 0.0), (-0.3, -0.1, 0.2), (0.2, -0.2, 0.3), (0.9, 0.1, 0.1))
YAWS_DEG = (9.0, 4.0, -1.0, -12.0)
NAMES = ("a", "b", "c", "d")

Pose = tuple[NDArray[np.float64], NDArray[np.float64]]


def pose(index: int) -> Pose:
    """Return camera_from_world of a photograph."""
    rotation = world_to_camera(YAWS_DEG[index])
    return rotation, -rotation @ np.array(POSITIONS[index])


def write_images(folder: Path) -> None:
    """Write the photographs as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, position, yaw_deg in zip(NAMES, POSITIONS, YAWS_DEG, strict=True):
        write_image(folder / f"{name}.png", photograph(position, yaw_deg))


def image_line(index: int) -> str:
    """Return the line of a photograph in COLMAP's images.txt."""
    rotation, translation = pose(index)
    x, y, z, w = pycolmap.Rotation3d(rotation).quat
    values = " ".join(map(repr, map(float, (w, x, y, z, *translation))))
    return f"{index + 1} {values} {index + 1} {NAMES[index]}.png"


def write_svp(
    scene: Path, pairs: str = "a.png b.png 0\na.png d.png 2\nb.png d.png 1\n"
) -> Path:
    """Write a scene of the Strong ViewPoint Changes dataset, without lines of points."""
    write_images(scene / "images")
    (scene / f"{scene.name}_image_pairs.txt").write_text(pairs)
    (scene / "0").mkdir()
    width, height = IMAGE_SIZE
    camera = f"SIMPLE_RADIAL {width} {height} {FOCAL_PX} {width / 2} {height / 2} 0"
    cameras = [f"{index + 1} {camera}" for index in range(len(NAMES))]
    images = [image_line(index) for index in range(len(NAMES))]
    for name, lines in (("cameras", cameras), ("images", images)):
        (scene / "0" / f"{name}.txt").write_text("\n".join([f"# {name}", *lines, ""]))
    return scene


def write_calibration(scene: Path, index: int, **changes: object) -> None:
    """Write the calibration file of a photograph, some values changed; None leaves one out."""
    rotation, translation = pose(index)
    width, height = IMAGE_SIZE
    values: dict[str, object] = {
        "K": np.array([[FOCAL_PX, 0, width / 2], [0, FOCAL_PX, height / 2], [0, 0, 1]]),
        "R": rotation,
        "T": translation,
    }
    folder = scene / "set_100" / "calibration"
    folder.mkdir(parents=True, exist_ok=True)
    with h5py.File(folder / f"calibration_{NAMES[index]}.h5", "w") as file:
        for key, value in (values | changes).items():
            if value is not None:
                file[key] = value


def write_lists(scene: Path, lists: dict[int, list[str]]) -> None:
    """Write cumulative lists of pairs by their limits in tenths; those not given are empty."""
    folder = scene / "set_100" / "new-vis-pairs"
    folder.mkdir(parents=True, exist_ok=True)
    for limit in range(1, 10):
        np.save(
            folder / f"keys-th-0.{limit}.npy", np.array(lists.get(limit, []), dtype=str)
        )


def write_imc(scene: Path) -> Path:
    """Write a scene as the Image Matching Challenge does: one pair from 0.1, one from 0.2."""
    write_images(scene / "set_100" / "images")
    for index in range(len(NAMES)):
        write_calibration(scene, index)
    write_lists(scene, {1: ["a-d", "b-c"], 2: ["b-c"]})
    return scene


SIZE = (160, 120)
TILT = 3
FINEST_PX = 1.6
TRUTH = np.array([[0.86, 0.12, 14.0], [-0.09, 0.95, 22.0], [4e-4, -2e-4, 1.0]])
"""image2_from_image1 of pixel-centre px: asymmetric, mild enough for plain features."""


def write_pair(path1: Path, path2: Path, seed: int) -> None:
    """Write a texture, seen so obliquely that it is rectified, and its image by a homography."""
    for path in (path1, path2):
        path.parent.mkdir(parents=True, exist_ok=True)
    frontal = texture((SIZE[0], TILT * SIZE[1]), seed, FINEST_PX)
    image = cv2.resize(frontal, SIZE, interpolation=cv2.INTER_AREA)
    write_image(path1, image)
    warped = cv2.warpPerspective(
        image, TRUTH, SIZE, flags=cv2.INTER_CUBIC, borderValue=128
    )
    write_image(path2, warped)


def write_extreme_views(folder: Path, names: list[str]) -> Path:
    """Write a dataset in the layout of EVD."""
    (folder / "h").mkdir(parents=True)
    for seed, name in enumerate(names):
        write_pair(folder / "1" / f"{name}.png", folder / "2" / f"{name}.png", seed)
        np.savetxt(folder / "h" / f"{name}.txt", TRUTH)
    return folder
