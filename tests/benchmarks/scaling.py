"""What many photographs would take: pairs, storage, time and money, from measured unit costs.

Measures a recipe on a quarter, half and all of the first images of a folder, and multiplies. Costs
that are in --costs-path already are not measured again.

Assumed: extraction is linear in images, matching and verification in pairs, both keep all cores of
the measured machine busy and share out over any number of cores; machines have its speed per
core. Each image meets its nearest ``--num-neighbors`` by retrieval; comparing the vectors of all
images to find them is counted at the measured peak, network and sorting are not. Every pair
costs what those measured do, most of which overlap. Incremental mapping runs on one core and
grows with the power of the number of images that was measured on a few: it is not for a million,
which needs a hierarchical or global mapper. In clusters it is linear; joining them is not counted.
Usage:

    python tests/benchmarks/scaling.py --image-path PHOTOS --costs-path out/costs.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from machine import core_gflops, describe_machine, table
from speed import growth_exponent, run_commands

from colmap_affrect.colmap import pycolmap
from colmap_affrect.comparison.methods import parse_method
from colmap_affrect.pairs.retrieval import NUM_WORDS
from colmap_affrect.parallel.executor import available_cores
from colmap_affrect.stages.context import Resources

SECONDS_PER_HOUR = 3600.0
HOURS_PER_DAY = 24.0
HOURS_PER_YEAR = 365.25 * HOURS_PER_DAY
KEYPOINT_BYTES = 24
"""Of a keypoint in the database, six float32; what else is there counts for pairs."""
IMAGE_VECTOR_SIZE = 128 * NUM_WORDS
"""Elements of the vectors of images that retrieval compares, for descriptors of 128."""
IMAGE_VECTOR_BYTES = 2 * IMAGE_VECTOR_SIZE


def measure(recipe: str, paths: Sequence[Path]) -> dict[str, Any]:
    """Run a recipe on a quarter, half and all of some images."""
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    counts = sorted({max(2, len(paths) // part) for part in (4, 2, 1)})
    method = parse_method(recipe)
    return {
        "machine": describe_machine(),
        "recipe": recipe,
        "cores": available_cores(),
        "core_gflops": core_gflops(),
        "runs": [run_commands(method, paths[:count], Resources()) for count in counts],
    }


@dataclass(frozen=True)
class Load:
    """What a collection takes with one choice of pairs.

    Attributes:
        num_pairs: to match and verify.
        num_bytes: sizes of the files, and of the vectors that retrieval compares in memory.
        core_hours: by step, of what shares out over cores; mapping in clusters.
        one_map_hours: of one core for one incremental model of all images.
    """

    num_pairs: int
    num_bytes: Mapping[str, float]
    core_hours: Mapping[str, float]
    one_map_hours: float


def simulate(
    costs: Mapping[str, Any], num_images: int, num_neighbors: int | None, cluster_size: int
) -> Load:
    """Multiply the unit costs of the largest run.

    Args:
        costs: as :func:`measure` returns them.
        num_images: photographs.
        num_neighbors: images that each one meets; None for all.
        cluster_size: images that are mapped together, where not all are.
    """
    runs, run = costs["runs"], costs["runs"][-1]
    num_pairs = num_images * (num_images - 1) // 2
    num_vectors = 0
    if num_neighbors is not None:
        num_vectors, num_pairs = num_images, min(num_pairs, num_images * num_neighbors)
    image_runs, pair_runs = num_images / run["images"], num_pairs / run["pairs"]
    core_hours_of_run = {
        stage: costs["cores"] * run[f"{stage}_s"] / SECONDS_PER_HOUR
        for stage in ("extract", "match", "verify")
    }
    comparing_s = 2.0 * num_vectors**2 * IMAGE_VECTOR_SIZE / (costs["core_gflops"] * 1e9)
    keypoints_bytes = KEYPOINT_BYTES * run["features"]
    exponent = growth_exponent([(each["registered"], each["map_s"]) for each in runs])

    def mapping_hours(size: int) -> float:
        return float(run["map_s"] * (size / run["registered"]) ** exponent / SECONDS_PER_HOUR)

    cluster_size = min(cluster_size, num_images)
    return Load(
        num_pairs,
        {
            "`features.h5`": image_runs * run["features_bytes"],
            "`matches.h5`": pair_runs * run["matches_bytes"],
            "`database.db`": image_runs * keypoints_bytes
            + pair_runs * (run["database_bytes"] - keypoints_bytes),
            "image vectors in memory": num_vectors * IMAGE_VECTOR_BYTES,
        },
        {
            "choosing pairs": comparing_s / SECONDS_PER_HOUR,
            "extracting": image_runs * core_hours_of_run["extract"],
            "matching": pair_runs * core_hours_of_run["match"],
            "verifying": pair_runs * core_hours_of_run["verify"],
            "mapping, in clusters": num_images / cluster_size * mapping_hours(cluster_size),
        },
        mapping_hours(num_images),
    )


def duration(hours: float) -> str:
    """Format hours.

    >>> [duration(hours) for hours in (0.5, 30.0, 100.0, 1e5)]
    ['30 min', '30 h', '4.17 days', '11 years']
    """
    if hours < 1.0:
        return f"{60 * hours:.2g} min"
    if hours < 3 * HOURS_PER_DAY:
        return f"{hours:.3g} h"
    if hours < HOURS_PER_YEAR:
        return f"{hours / HOURS_PER_DAY:.3g} days"
    return f"{hours / HOURS_PER_YEAR:,.0f} years"


def size(num_bytes: float) -> str:
    """Format bytes.

    >>> [size(count) for count in (5e6, 2.54e9, 3e12, 4e15)]
    ['5 MB', '2.54 GB', '3 TB', '4 PB']
    """
    exponent = 2
    while num_bytes >= 999.5 * 1000**exponent and exponent < 5:
        exponent += 1
    return f"{num_bytes / 1000**exponent:.3g} {'_kMGTP'[exponent]}B"


def report(loads: Mapping[str, Load], cores: int, usd_per_hour: float) -> str:
    """Show what collections take, a column for each; hours are of one core but in the last row."""
    columns = loads.values()
    first = next(iter(columns))
    rows = [("pairs", *(f"{load.num_pairs:,}" for load in columns))]
    rows += [(key, *(size(load.num_bytes[key]) for load in columns)) for key in first.num_bytes]
    rows += [
        (key, *(duration(load.core_hours[key]) for load in columns)) for key in first.core_hours
    ]
    rows.append(("mapping, one model", *(duration(load.one_map_hours) for load in columns)))
    hours = [sum(load.core_hours.values()) / cores for load in columns]
    cells = [f"{duration(count)}, {count * usd_per_hour:,.0f} USD" for count in hours]
    rows.append((f"all of it on {cores} cores at {usd_per_hour:.2f} USD an hour", *cells))
    return table(("photographs", *loads), rows)


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--costs-path", type=Path, required=True, help="JSON file of costs")
    parser.add_argument("--image-path", type=Path, help="folder of images to measure costs on")
    parser.add_argument("--max-num-images", type=int, default=16, help="to measure costs on")
    parser.add_argument("--recipe", default="default", help="to measure costs of")
    parser.add_argument("--num-images", type=int, nargs="+", default=[10_000, 1_000_000])
    parser.add_argument("--num-neighbors", type=int, default=30, help="pairs per image")
    parser.add_argument("--cluster-size", type=int, default=200, help="images mapped together")
    parser.add_argument("--cores", type=int, default=64, help="of the machine to rent")
    parser.add_argument("--usd-per-hour", type=float, default=2.80, help="its price, an example")
    arguments = parser.parse_args()
    if not (arguments.costs_path.exists() or arguments.image_path):
        parser.error(f"{arguments.costs_path} is not there: give --image-path to measure costs")
    return arguments


def main() -> None:
    """Measure what is not known, and print the table."""
    arguments = parse_arguments()
    if not arguments.costs_path.exists():
        paths = sorted(arguments.image_path.iterdir())[: arguments.max_num_images]
        arguments.costs_path.write_text(json.dumps(measure(arguments.recipe, paths), indent=1))
    costs = json.loads(arguments.costs_path.read_text())
    run, cores = costs["runs"][-1], costs["cores"]
    print(
        f"`{costs['recipe']}` on {costs['machine'].splitlines()[0]}: "
        f"{cores * run['extract_s'] / run['images']:.2f} core seconds per image, "
        f"{cores * run['match_s'] / run['pairs']:.2f} per pair matched, "
        f"{cores * run['verify_s'] / run['pairs']:.3f} verified; mapping {run['registered']} "
        f"images takes {run['map_s']:.1f} s.\n"
    )
    loads = {
        f"{count:,}, {name}": simulate(costs, count, neighbors, arguments.cluster_size)
        for count in arguments.num_images
        for name, neighbors in (
            ("all pairs", None),
            (f"{arguments.num_neighbors} neighbours", arguments.num_neighbors),
        )
    }
    print(report(loads, arguments.cores, arguments.usd_per_hour))


if __name__ == "__main__":
    main()
