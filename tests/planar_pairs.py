"""Small planar pairs with known homographies, in the layouts of the protocols."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from synthetic import Array, texture, write_image

SIZE = (160, 120)
TILT = 3
FINEST_PX = 1.6
TRUTH = np.array([[0.86, 0.12, 14.0], [-0.09, 0.95, 22.0], [4e-4, -2e-4, 1.0]])
"""image2_from_image1 of pixel-centre px: asymmetric, mild enough for plain features."""


def write_pair(path1: Path, path2: Path, seed: int, truth: Array = TRUTH) -> None:
    """Write a texture, seen so obliquely that it is rectified, and its image by a homography."""
    for path in (path1, path2):
        path.parent.mkdir(parents=True, exist_ok=True)
    frontal = texture((SIZE[0], TILT * SIZE[1]), seed, FINEST_PX)
    image = cv2.resize(frontal, SIZE, interpolation=cv2.INTER_AREA)
    write_image(path1, image)
    warped = cv2.warpPerspective(image, truth, SIZE, flags=cv2.INTER_CUBIC, borderValue=128)
    write_image(path2, warped)


def write_extreme_views(folder: Path, names: list[str]) -> Path:
    """Write a dataset in the layout of EVD."""
    (folder / "h").mkdir(parents=True)
    for seed, name in enumerate(names):
        write_pair(folder / "1" / f"{name}.png", folder / "2" / f"{name}.png", seed)
        np.savetxt(folder / "h" / f"{name}.txt", TRUTH)
    return folder
