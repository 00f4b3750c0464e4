"""Draw docs/picture.jpg from a finished comparison of the sample scene.

colmap-affrect compare --image-path sample_scenes/courtyard/images \
        --output-path out/compare --methods sift-colmap,sift,default --seeds 0
python docs/picture.py out/compare
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot as plt

from colmap_affrect.colmap import pycolmap

ROOT = Path(__file__).parents[1]
FOUND, LOST = "#2a9d4b", "#e8710a"


def main() -> None:
    models = {
        name: pycolmap.Reconstruction(
            Path(sys.argv[1], "methods", name, "seed-0", "sparse", "0")
        )
        for name in ("sift-colmap", "default")
    }
    names = {
        key: {image.name for image in model.images.values()}
        for key, model in models.items()
    }
    photographs = sorted((ROOT / "sample_scenes/courtyard/images").glob("*.jpg"))
    figure = plt.figure(figsize=(10, 5.2), dpi=110)
    figure.subplots_adjust(0.01, 0.0, 0.99, 0.94, wspace=0.06, hspace=0.25)
    grid = figure.add_gridspec(3, len(photographs), height_ratios=[1, 1, 4.2])
    for row, (key, title) in enumerate(
        {"sift-colmap": "COLMAP, SIFT", "default": "colmap-affrect"}.items()
    ):
        for column, path in enumerate(photographs):
            axes = figure.add_subplot(grid[row, column], xticks=[], yticks=[])
            axes.imshow(
                plt.imread(path), alpha=1.0 if path.name in names[key] else 0.45
            )
            color = FOUND if path.name in names[key] else LOST
            plt.setp(axes.spines.values(), color=color, linewidth=3)
            if not column:
                text = f"{title}: {len(names[key])} of {len(photographs)} photographs registered"
                axes.set_title(text, loc="left", fontsize=11)
    draw_model(figure.add_subplot(grid[2, :]), models["default"], names["sift-colmap"])
    figure.savefig(ROOT / "docs/picture.jpg", pil_kwargs={"quality": 85})


def draw_model(
    axes: plt.Axes, model: pycolmap.Reconstruction, by_sift: set[str]
) -> None:
    """Draw points and cameras, seen from behind the photographers and above."""
    images = list(model.images.values())
    down = np.mean(
        [image.cam_from_world().rotation.matrix()[1] for image in images], axis=0
    )
    ahead = np.mean(
        [image.cam_from_world().rotation.matrix()[2] for image in images], axis=0
    )
    down /= np.linalg.norm(down)
    ahead -= (ahead @ down) * down
    ahead /= np.linalg.norm(ahead)
    plane = np.stack([np.cross(down, ahead), 0.8 * ahead - 0.6 * down])
    points = sorted(model.points3D.values(), key=lambda point: point.xyz @ -ahead)
    places = np.array([point.xyz for point in points]) @ plane.T
    colors = np.array([point.color for point in points]) / 255
    axes.scatter(*places.T, s=2.5, c=colors, linewidths=0)
    depth = np.median([np.linalg.norm(image.projection_center()) for image in images])
    for image in images:
        rotation, center = (
            image.cam_from_world().rotation.matrix(),
            image.projection_center(),
        )
        x, y = (
            np.array([[-1, 1, 1, -1, -1], [-0.75, -0.75, 0.75, 0.75, -0.75]])
            * 0.05
            * depth
        )
        corners = center + np.stack([x, y, np.full(5, 0.14 * depth)], axis=1) @ rotation
        lines = np.concatenate([[point, center, point] for point in corners])
        shown = np.concatenate([corners, lines]) @ plane.T
        axes.plot(
            *shown.T, color=FOUND if image.name in by_sift else "#d21f3c", linewidth=1.3
        )
    cameras = np.array([image.projection_center() for image in images]) @ plane.T
    low = np.minimum(np.percentile(places, 2, axis=0), cameras.min(axis=0))
    high = np.maximum(np.percentile(places, 98, axis=0), cameras.max(axis=0))
    margin = 0.06 * (high - low)
    axes.set(aspect="equal", xlim=(low - margin)[[0]].tolist() + (high + margin)[[0]].tolist(),
             ylim=(low - margin)[[1]].tolist() + (high + margin)[[1]].tolist())  # fmt: skip
    axes.axis("off")


if __name__ == "__main__":
    main()
