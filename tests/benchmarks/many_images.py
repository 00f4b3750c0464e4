"""Time and memory of each stage of ``run``, and its errors, on more and more images. Usage:

    python tests/benchmarks/many_images.py --output-path out/many --num-images 50 200 1000 \
        --diagram-path out/many.png

Renders photographs of a street of different houses from random places, once, seven to the metre,
and runs the command on the first of them. Prints, for each number, the processor time of each stage
(all threads and child processes) and the largest memory that the process had while it worked, and
how many images of the largest model are where they were rendered; ``costs.json`` has the same. A
stage that takes ``n`` times as long for ``n`` times as many images has a growth of 1. The diagram
shows time and memory against the number of images, also of other calls::

    python tests/benchmarks/many_images.py --output-path out/many \
        --costs-paths out/many/costs.json out/more/costs.json --diagram-path out/many.png
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from importlib.util import find_spec
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
DEFAULT_NUM_IMAGES = 1000
UNKNOWN = 0.0, 0.0  # seconds and MiB of a stage
DRAWN_FROM_S = 1.0  # a stage that takes less for all numbers of images is left out
PANELS = (
    "processor time, s",
    "largest memory, MiB",
)  # as the costs of a stage have them


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


def stage_functions() -> list[tuple[Any, str, str]]:
    """Return where the functions of stages are looked up: module or class, name, stage."""
    from colmap_affrect import pipeline
    from colmap_affrect.escalation import map_and_rematch
    from colmap_affrect.escalation.escalate import Escalation

    return [
        # of the pipeline and of what maps and matches again
        (pipeline, "extract_features", "extract"),
        (pipeline, "list_pairs", "pairs"),
        (pipeline, "match_pairs", "match"),
        (pipeline, "verify_pairs", "verify"),
        (pipeline, "guide", "guide"),
        (map_and_rematch, "guide", "guide"),
        (map_and_rematch, "map_images", "map"),
        (map_and_rematch, "_try_learned_matches", "learned"),
        (Escalation, "take_steps", "escalate"),
        (pipeline, "map_pairs", "map"),
        (pipeline, "write_results", "report"),
    ]


def processor_s() -> float:
    """Return the processor time of this process and of its children that have ended."""
    own = os.times()
    return own.user + own.system + own.children_user + own.children_system


def peak_mib(*, forget: bool = False) -> float:
    """Return the largest memory that this process has had since it was last forgotten."""
    if forget:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024  # KiB
    return math.nan


def run_measured(costs_path: Path, command: Sequence[str]) -> int:
    """Run the command line in this process, and write what its stages cost.

    Args:
        costs_path: of the JSON file.
        command: what follows ``colmap-affrect``.

    Returns:
        Its exit code.
    """
    from colmap_affrect.cli import main as run_command

    costs: dict[str, list[float]] = {}

    def measured(function: Callable[..., Any], stage: str) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            begin_s = processor_s()
            peak_mib(forget=True)
            try:
                return function(*arguments, **keywords)
            finally:
                known_s, known_mib = costs.get(stage, (0.0, 0.0))
                took_s = processor_s() - begin_s
                costs[stage] = [known_s + took_s, max(known_mib, peak_mib())]

        return call

    for place, name, stage in stage_functions():
        setattr(place, name, measured(getattr(place, name), stage))
    code = run_command(command)
    in_stages_s = sum(took_s for took_s, _ in costs.values())
    costs["other"] = [processor_s() - in_stages_s, 0.0]
    costs_path.write_text(json.dumps(costs), encoding="utf-8")
    return code


def measure(folder: Path, count: int, options: Sequence[str]) -> dict[str, Any]:
    """Run on the first images, twice: the second run finds everything done.

    Args:
        folder: that has ``images``; each number of images gets a folder of results in it.
        count: number of images.
        options: of ``run``.

    Returns:
        By ``first`` and ``idle``: seconds and MiB of each stage.
    """
    listed = folder / f"names-{count}.txt"
    names = [file_name(number) for number in range(count)]
    listed.write_text("\n".join(names), encoding="utf-8")
    out = folder / f"run-{count}"
    width, height = IMAGE_SIZE
    parameters = f"{FOCAL_LENGTH_PX},{FOCAL_LENGTH_PX},{width / 2},{height / 2}"
    command = [
        *("run", "--quiet", "--image-path", str(folder / "images")),
        *("--image-list-path", str(listed), "--output-path", str(out)),
        *("--camera-mode", "single", "--camera-model", "PINHOLE"),
        *("--camera-params", parameters, *options),
    ]
    costs_path = folder / "costs-of-run.json"
    found: dict[str, Any] = {"num_images": count, "beside_other_work": False}
    for kind, more in (("first", ["--overwrite"]), ("idle", [])):
        own = [
            *(sys.executable, str(Path(__file__).resolve())),
            *("--output-path", str(folder), "--measure-run", str(costs_path), "--"),
        ]
        begin_s = time.monotonic()
        subprocess.run([*own, *command, *more], check=True, stdout=subprocess.DEVNULL)
        found[f"{kind}_wall_s"] = time.monotonic() - begin_s
        found[kind] = json.loads(costs_path.read_text(encoding="utf-8"))
    costs_path.unlink()
    found["scores"] = scores(out / "sparse" / "0", count)
    return found


def rows_of(found: Sequence[dict[str, Any]], kind: str) -> list[list[str]]:
    """Return a row for each stage: seconds and memory by number of images, and the growth.

    Args:
        found: what :func:`measure` returned, by rising number of images.
        kind: ``first`` or ``idle``.
    """
    stages = dict.fromkeys(stage for one in found for stage in one[kind])
    rows = []
    for stage in stages:
        cells = [stage]
        seconds = [one[kind].get(stage, (0.0, 0.0))[0] for one in found]
        for one, took_s in zip(found, seconds, strict=True):
            memory_mib = one[kind].get(stage, (0.0, 0.0))[1]
            cells.append(f"{took_s:.1f} s, {memory_mib:.0f} MiB")
        growth = math.nan
        if len(found) > 1 and seconds[-2] > 0.0 and seconds[-1] > 0.0:
            more = found[-1]["num_images"] / found[-2]["num_images"]
            growth = math.log(seconds[-1] / seconds[-2]) / math.log(more)
        rows.append([*cells, f"{growth:.1f}"])
    return rows


def read_costs(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Return what several calls have written to ``costs.json``."""
    found = []
    for path in paths:
        found += json.loads(path.read_text(encoding="utf-8"))
    return found


