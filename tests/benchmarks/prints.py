"""Make photographs look as prints are: cut off centre, or of a shifted view camera.

Writes photographs without EXIF and a COLMAP text model of their cameras and poses, from a scene
with a known model. Usage:

    python tests/benchmarks/prints.py SCENE/images SCENE/ground_truth out/prints --kind crop
    colmap-affrect compare --image-path out/prints/images \
        --ground-truth-path out/prints/ground_truth --output-path out/prints/compare

With ``--kind crop`` windows lie anywhere in a photograph, with ``turned`` they lie askew as well,
with ``shift`` above or below its middle, and with ``whole`` around the principal point. Each has a
size of its own, so that no two photographs have one focal length.
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
MAX_TURN_DEG = 10.0  # of a print that was laid askew
MAX_OFFSET = 0.25  # of the axis from the middle of a print, longer sides
LONGER_SIDE_PX = 1200, 1600  # of a print
JPEG_QUALITY = 92
KINDS = "crop", "turned", "shift", "whole"


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
        kind: One of ``KINDS``.
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
        across = random.uniform(0.0, 1.0) if kind in ("crop", "turned") else 0.5
        down = random.uniform(0.0, 1.0) if kind != "whole" else 0.5
        left = across * (width - cut.width)
        top = down * (height - cut.height)
        offset_x = center[0] - left - cut.width / 2.0
        offset_y = center[1] - top - cut.height / 2.0
        longer = max(cut.width, cut.height)
        if math.hypot(offset_x, offset_y) <= MAX_OFFSET * longer:
            return Window(left, top, cut.width, cut.height)


def _that_stays_inside(cut: Window, turn_rad: float) -> Window:
    """Return a window around the same middle, so small that it lies inside when it is turned."""
    cosine = math.cos(turn_rad)
    sine = abs(math.sin(turn_rad))
    across = cut.width / (cut.width * cosine + cut.height * sine)
    down = cut.height / (cut.width * sine + cut.height * cosine)
    share = min(across, down)
    return Window(
        left=cut.left + cut.width * (1.0 - share) / 2.0,
        top=cut.top + cut.height * (1.0 - share) / 2.0,
        width=cut.width * share,
        height=cut.height * share,
    )


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
        kind: One of ``KINDS``.
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
        longer_px = random.uniform(*LONGER_SIDE_PX)
        turn_rad = 0.0
        if kind == "turned":
            turn_rad = math.radians(random.uniform(-MAX_TURN_DEG, MAX_TURN_DEG))
            cut = _that_stays_inside(cut, turn_rad)
        zoom = longer_px / max(cut.width, cut.height)
        size = (round(cut.width * zoom), round(cut.height * zoom))
        turn = np.array(
            [
                [math.cos(turn_rad), -math.sin(turn_rad)],
                [math.sin(turn_rad), math.cos(turn_rad)],
            ]
        )
        middle = np.array([cut.left + cut.width / 2.0, cut.top + cut.height / 2.0])
        print_middle = np.array([cut.width, cut.height]) * zoom / 2.0
        # Pixel centres of the print in those of the photograph
        offset = middle - 0.5 - turn @ (print_middle - 0.5) / zoom
        to_photograph = np.column_stack([turn / zoom, offset])
        flags = cv2.INTER_CUBIC
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
        axis_px = print_middle + turn.T @ (np.array(center) - middle) * zoom
        own = pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=size[0],
            height=size[1],
            params=[focal_px, *axis_px],
            camera_id=number + 1,
        )
        made.add_camera_with_trivial_rig(own)
        copy = pycolmap.Image(name=name, camera_id=own.camera_id, image_id=number + 1)
        back = pycolmap.Rotation3d(np.array([0.0, 0.0, -turn_rad]))
        turned = pycolmap.Rigid3d(back, np.zeros(3)) * image.cam_from_world()
        made.add_image_with_trivial_frame(copy, turned)
    made.write_text(str(output_path / "ground_truth"))


def main() -> None:
    """Parse the command line and make prints."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("image_path", type=Path, help="folder of the photographs")
    parser.add_argument("truth_path", type=Path, help="folder of their COLMAP model")
    parser.add_argument("output_path", type=Path, help="folder that is written")
    parser.add_argument("--kind", choices=KINDS, default="crop")
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
