"""Time, memory and errors of ``run`` on many images. Usage:

    python tests/benchmarks/many_images.py --output-path out/many --num-images 1000

Renders photographs of a street of different houses from random places, once, seven to the metre,
and runs the command on them. Prints the seconds of its stages, the largest memory of a process, and
how many images of the largest model are where they were rendered.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe_machine, parser_of, table

from colmap_affrect.colmap.model_files import read_poses
from colmap_affrect.comparison.results import pose_scores
from colmap_affrect.parallel.executor import available_cores

sys.path.append(str(Path(__file__).parents[2] / "sample_scenes"))

import procedural as materials
import render

IMAGE_SIZE = 320, 240
FOCAL_LENGTH_PX = 480.0
MAX_AZIMUTH_DEG = 60.0
SAMPLES_PER_PIXEL = 2
HOUSE_SIZE_M = 14.0, 5.5
PAVEMENT_M = 12.0
TEXELS_PER_METRE = 150.0
STEP_M = 0.14
SIGHT_M = 40.0


def front(random: np.random.Generator) -> materials.Surface:
    """Build the front of a house: plaster on masonry, windows, ivy."""
    width, height = HOUSE_SIZE_M
    shape = materials.texture_shape(width, height, TEXELS_PER_METRE)
    palette = (render.BRICK, render.ASHLAR)[random.integers(2)]
    stones = materials.masonry(random, shape, TEXELS_PER_METRE, palette)
    color = random.uniform(0.4, 0.85, 3)
    wall = materials.plaster(
        random, stones, tuple(color), fallen=random.uniform(0.0, 1.0)
    )
    painter = materials.Painter(random, wall)
    for top in (0.85, 3.15):
        for left in np.arange(1.0, width - 1, random.uniform(2.0, 3.0)):
            size = random.uniform(0.7, 1.1), random.uniform(1.0, 1.3)
            place = left + random.uniform(0, 0.4), top + random.uniform(0, 0.2)
            materials.window(
                painter, *place, *size, render.CARVED, arched=random.random() < 0.5
            )
    materials.leaves(painter, [(random.uniform(0, width), height)], 3.6, 900)
    painter.finish()
    materials.weather(random, wall)
    return wall


@lru_cache(maxsize=16)
def house(number: int) -> Sequence[Any]:
    """Build a house and the pavement before it; every house is another one."""
    random = np.random.default_rng([66, number])
    x_axis, y_axis, up = np.eye(3)
    width, height = HOUSE_SIZE_M
    left = (number - 0.5) * width
    set_back = y_axis * random.uniform(0, 1.5)
    shape = materials.texture_shape(width, PAVEMENT_M, TEXELS_PER_METRE)
    slabs = materials.masonry(
        random, shape, TEXELS_PER_METRE, render.PAVING, flagstones=0.55
    )
    pavement = render.Plane(
        x_axis * left + 2 * y_axis, x_axis, -y_axis, width, PAVEMENT_M, slabs
    )
    wall_origin = x_axis * left + set_back + up * height
    wall = render.Plane(wall_origin, x_axis, -up, width, height, front(random))
    planes = [pavement, wall]
    render.prepare(planes)
    return planes


def street(position_m: float) -> Sequence[Any]:
    """Build the houses that can be seen from a position along the street."""
    render.SUPERSAMPLING = SAMPLES_PER_PIXEL
    first, last = (
        round((position_m + way * SIGHT_M) / HOUSE_SIZE_M[0]) for way in (-1, 1)
    )
    return [
        plane for number in range(max(0, first), last + 1) for plane in house(number)
    ]


def file_name(number: int) -> str:
    """Return the name of an image."""
    return f"{number:05d}.jpg"


def view_of(number: int) -> Any:
    """Return a view of the street, from a place that depends on the number only."""
    random = np.random.default_rng([67, number])
    place = (
        random.uniform(-MAX_AZIMUTH_DEG, MAX_AZIMUTH_DEG),
        random.uniform(4.0, 10.0),
        random.uniform(1.5, 3.0),
        STEP_M * number + random.uniform(-5.0, 5.0),
    )
    roll = random.uniform(-3, 3)
    return render._walk_view(
        file_name(number), place, roll, FOCAL_LENGTH_PX, IMAGE_SIZE
    )


def take_photograph(path: Path, number: int) -> None:
    """Render one image."""
    grain = np.random.default_rng([68, number])
    planes = street(STEP_M * number)
    render.write_jpeg(path, render.photograph(view_of(number), planes, grain))


def take_photographs(folder: Path, count: int) -> None:
    """Render what is not there yet."""
    paths = {number: folder / file_name(number) for number in range(count)}
    missing = {path: number for number, path in paths.items() if not path.exists()}
    with ProcessPoolExecutor(available_cores()) as pool:
        list(pool.map(take_photograph, missing.keys(), missing.values(), chunksize=8))


def scores(model_path: Path, count: int) -> str:
    """Compare a model with the places that the images were rendered from."""
    views = [view_of(number) for number in range(count)]
    truth = {view.name: (view.rotation, -view.rotation @ view.center) for view in views}
    found = pose_scores(read_poses(model_path), truth, list(truth))
    return (
        f"{len(found.correct_names)} of {count} images are registered correctly; median error of "
        f"{found.median_rotation_error_deg:.3f} degrees"
    )


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--output-path", type=Path, required=True)
    parser.add_argument("--num-images", type=int, default=1000)
    parser.add_argument(
        "options", nargs="*", help="of run, after --; default: --pairs retrieval"
    )
    arguments = parser.parse_args()
    photographs = arguments.output_path / "images"
    out = arguments.output_path / "run"
    photographs.mkdir(parents=True, exist_ok=True)
    take_photographs(photographs, arguments.num_images)
    parameters = (
        f"{FOCAL_LENGTH_PX},{FOCAL_LENGTH_PX},{IMAGE_SIZE[0] / 2},{IMAGE_SIZE[1] / 2}"
    )
    command = [
        *(sys.executable, "-m", "colmap_affrect", "run", "--overwrite"),
        *("--image-path", str(photographs), "--output-path", str(out)),
        *(
            "--camera-mode",
            "single",
            "--camera-model",
            "PINHOLE",
            "--camera-params",
            parameters,
        ),
        *(arguments.options or ("--pairs", "retrieval")),
    ]
    print(describe_machine())
    _, status, usage = os.wait4(subprocess.Popen(command).pid, 0)
    if status:
        raise SystemExit(f"the run ended with {os.waitstatus_to_exitcode(status)}")
    stages = json.loads((out / "report.json").read_text(encoding="utf-8"))["stages"]
    print(
        table(
            ("stage", "seconds"),
            [(each["name"], f"{each['wall_s']:.0f}") for each in stages],
        )
    )
    print(f"memory at most: {usage.ru_maxrss / 2**20:.2f} GiB")  # of a process, KiB
    print(scores(out / "sparse" / "0", arguments.num_images))


if __name__ == "__main__":
    main()
