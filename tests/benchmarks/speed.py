"""Speed beside COLMAP's SIFT: whole commands, stages against the machine's peak, growth.

All methods run on the same photographs in one process, in turn, in several rounds. Sections:

    commands  extract, match, verify and map by the whole commands on all cores
    stages    each stage in core seconds, its counted work against what a core can do at most
    pixels    extraction of one picture at 320 to 2400 px, core seconds
    features  matching of 1000 to 16000 features, ours and COLMAP's, core seconds
    images    the whole commands on more and more images, and the size of the files

Prints Markdown of everything in the JSON file; sections that are not run this time are kept. Other
load on the machine shows in the ranges. Usage:

    python tests/benchmarks/speed.py --image-path ../shared/scenes/strecha_fountain_p11/images \
        --output-path out/speed.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from machine import describe_machine, measure_peaks
from speed_growth import feature_growth, image_growth, pixel_growth
from speed_measure import SIFT_METHODS, Method, StageMeasurement, measure_commands
from speed_report import report
from speed_stages import PAIR_STAGES
from stage_clock import StageClock

from colmap_affrect.colmap import pycolmap
from colmap_affrect.executor import available_cores
from colmap_affrect.extraction import Resources

SECTIONS = ("commands", "stages", "pixels", "features", "images")
DEFAULT_METHODS = [*SIFT_METHODS, "unrectified-rootsift", "default"]
SLOW_SIFT = [name for name in SIFT_METHODS if name != "sift"]


def run_commands(methods: Sequence[Method], paths: Sequence[Path], num_rounds: int) -> Any:
    """Return for each method a row of costs for each round."""
    rows: dict[str, list[dict[str, float]]] = {method.name: [] for method in methods}
    for _ in range(num_rounds):
        for method in methods:
            rows[method.name].append(measure_commands(method, paths))
    return rows


def run_stages(methods: Sequence[Method], paths: Sequence[Path], num_rounds: int) -> Any:
    """Return for each method the seconds of stages for each round, and their work."""
    measurements = {method.name: StageMeasurement(method, paths) for method in methods}
    clocks: dict[str, list[StageClock]] = {name: [] for name in measurements}
    for _ in range(num_rounds):
        for name, measurement in measurements.items():
            clocks[name].append(measurement.run())
    num_pairs = len(paths) * (len(paths) - 1) // 2
    counts = {name: num_pairs for name in PAIR_STAGES if not name.startswith("prepare")}
    return {
        name: {
            "seconds": [
                {stage: s / counts.get(stage, len(paths)) for stage, s in clock.seconds.items()}
                for clock in of_rounds
            ],
            "work": {
                stage: [value / counts.get(stage, len(paths)) for value in asdict(work).values()]
                for stage, work in of_rounds[0].work.items()
            },
        }
        for name, of_rounds in clocks.items()
    }


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--image-path", type=Path, required=True, help="folder of images")
    parser.add_argument(
        "--num-images", type=int, default=4, help="the first so many; all sections but images"
    )
    parser.add_argument("--max-num-images", type=int, default=12, help="of the section images")
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument(
        "--methods", nargs="+", default=DEFAULT_METHODS, metavar="METHOD",
        help=f"{', '.join(SIFT_METHODS)} or RECIPE[:KEY=VALUE[,...]]; the first is the reference",
    )  # fmt: skip
    parser.add_argument("--sections", nargs="+", choices=SECTIONS, default=SECTIONS)
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    return parser.parse_args()


def main() -> None:
    """Run the sections and print the tables."""
    arguments = parse_arguments()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    output_path, num_rounds = arguments.output_path, arguments.num_rounds
    all_paths = sorted(arguments.image_path.iterdir())
    paths = all_paths[: arguments.num_images]
    methods = [Method(name, Resources(arguments.weights)) for name in arguments.methods]
    fast = [method for method in methods if method.name not in SLOW_SIFT]
    run: dict[str, Callable[[], Any]] = {
        "commands": lambda: run_commands(methods, paths, num_rounds),
        "stages": lambda: run_stages(fast, paths, num_rounds),
        "pixels": lambda: pixel_growth(fast, paths, num_rounds),
        "features": lambda: feature_growth(paths, num_rounds),
        "images": lambda: image_growth(fast, all_paths, arguments.max_num_images),
    }
    results = json.loads(output_path.read_text()) if output_path.exists() else {}
    results |= {
        "machine": describe_machine(),
        "cores": available_cores(),
        "peaks": asdict(measure_peaks()),
    }
    for section in arguments.sections:
        results[section] = run[section]()
        output_path.write_text(json.dumps(results, indent=1) + "\n")
    print(report(results))


if __name__ == "__main__":
    main()
