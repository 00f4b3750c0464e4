"""What many photographs would take: pairs, storage, time and money, from measured unit costs.

Reads the unit costs from the section ``images`` of ``speed.py`` and machines from a TOML file.
Assumed: extraction is linear in images, matching and verification in pairs, both keep all cores of
the measured machine busy and share out over any number of cores; machines have its speed per
core. Each image meets its nearest ``--num-neighbors`` by retrieval; comparing the vectors of all
images to find them is counted at the measured peak, computing and sorting are not. Every pair
costs what those measured do, most of which overlap. Incremental mapping runs on one core and
grows with the power of the number of images that was measured on a few: it is not for a million,
which needs a hierarchical or global mapper. In clusters it is linear; joining them is not counted.
Usage:

    python tests/benchmarks/scaling.py --costs-path out/speed.json --recipe default
"""

from __future__ import annotations

import argparse
import json
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from speed_growth import growth_exponent
from speed_report import table

from colmap_affrect.matching.retrieval import NUM_WORDS

SECONDS_PER_HOUR = 3600.0
HOURS_PER_DAY = 24.0
HOURS_PER_YEAR = 365.25 * HOURS_PER_DAY
KEYPOINT_BYTES = 24
"""Of a keypoint in the database, six float32; what else is there counts for pairs."""
IMAGE_VECTOR_SIZE = 128 * NUM_WORDS
"""Elements of the vectors of images that retrieval compares, for descriptors of 128."""
IMAGE_VECTOR_BYTES = 2 * IMAGE_VECTOR_SIZE


@dataclass(frozen=True)
class UnitCosts:
    """What one image and one pair cost.

    Attributes:
        extract_s: core seconds per image.
        match_s, verify_s: core seconds per pair.
        map_s: seconds on one core of mapping ``num_mapped`` images.
        num_mapped: images that were mapped.
        map_exponent: power of the number of images that mapping grows with.
        features_bytes: of features.h5 per image.
        matches_bytes: of matches.h5 per pair.
        database_image_bytes, database_pair_bytes: of the database per image and per pair.
        core_gflops: of one core, for the comparison of image vectors.
    """

    extract_s: float
    match_s: float
    verify_s: float
    map_s: float
    num_mapped: int
    map_exponent: float
    features_bytes: float
    matches_bytes: float
    database_image_bytes: float
    database_pair_bytes: float
    core_gflops: float

    @classmethod
    def from_results(cls, results: Mapping[str, Any], recipe: str) -> UnitCosts:
        """Read the results of ``speed.py``; unit costs are those of the largest run."""
        rows = results["images"][recipe]
        largest, cores = rows[-1], results["cores"]
        keypoints_bytes = KEYPOINT_BYTES * largest["features"]
        return cls(
            extract_s=cores * largest["extract_s"] / largest["images"],
            match_s=cores * largest["match_s"] / largest["pairs"],
            verify_s=cores * largest["verify_s"] / largest["pairs"],
            map_s=largest["map_s"],
            num_mapped=int(largest["registered"]),
            map_exponent=growth_exponent([(row["registered"], row["map_s"]) for row in rows]),
            features_bytes=largest["features_bytes"] / largest["images"],
            matches_bytes=largest["matches_bytes"] / largest["pairs"],
            database_image_bytes=keypoints_bytes / largest["images"],
            database_pair_bytes=(largest["database_bytes"] - keypoints_bytes) / largest["pairs"],
            core_gflops=results["peaks"]["gflops_one"],
        )

    def mapping_hours(self, num_images: int) -> float:
        """Return the hours of one core for one model of so many images."""
        growth = (num_images / self.num_mapped) ** self.map_exponent
        return float(self.map_s * growth / SECONDS_PER_HOUR)


@dataclass(frozen=True)
class Machine:
    """A machine to rent.

    Attributes:
        name: for people.
        cores: of the speed of those that were measured.
        memory_gib: of all cores together.
        usd_per_hour: price.
    """

    name: str
    cores: int
    memory_gib: float
    usd_per_hour: float


@dataclass(frozen=True)
class Load:
    """What a collection takes with one choice of pairs.

    Attributes:
        num_images: photographs.
        num_pairs: to match and verify.
        pairs_hours: core hours of choosing the pairs.
        extract_hours, match_hours, verify_hours: core hours.
        map_hours: hours of one core for one incremental model of all images.
        cluster_hours: core hours for incremental models of clusters of images.
        vectors_bytes: memory of the vectors that retrieval compares, 0 for all pairs.
        features_bytes, matches_bytes, database_bytes: sizes of the files.
    """

    num_images: int
    num_pairs: int
    pairs_hours: float
    extract_hours: float
    match_hours: float
    verify_hours: float
    map_hours: float
    cluster_hours: float
    vectors_bytes: float
    features_bytes: float
    matches_bytes: float
    database_bytes: float

    @property
    def shared_hours(self) -> float:
        """Core hours of everything that shares out over cores, clusters in the place of one map."""
        steps = (self.pairs_hours, self.extract_hours, self.match_hours, self.verify_hours)
        return sum(steps) + self.cluster_hours


