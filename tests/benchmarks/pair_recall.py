"""How many of the pairs that verify are kept when only some are matched.

The output folders must be of runs that matched all pairs. For every share of all pairs, and every
way to choose them, the table has the share chosen, the recall (of the pairs that verify), the
largest recall that so many pairs can have, the share of all inliers kept, and the seconds of
choosing. Several folders are measured one by one and then as one set, in which no pair of images of
different folders is right. Usage:

    colmap-affrect run --image-path photos --output-path out
    python tests/benchmarks/pair_recall.py out
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.verification import verified_pairs
from colmap_affrect.data import LocalFeatures
from colmap_affrect.matchers.base import MatcherContext
from colmap_affrect.matchers.nearest import MatchableImage, NearestNeighbors, NearestOptions
from colmap_affrect.pairs.base import Pair
from colmap_affrect.pairs.lists import sequence_pairs
from colmap_affrect.pairs.retrieval import NUM_STRONGEST, low_resolution_pairs, retrieved_pairs
from colmap_affrect.progress import SILENT
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.one_pair import CachedMatcher, Matching


@dataclass(frozen=True)
class MatchedSet:
    """Images of which all pairs are matched, of one output folder or of several.

    Attributes:
        name: in the table.
        folder_of: the folder of each image, whose name is that of the folder and that within it.
        inliers: of the pairs that verify.
    """

    name: str
    folder_of: dict[str, Workspace]
    inliers: dict[Pair, int]


def read_set(path: Path) -> MatchedSet:
    """Read the pairs that verify in an output folder."""
    workspace = Workspace(path)
    verification = Context(workspace).verification
    folder_of = {f"{path.name}:{name}": workspace for name in Context(workspace).features.names()}
    with open_database(workspace.database) as database:
        names = {i.image_id: f"{path.name}:{i.name}" for i in database.read_all_images()}
    verified = verified_pairs(workspace.database, verification.min_num_inliers)
    inliers = {}
    for (id1, id2), count in verified.items():
        first, second = sorted((names[id1], names[id2]))
        inliers[first, second] = count
    return MatchedSet(path.name, folder_of, inliers)


def ways_to_choose(folder_of: dict[str, Workspace]) -> dict[str, Callable[[int], Sequence[Pair]]]:
    """Return the ways to choose pairs such that images have so many neighbours on average."""
    names, options = sorted(folder_of), NearestOptions()
    matcher = NearestNeighbors(options, MatcherContext())
    stores = {folder.path: Context(folder).features for folder in folder_of.values()}
    caches = {
        path: CachedMatcher(Matching(store, options, max_num_features=NUM_STRONGEST))
        for path, store in stores.items()
    }

    def read(name: str) -> LocalFeatures:
        return stores[folder_of[name].path].read(name.partition(":")[2])

    def strongest(name: str) -> MatchableImage:
        image: MatchableImage = (
            caches[folder_of[name].path].prepared(name.partition(":")[2]).content
        )
        return image

    def count(pair: Pair) -> int:
        return len(matcher.match(strongest(pair[0]), strongest(pair[1])).indices)

    def retrieved(num: int) -> list[Pair]:
        return retrieved_pairs(names, read, num, SILENT)

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


def measure(images: MatchedSet, shares: Sequence[float]) -> None:
    """Print the rows of one set."""
    num_images, num_right = len(images.folder_of), len(images.inliers)
    num_pairs = num_images * (num_images - 1) // 2
    ways = ways_to_choose(images.folder_of)
    for (way, choose), share in itertools.product(ways.items(), shares):
        start = time.perf_counter()
        chosen = choose(max(1, round(share * (num_images - 1))))
        seconds = time.perf_counter() - start
        kept = [images.inliers[pair] for pair in chosen if pair in images.inliers]
        print(
            f"| {images.name} | {num_images} | {num_right / num_pairs:.2f} | {way} "
            f"| {len(chosen) / num_pairs:.2f} | {len(kept) / num_right:.3f} "
            f"| {min(1.0, len(chosen) / num_right):.3f} "
            f"| {sum(kept) / sum(images.inliers.values()):.3f} | {seconds:.1f} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output_paths", type=Path, nargs="+", help="folders of finished runs")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.2, 0.3])
    arguments = parser.parse_args()
    sets = [read_set(path) for path in arguments.output_paths]
    if len(sets) > 1:
        folder_of = {name: folder for each in sets for name, folder in each.folder_of.items()}
        inliers = {pair: count for each in sets for pair, count in each.inliers.items()}
        sets.append(MatchedSet("all together", folder_of, inliers))
    print(
        "| photographs | images | verify | chosen by | chosen | recall | possible | inliers | s |"
        "\n|---|--:|--:|---|--:|--:|--:|--:|--:|"
    )
    for images in sets:
        if images.inliers:
            measure(images, arguments.shares)


if __name__ == "__main__":
    main()
