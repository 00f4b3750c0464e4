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
from colmap_affrect.matching.nearest import MatchableImage
from colmap_affrect.matching.pairs import Pair, sequence_pairs
from colmap_affrect.options import MatchingOptions
from colmap_affrect.pair_selection import NUM_STRONGEST, low_resolution_pairs, retrieved_pairs
from colmap_affrect.pair_tasks import MatchableCache
from colmap_affrect.progress import SILENT
from colmap_affrect.stages import feature_store
from colmap_affrect.types import LocalFeatures
from colmap_affrect.workspace import Workspace

Choose = Callable[[int], Sequence[Pair]]
"""Choose pairs such that images have so many neighbours on average."""


@dataclass(frozen=True)
class MatchedSet:
    """Images of which all pairs are matched, of one output folder or of several.

    Attributes:
        name: in the table.
        folder_of: the folder of each image.
        inliers: of the pairs that verify.
    """

    name: str
    folder_of: dict[str, Workspace]
    inliers: dict[Pair, int]

    @property
    def names(self) -> list[str]:
        """Names of the images: that of the folder and that within it."""
        return sorted(self.folder_of)

    def ways(self) -> dict[str, Choose]:
        """Return the ways to choose pairs."""
        stores = {folder.path: feature_store(folder) for folder in self.folder_of.values()}
        options = MatchingOptions()
        caches = {
            path: MatchableCache(store, options, 0, NUM_STRONGEST) for path, store in stores.items()
        }

        def found(name: str) -> tuple[Path, str]:
            return self.folder_of[name].path, name.partition(":")[2]

        def read(name: str) -> LocalFeatures:
            path, inner = found(name)
            return stores[path].read(inner)

        def strongest(name: str) -> MatchableImage:
            path, inner = found(name)
            return caches[path][inner][0]

        def retrieved(num: int) -> list[Pair]:
            return retrieved_pairs(self.names, read, num, SILENT)

        def low_resolution(num: int) -> list[Pair]:
            return low_resolution_pairs(self.names, strongest, options, num, SILENT)

        def either(num: int) -> list[Pair]:
            half = -(-num // 2)
            return sorted({*retrieved(half), *low_resolution(half)})

        return {
            "retrieval": retrieved,
            "low-resolution": low_resolution,
            "either of both": either,
            "sequence": lambda num: sequence_pairs(self.names, -(-num // 2)),
        }


def read_set(path: Path) -> MatchedSet:
    """Read the pairs that verify in an output folder."""
    workspace = Workspace(path)
    verification, _ = workspace.verification_options()
    folder_of = {f"{path.name}:{name}": workspace for name in feature_store(workspace).names()}
    inliers = {}
    with open_database(workspace.database) as database:
        names = {i.image_id: f"{path.name}:{i.name}" for i in database.read_all_images()}
        for pair in verified_pairs(workspace.database, verification.min_num_inliers):
            first, second = sorted(names[image_id] for image_id in pair)
            geometry = database.read_two_view_geometry(*pair)
            inliers[first, second] = len(geometry.inlier_matches)
    return MatchedSet(path.name, folder_of, inliers)


def join(sets: Sequence[MatchedSet]) -> MatchedSet:
    """Make one set of several."""
    folder_of = {name: folder for each in sets for name, folder in each.folder_of.items()}
    inliers = {pair: count for each in sets for pair, count in each.inliers.items()}
    return MatchedSet("all together", folder_of, inliers)


def measure(images: MatchedSet, shares: Sequence[float]) -> None:
    """Print the rows of one set."""
    num_images, num_right = len(images.names), len(images.inliers)
    num_pairs = num_images * (num_images - 1) // 2
    for (way, choose), share in itertools.product(images.ways().items(), shares):
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


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("output_paths", type=Path, nargs="+", help="folders of finished runs")
    parser.add_argument("--shares", type=float, nargs="+", default=[0.1, 0.2, 0.3])
    return parser.parse_args()


def main() -> None:
    """Print the table."""
    arguments = parse_arguments()
    sets = [read_set(path) for path in arguments.output_paths]
    print(
        "| photographs | images | verify | chosen by | chosen | recall | possible | inliers | s |"
        "\n|---|--:|--:|---|--:|--:|--:|--:|--:|"
    )
    for images in [*sets, join(sets)] if len(sets) > 1 else sets:
        if images.inliers:
            measure(images, arguments.shares)


if __name__ == "__main__":
    main()
