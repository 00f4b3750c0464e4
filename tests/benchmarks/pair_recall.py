"""How many of the pairs that verify are kept when only some are matched.

The output folder must be of a run that matched all pairs. For every share of all pairs, and every
way to choose them, the table has the share chosen, the recall (of the pairs that verify), the
largest recall that so many pairs can have, the share of all inliers kept, and the seconds of
choosing. Usage:

    colmap-affrect run --image-path photos --output-path out
    python tests/benchmarks/pair_recall.py out
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from machine import parser_of, table

from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.database_verification import verified_pairs
from colmap_affrect.pairs.lists import Pair, sequence_pairs
from colmap_affrect.pairs.retrieval import retrieved_pairs
from colmap_affrect.progress import SILENT
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Context

HEADER = ("chosen by", "chosen", "recall", "possible", "inliers", "s")


def ways_to_choose(
    features: FeatureStore,
) -> dict[str, Callable[[int], Sequence[Pair]]]:
    """Return the ways to choose pairs such that images have so many neighbours on average."""
    names = sorted(features.names())
    return {
        "retrieval": lambda num: retrieved_pairs(names, features.read, num, SILENT),
        "sequence": lambda num: sequence_pairs(names, -(-num // 2)),
    }


def main() -> None:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("output_path", type=Path, help="folder of a finished run")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.2, 0.3])
    arguments = parser.parse_args()
    context = Context(Workspace(arguments.output_path))
    features = context.features
    database_path = context.workspace.database
    names = {image_id: name for name, image_id in image_ids(database_path).items()}
    verified = verified_pairs(database_path, context.verification.min_num_inliers)
    inliers = {tuple(sorted((names[a], names[b]))): n for (a, b), n in verified.items()}
    num_images = len(features.names())
    num_right = len(inliers)
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