def by_number(found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return costs by rising number of images; the last one counts of those of one number."""
    last = {one["num_images"]: one for one in found}
    return [last[count] for count in sorted(last)]


def drawn_stages(found: Sequence[dict[str, Any]]) -> list[str]:
    """Return the stages that take long enough to be seen, in the order of a run."""
    longest: dict[str, float] = {}
    for one in found:
        for stage, (took_s, _) in one["first"].items():
            longest[stage] = max(longest.get(stage, 0.0), took_s)
    longest.pop("other", None)
    return [stage for stage, took_s in longest.items() if took_s >= DRAWN_FROM_S]


def points_of(
    found: Sequence[dict[str, Any]], stage: str, panel: int
) -> tuple[list[int], list[float]]:
    """Return numbers of images, and what a stage cost for each, where that is known."""
    counts = []
    values = []
    for one in found:
        value = one["first"].get(stage, UNKNOWN)[panel]
        if value > 0.0:
            counts.append(one["num_images"])
            values.append(value)
    return counts, values


def guide_line(found: Sequence[dict[str, Any]]) -> tuple[list[int], list[float]]:
    """Return numbers of images, and a time that grows as n log n from that of the first run."""
    counts = [one["num_images"] for one in found]
    total_s = sum(took_s for took_s, _ in found[0]["first"].values())
    growth = [count * math.log(count) for count in counts]
    return counts, [total_s * value / growth[0] for value in growth]


def draw(found: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw time and memory of each stage against the number of images.

    Args:
        found: what :func:`measure` returned, by rising number of images.
        path: of a picture that is written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    counts = [one["num_images"] for one in found]
    for panel, label in enumerate(PANELS):
        axes = figure.add_subplot(1, len(PANELS), panel + 1)
        for stage in drawn_stages(found):
            axes.plot(*points_of(found, stage, panel), marker="o", label=stage)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(counts, [f"{count:,}" for count in counts])
        axes.minorticks_off()
        axes.set_xlabel("images")
        axes.set_ylabel(label)
        axes.grid(visible=True, alpha=0.3)
        for one in found:
            if one["beside_other_work"]:
                axes.axvline(one["num_images"], color="gray", linestyle=":")
    times = figure.axes[0]
    times.plot(*guide_line(found), color="black", linestyle="--", label="n log n")
    times.legend(fontsize="small")
    if any(one["beside_other_work"] for one in found):
        figure.supxlabel("dotted: measured beside other work", fontsize="small")
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=80)


def parsed_arguments() -> Namespace:
    """Return what the command line says."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--output-path",
        type=Path,
        required=True,
        help="folder of photographs, results and costs.json",
    )
    parser.add_argument(
        "--num-images",
        type=int,
        nargs="+",
        help="numbers of images, each of which is run on; default: 1000, none with --costs-paths",
    )
    parser.add_argument(
        "--costs-paths",
        type=Path,
        nargs="+",
        default=[],
        help="costs.json of other calls, which are shown as well",
    )
    parser.add_argument("--diagram-path", type=Path, help="PNG file, by matplotlib")
    parser.add_argument("--measure-run", type=Path, help="JSON file; runs OPTIONS once")
    parser.add_argument(
        "options", nargs="*", help="of run, after --; default: --pairs retrieval"
    )
    arguments = parser.parse_args()
    if arguments.diagram_path and not find_spec("matplotlib"):
        raise SystemExit("--diagram-path: needs matplotlib; pip install matplotlib")
    return arguments


