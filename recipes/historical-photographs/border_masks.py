"""Write masks that leave out the borders and captions of scanned photographs.

    python border_masks.py photos masks --border 0.03 --caption 0.08

``masks/a/b.jpg.png`` is the mask of ``photos/a/b.jpg``: black within a share of the shorter side
from every edge, and in a strip at the bottom. Paint over single masks where a scan needs more:
black is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.images.photographs import list_images
from colmap_affrect.images.reading import read_gray


def border_mask(width: int, height: int, border: float, caption: float) -> np.ndarray:
    """Return an (H, W) uint8 mask, 255 inside the borders and above the caption."""
    edge = round(border * min(width, height))
    bottom = max(edge, round(caption * height))
    mask = np.zeros((height, width), np.uint8)
    mask[edge : height - bottom, edge : width - edge] = 255
    return mask


def main() -> None:
    """Write a mask for every photograph below a folder."""
    parser = argparse.ArgumentParser(
        description="Masks without borders and captions of scans."
    )
    parser.add_argument("image_path", type=Path, help="folder of the photographs")
    parser.add_argument("mask_path", type=Path, help="folder for the masks")
    parser.add_argument(
        "--border", type=float, default=0.03, help="share of the shorter side"
    )
    parser.add_argument(
        "--caption", type=float, default=0.0, help="share of the height, at the foot"
    )
    options = parser.parse_args()
    for name in list_images(options.image_path):
        height, width = read_gray(options.image_path / name).shape
        path = options.mask_path / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        mask = border_mask(width, height, options.border, options.caption)
        path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())


if __name__ == "__main__":
    main()
