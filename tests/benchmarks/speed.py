"""Speed beside COLMAP's SIFT: extraction and matching by the whole commands, on all cores.

All methods run on the same photographs in one process, in turn, in several rounds. Prints a
table, and writes all numbers as JSON. Other load on the machine shows in the ranges. Usage:

    python tests/benchmarks/speed.py --image-path ../shared/scenes/strecha_fountain_p11/images \
        --output-path out/speed.json
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from machine import describe_machine, table

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.initial_cameras import import_images
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.comparison.methods import SIFT, SIFT_AFFINE_DSP, Method, parse_method
from colmap_affrect.comparison.sift import extract_sift, match_sift
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.pairs.lists import exhaustive_pairs
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Resources

Row = dict[str, float]

DEFAULT_METHODS = [SIFT, SIFT_AFFINE_DSP, "unrectified-rootsift", "default"]
SEED = 0


def run_commands(method: Method, paths: Sequence[Path], resources: Resources) -> Row:
    """Extract, match and verify images by the whole commands, and map those of a recipe.

    Returns:
        Seconds of each stage as ``extract_s``, ``match_s``, ``verify_s``, ``map_s``; numbers of
        ``images``, ``pairs``, ``features``, ``inliers`` (of all verified pairs), ``registered``
        (in the largest model); sizes of the files as ``features_bytes``, ``matches_bytes``,
        ``database_bytes``.
    """
    image_path, names = paths[0].parent, [path.name for path in paths]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "out"
        folder.mkdir()
        if method.recipe is None:
            row = run_sift(folder, image_path, names, affine=method.label == SIFT_AFFINE_DSP)
        else:
            row = run_recipe(folder, image_path, names, method.recipe, resources)
        database_path = folder / "database.db"
        inliers = verified_pairs(database_path, VerificationOptions().min_num_inliers)
        with open_database(database_path) as database:
            num_features = database.num_keypoints()
        sizes = {
            f"{path.stem}_bytes": path.stat().st_size
            for path in (folder / "features.h5", folder / "matches.h5", database_path)
            if path.exists()
        }
    return {
        **row,
        **sizes,
        "images": len(names),
        "pairs": len(names) * (len(names) - 1) // 2,
        "features": num_features,
        "inliers": sum(inliers.values()),
    }


def run_sift(folder: Path, image_path: Path, names: Sequence[str], *, affine: bool) -> Row:
    """Run COLMAP's SIFT up to verification; return seconds."""
    database_path = folder / "database.db"
    import_images(database_path, image_path, list(names), CameraOptions())
    times = [time.perf_counter()]
    extract_sift(database_path, image_path, names, MaskOptions(), affine=affine)
    times.append(time.perf_counter())
    match_sift(database_path, exhaustive_pairs(names))
    times.append(time.perf_counter())
    verify(database_path, VerificationOptions(random_seed=SEED))
    times.append(time.perf_counter())
    return dict(zip(("extract_s", "match_s", "verify_s"), np.diff(times).tolist(), strict=True))


def run_recipe(
    folder: Path, image_path: Path, names: Sequence[str], recipe: Recipe, resources: Resources
) -> Row:
    """Run a recipe; return seconds, and the number of images registered."""
    list_path = folder.with_name("names.txt")
    list_path.write_text("\n".join(names) + "\n", encoding="utf-8")
    options = RunOptions(
        recipe=recipe,
        image_list_path=list_path,
        resources=resources,
        verification=VerificationOptions(random_seed=SEED),
        mapping=SparseOptions(random_seed=SEED),
    )
    report = run(image_path, folder, options)
    row: Row = {f"{stage.name}_s": stage.wall_s for stage in report.stages}
    row["match_s"] += row.pop("escalate_s", 0.0)
    return {**row, "registered": len(report.registered_names)}


def with_ratio(values: Sequence[float], references: Sequence[float]) -> str:
    """Format the median over rounds, and median and range of the ratios by round.

    >>> with_ratio([3.0, 8.0, 2.0], [1.0, 4.0, 4.0])
    '3 s, 2.00 [0.50-3.00]'
    """
    ratios = [mine / other for mine, other in zip(values, references, strict=True)]
    spread = f"{median(ratios):.2f} [{min(ratios):.2f}-{max(ratios):.2f}]"
    return f"{median(values):.3g} s, {spread}"


def commands_table(results: dict[str, list[Row]]) -> str:
    """Compare the whole commands; the first method is the reference of the ratios."""

    def each(rounds: Iterable[Row], key: str, unit: str) -> list[float]:
        return [row[key] / row[unit] for row in rounds]

    reference = next(iter(results.values()))
    rows = [
        (
            name,
            with_ratio(each(rounds, "extract_s", "images"), each(reference, "extract_s", "images")),
            with_ratio(each(rounds, "match_s", "pairs"), each(reference, "match_s", "pairs")),
            f"{median(each(rounds, 'features', 'images')):.0f}",
            f"{median(each(rounds, 'inliers', 'pairs')):.0f}",
        )
        for name, rounds in results.items()
    ]
    header = (
        "method", "extraction per image", "matching per pair", "features per image",
        "inliers per pair",
    )  # fmt: skip
    return (
        f"Whole commands on all cores: {reference[0]['images']:.0f} images, {len(reference)} "
        "rounds in turn. Median, then median [range] of the ratio to the first method in the same "
        "round.\n\n" + table(header, rows)
    )


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--image-path", type=Path, required=True, help="folder of images")
    parser.add_argument("--num-images", type=int, default=4, help="the first so many")
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument(
        "--methods", nargs="+", default=DEFAULT_METHODS, metavar="METHOD",
        help=f"{SIFT}, {SIFT_AFFINE_DSP} or [LABEL=]RECIPE[:KEY=VALUE[,...]]; the first is the "
        "reference",
    )  # fmt: skip
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    return parser.parse_args()


def main() -> None:
    """Run the methods in turn and print the table."""
    arguments = parse_arguments()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    output_path, rounds = arguments.output_path, range(arguments.num_rounds)
    paths = sorted(arguments.image_path.iterdir())[: arguments.num_images]
    methods = [parse_method(text) for text in arguments.methods]
    resources = Resources(arguments.weights)
    rows = [[run_commands(method, paths, resources) for method in methods] for _ in rounds]
    by_method = zip(methods, zip(*rows, strict=True), strict=True)
    commands = {method.label: list(each) for method, each in by_method}
    results = {"machine": describe_machine(), "commands": commands}
    output_path.write_text(json.dumps(results, indent=1) + "\n")
    print(f"{results['machine']}\n\n{commands_table(commands)}")


if __name__ == "__main__":
    main()