def measure_all(
    folder: Path, counts: Sequence[int], options: Sequence[str]
) -> list[dict[str, Any]]:
    """Run on each number of images, and write ``costs.json`` after each.

    Args:
        folder: of photographs and results.
        counts: rising numbers of images.
        options: of ``run``.
    """
    photographs = folder / "images"
    photographs.mkdir(parents=True, exist_ok=True)
    take_photographs(photographs, counts[-1])
    found = []
    for count in counts:
        found.append(measure(folder, count, options))
        (folder / "costs.json").write_text(
            json.dumps(found, indent=1), encoding="utf-8"
        )
    return found


def print_tables(found: Sequence[dict[str, Any]]) -> None:
    """Print the costs of first runs, of idle ones where these were measured, and what is right."""
    for kind in ("first", "idle"):
        known = [one for one in found if kind in one]
        header = ("stage", *[f"{one['num_images']} images" for one in known], "growth")
        print(f"{kind} run\n\n{table(header, rows_of(known, kind))}")
    for one in found:
        print(one["scores"])


def main() -> None:
    """Print the tables, and draw the diagram."""
    arguments = parsed_arguments()
    if arguments.measure_run:
        sys.exit(run_measured(arguments.measure_run, arguments.options))
    # read first: this call may write one of them
    found = read_costs(arguments.costs_paths)
    counts = sorted(arguments.num_images or ([] if found else [DEFAULT_NUM_IMAGES]))
    print(describe_machine())
    if counts:
        options = arguments.options or ("--pairs", "retrieval")
        found += measure_all(arguments.output_path, counts, options)
    found = by_number(found)
    print_tables(found)
    if arguments.diagram_path:
        arguments.diagram_path.parent.mkdir(parents=True, exist_ok=True)
        draw(found, arguments.diagram_path)


if __name__ == "__main__":
    main()
