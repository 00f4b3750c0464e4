"""How many of the pairs that verify are kept when only some are matched.

The output folder must be of a run that matched all pairs. For every share of all pairs, and every
way to choose them, the table has the share chosen, the recall (of the pairs that verify), the
largest recall that so many pairs can have, the share of all inliers kept, and the seconds of
choosing. Usage:

    colmap-affrect run --image-path photos --output-path out
    python tests/benchmarks/pair_recall.py out
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from machine import table

from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.matchers.nearest import NearestOptions
from colmap_affrect.pairs.base import Pair
from colmap_affrect.pairs.lists import sequence_pairs
from colmap_affrect.pairs.retrieval import NUM_STRONGEST, low_resolution_pairs, retrieved_pairs
from colmap_affrect.progress import SILENT
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.one_pair import CachedMatcher, Matching

HEADER = ("chosen by", "chosen", "recall", "possible", "inliers", "s")


def inliers_of_pairs(workspace: Workspace) -> dict[Pair, int]:
    """Read the inliers of the pairs that verify."""
    verification = Context(workspace).verification
    with open_database(workspace.database) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
    found = verified_pairs(workspace.database, verification.min_num_inliers)
    return {
        (min(names[a], names[b]), max(names[a], names[b])): count for (a, b), count in found.items()
    }


def ways_to_choose(features: FeatureStore) -> dict[str, Callable[[int], Sequence[Pair]]]:
    """Return the ways to choose pairs such that images have so many neighbours on average."""
    names = sorted(features.names())
    matcher = CachedMatcher(Matching(features, NearestOptions(), max_num_features=NUM_STRONGEST))

    def count(pair: Pair) -> int:
        return len(matcher.match(*map(matcher.prepared, pair)).indices)

    def retrieved(num: int) -> list[Pair]:
        return retrieved_pairs(names, features.read, num, SILENT)

    def low_resolution(num: int) -> list[Pair]:
        return low_resolution_pairs(names, count, num, SILENT)

    def either(num: int) -> list[Pair]:
        half = -(-num // 2)
        return sorted({*retrieved(half), *low_resolution(half)})

    return {
        "retrieval": retrieved,
        "low-resolution": low_resolution,
        "either of both": either,
        "sequence": lambda num: sequence_pairs(names, -(-num // 2)),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output_path", type=Path, help="folder of a finished run")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.2, 0.3])
    arguments = parser.parse_args()
    workspace = Workspace(arguments.output_path)
    features, inliers = Context(workspace).features, inliers_of_pairs(workspace)
    num_images, num_right = len(features.names()), len(inliers)
    num_pairs = num_images * (num_images - 1) // 2
    rows = []
    ways = ways_to_choose(features).items()
    for (way, choose), share in itertools.product(ways, arguments.shares):
        start = time.perf_counter()
        chosen = choose(max(1, round(share * (num_images - 1))))
        seconds = time.perf_counter() - start
        kept = [inliers[pair] for pair in chosen if pair in inliers]
        shares = (
            len(chosen) / num_pairs,
            len(kept) / num_right,
            min(1.0, len(chosen) / num_right),
            sum(kept) / sum(inliers.values()),
        )
        rows.append((way, *(f"{value:.3f}" for value in shares), f"{seconds:.1f}"))
    print(f"{num_images} images, {num_right / num_pairs:.2f} of the pairs verify")
    print(table(HEADER, rows))


if __name__ == "__main__":
    main()
