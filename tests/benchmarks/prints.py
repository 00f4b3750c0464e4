"""Make photographs look as prints are: cut off centre, or of a shifted view camera.

Writes photographs without EXIF and a COLMAP text model of their cameras and poses, from a scene
with a known model. Usage:

    python tests/benchmarks/prints.py SCENE/images SCENE/ground_truth out/prints --kind crop
    colmap-affrect compare --image-path out/prints/images \
        --ground-truth-path out/prints/ground_truth --output-path out/prints/compare

With ``--kind crop`` windows lie anywhere in a photograph, with ``shift`` above or below its middle,
and with ``whole`` around the principal point. Each has a size of its own, so that no two
photographs have one focal length.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from colmap_affrect.colmap import pycolmap

SHARES = 0.6, 0.85  # of the sides of a photograph that are left
MAX_OFFSET = 0.25  # of the axis from the middle of a print, longer sides
LONGER_SIDE_PX = 1200, 1600  # of a print
JPEG_QUALITY = 92


@dataclass(frozen=True)
class Window:
    """A part of a photograph, px of the photograph."""

    left: float
    top: float
    width: float
    height: float


def window_of(
    kind: str, width: int, height: int, center: tuple[float, float], seed: int
) -> Window:
    """Return a window that is cut out.

    Args:
        kind: ``crop``, ``shift`` or ``whole``.
        width: Of the photograph, px.
        height: Of the photograph, px.
        center: Principal point, px.
        seed: For all that is left to chance.
    """
    random = np.random.default_rng(seed)
    while True:
        share = random.uniform(*SHARES)
        aspect = random.uniform(0.85, 1.0)
        cut = Window(
            left=0.0, top=0.0, width=width * share, height=height * share * aspect
        )
        across = random.uniform(0.0, 1.0) if kind == "crop" else 0.5
        down = random.uniform(0.0, 1.0) if kind != "whole" else 0.5
        left = across * (width - cut.width)
        top = down * (height - cut.height)
        offset_x = center[0] - left - cut.width / 2.0
        offset_y = center[1] - top - cut.height / 2.0
        longer = max(cut.width, cut.height)
        if math.hypot(offset_x, offset_y) <= MAX_OFFSET * longer:
            return Window(left, top, cut.width, cut.height)


def make_prints(
    image_path: Path,
    truth_path: Path,
    output_path: Path,
    kind: str,
    step: int,
    seed: int,
) -> None:
    """Write prints and their model.

    Args:
        image_path: Folder of the photographs.
        truth_path: Folder of their COLMAP model.
        output_path: Folder that gets ``images`` and ``ground_truth``.
        kind: ``crop``, ``shift`` or ``whole``.
        step: Every step-th photograph is taken.
        seed: For all that is left to chance.
    """
    truth = pycolmap.Reconstruction(str(truth_path))
    made = pycolmap.Reconstruction()
    (output_path / "images").mkdir(parents=True, exist_ok=True)
    (output_path / "ground_truth").mkdir(exist_ok=True)
    images = sorted(truth.images.values(), key=lambda image: image.name)
    for number, image in enumerate(images[::step]):
        camera = image.camera
        photograph = cv2.imread(str(image_path / image.name))
        rows, columns = photograph.shape[:2]
        scale = columns / camera.width
        center = (camera.principal_point_x * scale, camera.principal_point_y * scale)
        cut = window_of(kind, columns, rows, center, 1000 * seed + number)
        random = np.random.default_rng(2000 * seed + number)
        zoom = random.uniform(*LONGER_SIDE_PX) / max(cut.width, cut.height)
        size = (round(cut.width * zoom), round(cut.height * zoom))
        # Pixel centres of the print in those of the photograph
        to_photograph = np.array(
            [
                [1.0 / zoom, 0.0, cut.left + 0.5 / zoom - 0.5],
                [0.0, 1.0 / zoom, cut.top + 0.5 / zoom - 0.5],
            ]
        )
        flags = cv2.INTER_AREA if zoom < 1.0 else cv2.INTER_CUBIC
        blurred = photograph
        if zoom < 1.0:
            sigma = 0.5 * math.sqrt(1.0 / zoom**2 - 1.0)
            blurred = cv2.GaussianBlur(photograph, (0, 0), sigma)
            flags = cv2.INTER_LINEAR
        made_image = cv2.warpAffine(
            blurred, to_photograph, size, flags=flags | cv2.WARP_INVERSE_MAP
        )
        name = f"{Path(image.name).stem}.jpg"
        cv2.imwrite(
            str(output_path / "images" / name),
            made_image,
            [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY],
        )
        focal_px = camera.mean_focal_length() * scale * zoom
        own = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=size[0],
            height=size[1],
            params=[
                focal_px,
                (center[0] - cut.left) * zoom,
                (center[1] - cut.top) * zoom,
            ],
            camera_id=number + 1,
        )
        made.add_camera_with_trivial_rig(own)
        copy = pycolmap.Image(name=name, camera_id=own.camera_id, image_id=number + 1)
        made.add_image_with_trivial_frame(copy, image.cam_from_world())
    made.write_text(str(output_path / "ground_truth"))


def main() -> None:
    """Parse the command line and make prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image_path", type=Path, help="folder of the photographs")
    parser.add_argument("truth_path", type=Path, help="folder of their COLMAP model")
    parser.add_argument("output_path", type=Path, help="folder that is written")
    parser.add_argument("--kind", choices=("crop", "shift", "whole"), default="crop")
    parser.add_argument("--step", type=int, default=1, help="every n-th photograph")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    make_prints(
        given.image_path,
        given.truth_path,
        given.output_path,
        given.kind,
        given.step,
        given.seed,
    )


if __name__ == "__main__":
    main()