def simulate(
    costs: UnitCosts, num_images: int, num_neighbors: int | None, cluster_size: int
) -> Load:
    """Multiply unit costs.

    Args:
        costs: measured.
        num_images: photographs.
        num_neighbors: images that each one meets; None for all.
        cluster_size: images that are mapped together, where not all are.
    """
    num_pairs = num_images * (num_images - 1) // 2
    comparisons = 0
    if num_neighbors is not None:
        comparisons = num_images**2
        num_pairs = min(num_pairs, num_images * num_neighbors)
    comparing_s = 2.0 * comparisons * IMAGE_VECTOR_SIZE / (costs.core_gflops * 1e9)
    cluster_size = min(cluster_size, num_images)
    return Load(
        num_images=num_images,
        num_pairs=num_pairs,
        pairs_hours=comparing_s / SECONDS_PER_HOUR,
        extract_hours=num_images * costs.extract_s / SECONDS_PER_HOUR,
        match_hours=num_pairs * costs.match_s / SECONDS_PER_HOUR,
        verify_hours=num_pairs * costs.verify_s / SECONDS_PER_HOUR,
        map_hours=costs.mapping_hours(num_images),
        cluster_hours=num_images / cluster_size * costs.mapping_hours(cluster_size),
        vectors_bytes=0.0 if num_neighbors is None else num_images * IMAGE_VECTOR_BYTES,
        features_bytes=num_images * costs.features_bytes,
        matches_bytes=num_pairs * costs.matches_bytes,
        database_bytes=num_images * costs.database_image_bytes
        + num_pairs * costs.database_pair_bytes,
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


def loads_table(loads: Sequence[tuple[str, Load]]) -> str:
    """Show what collections take, a column for each; hours are of one core."""
    lines: dict[str, Callable[[Load], str]] = {
        "photographs": lambda load: f"{load.num_images:,}",
        "pairs": lambda load: f"{load.num_pairs:,}",
        "`features.h5`": lambda load: size(load.features_bytes),
        "`matches.h5`": lambda load: size(load.matches_bytes),
        "`database.db`": lambda load: size(load.database_bytes),
        "image vectors in memory": lambda load: (
            size(load.vectors_bytes) if load.vectors_bytes else "-"
        ),
        "choosing pairs": lambda load: duration(load.pairs_hours) if load.pairs_hours else "-",
        "extracting": lambda load: duration(load.extract_hours),
        "matching": lambda load: duration(load.match_hours),
        "verifying": lambda load: duration(load.verify_hours),
        "mapping, one incremental model": lambda load: duration(load.map_hours),
        "mapping, in clusters": lambda load: duration(load.cluster_hours),
    }
    rows = [(name, *(text(load) for _, load in loads)) for name, text in lines.items()]
    return table(("", *(name for name, _ in loads)), rows)


def machines_table(machines: Sequence[Machine], loads: Sequence[tuple[str, Load]]) -> str:
    """Show hours and money of all steps on one machine of each type, mapping in clusters."""
    header = ["machine", *(f"{name}, {load.num_images:,}" for name, load in loads)]
    rows = []
    for machine in machines:
        cells = []
        for _, load in loads:
            hours = load.shared_hours / machine.cores
            cells.append(f"{duration(hours)}, {hours * machine.usd_per_hour:,.0f} USD")
        price = f"{machine.usd_per_hour:.2f} USD/h, {machine.memory_gib:g} GiB"
        rows.append((f"{machine.name} ({price})", *cells))
    return table(header, rows)


def memory_table(machines: Sequence[Machine], loads: Sequence[tuple[str, Load]]) -> str:
    """Show how many times the memory of each machine the database is, which a mapper holds."""
    rows = [
        (machine.name, *(f"{load.database_bytes / (machine.memory_gib * 2**30):.2g}"
                         for _, load in loads))
        for machine in machines
    ]  # fmt: skip
    return table(["machine", *(f"{name}, {load.num_images:,}" for name, load in loads)], rows)


def read_machines(path: Path) -> list[Machine]:
    """Read the ``[[machine]]`` tables of a TOML file."""
    with path.open("rb") as file:
        return [Machine(**values) for values in tomllib.load(file)["machine"]]


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--costs-path", type=Path, required=True, help="JSON file of speed.py")
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--num-images", type=int, nargs="+", default=[10_000, 1_000_000])
    parser.add_argument("--num-neighbors", type=int, default=30, help="pairs per image")
    parser.add_argument("--cluster-size", type=int, default=200, help="images mapped together")
    parser.add_argument(
        "--machines-path", type=Path, default=Path(__file__).with_name("machines.toml")
    )
    return parser.parse_args()


def main() -> None:
    """Print the tables."""
    arguments = parse_arguments()
    results = json.loads(arguments.costs_path.read_text())
    costs = UnitCosts.from_results(results, arguments.recipe)
    machines = read_machines(arguments.machines_path)
    loads = [
        (name, simulate(costs, count, neighbors, arguments.cluster_size))
        for count in arguments.num_images
        for name, neighbors in (
            ("all pairs", None),
            (f"{arguments.num_neighbors} neighbours", arguments.num_neighbors),
        )
    ]
    print(
        f"Unit costs of `{arguments.recipe}` on {results['machine'].splitlines()[0]}: "
        f"{costs.extract_s:.2f} core seconds per image, {costs.match_s:.2f} per pair matched, "
        f"{costs.verify_s:.3f} verified; {size(costs.features_bytes)} of features per image, "
        f"{costs.matches_bytes / 1000:.0f} kB of matches per pair; mapping "
        f"{costs.num_mapped} images takes {costs.map_s:.1f} s and "
        f"grows with the power {costs.map_exponent:.2f}. "
        f"Times of one core; clusters have {arguments.cluster_size} images.\n"
    )
    print(loads_table(loads))
    print("All steps on one machine, mapping in clusters:\n")
    print(machines_table(machines, loads))
    print("Size of the database in units of the memory:\n")
    print(memory_table(machines, loads))


if __name__ == "__main__":
    main()
