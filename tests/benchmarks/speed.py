"""Speed beside COLMAP's SIFT: extraction and matching by the whole commands, on all cores.

All methods run on the same photographs in one process, in turn, in several rounds. Prints a
table, and writes all numbers as JSON. Other load on the machine shows in the ranges. Usage:

    python tests/benchmarks/speed.py --image-path ../shared/scenes/strecha_fountain_p11/images \
        --output-path out/speed.json
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np
from machine import describe_machine, parser_of, span, table

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import open_database
from colmap_affrect.colmap.database_verification import verified_pairs, verify
from colmap_affrect.colmap.image_import import import_images
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.comparison.method_run import extract_sift, match_sift
from colmap_affrect.comparison.methods import SIFT, Method, parse_method
from colmap_affrect.images.photographs import CameraOptions, MaskOptions
from colmap_affrect.pipeline import RunOptions, run
from colmap_affrect.recipes import Recipe
from colmap_affrect.session.context import Resources

Row = dict[str, float]

DEFAULT_METHODS = [SIFT, "unrectified-rootsift", "rectified"]
VERIFICATION = VerificationOptions(random_seed=0)
HEADER = (
    "method", "extraction per image", "ratio", "matching per pair", "ratio", "features per image",
    "inliers per pair",
)  # fmt: skip


def run_commands(method: Method, paths: Sequence[Path], resources: Resources) -> Row:
    """Extract, match and verify images by the whole commands, and map those of a recipe.

    Returns:
        Seconds of each stage as ``extract_s``, ``match_s``, ``verify_s``, ``map_s``; numbers of
        ``images``, ``pairs``, ``features``, ``inliers`` (of all verified pairs).
    """
    image_path = paths[0].parent
    names = [path.name for path in paths]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "out"
        folder.mkdir()
        if method.recipe is None:
            row = run_sift(folder, image_path, names)
        else:
            row = run_recipe(folder, image_path, names, method.recipe, resources)
        inliers = verified_pairs(folder / "database.db", VERIFICATION.min_num_inliers)
        with open_database(folder / "database.db") as database:
            row["features"] = database.num_keypoints()
    pairs = len(names) * (len(names) - 1) // 2
    return {
        **row,
        "images": len(names),
        "pairs": pairs,
        "inliers": sum(inliers.values()),
    }


def run_sift(folder: Path, image_path: Path, names: Sequence[str]) -> Row:
    """Run COLMAP's SIFT up to verification; return seconds."""
    database_path = folder / "database.db"
    import_images(database_path, image_path, list(names), CameraOptions())
    times = [time.perf_counter()]
    extract_sift(database_path, image_path, names, MaskOptions())
    times.append(time.perf_counter())
    match_sift(database_path, None)
    times.append(time.perf_counter())
    verify(database_path, VERIFICATION)
    times.append(time.perf_counter())
    return dict(
        zip(("extract_s", "match_s", "verify_s"), np.diff(times).tolist(), strict=True)
    )


def run_recipe(
    folder: Path,
    image_path: Path,
    names: Sequence[str],
    recipe: Recipe,
    resources: Resources,
) -> Row:
    """Run a recipe; return seconds."""
    listed = folder.with_name("names.txt")
    listed.write_text("\n".join(names) + "\n", encoding="utf-8")
    options = RunOptions(
        recipe=recipe,
        image_list_path=listed,
        resources=resources,
        verification=VERIFICATION,
    )
    report = run(image_path, folder, options)
    row: Row = {f"{stage.name}_s": stage.wall_s for stage in report.stages}
    row["match_s"] += row.pop("escalate_s", 0.0)
    return row


def table_of(results: dict[str, list[Row]]) -> str:
    """Compare the whole commands; the first method is the reference of the ratios."""

    def each(rounds: Sequence[Row], key: str, unit: str) -> np.ndarray:
        return np.array([row[key] / row[unit] for row in rounds])

    reference = next(iter(results.values()))
    rows = []
    for name, rounds in results.items():
        cells = [name]
        for key, unit in (("extract_s", "images"), ("match_s", "pairs")):
            seconds = each(rounds, key, unit)
            cells += [
                f"{median(seconds):.3g} s",
                span(seconds / each(reference, key, unit), 2),
            ]
        for key, unit in (("features", "images"), ("inliers", "pairs")):
            cells.append(f"{median(each(rounds, key, unit)):.0f}")
        rows.append(cells)
    return (
        f"Whole commands on all cores: {reference[0]['images']:.0f} images, {len(reference)} "
        "rounds in turn. Medians; mean [range] of the ratio to the first method in the same "
        f"round.\n\n{table(HEADER, rows)}"
    )


def main() -> None:
    """Run the methods in turn and print the table."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--image-path", type=Path, required=True, help="folder of images"
    )
    parser.add_argument("--num-images", type=int, default=4, help="the first so many")
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument(
        "--methods", nargs="+", default=DEFAULT_METHODS, metavar="METHOD",
        help=f"{SIFT} or [LABEL=]RECIPE[:KEY=VALUE[,...]]; the first is the reference",
    )  # fmt: skip
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    arguments = parser.parse_args()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    paths = sorted(arguments.image_path.iterdir())[: arguments.num_images]
    methods = [parse_method(text) for text in arguments.methods]
    resources = Resources(weights_path=arguments.weights)
    commands: dict[str, list[Row]] = {method.label: [] for method in methods}
    for _ in range(arguments.num_rounds):
        for method in methods:
            commands[method.label].append(run_commands(method, paths, resources))
    results = {"machine": describe_machine(), "commands": commands}
    arguments.output_path.write_text(json.dumps(results, indent=1) + "\n")
    print(f"{results['machine']}\n\n{table_of(commands)}")


if __name__ == "__main__":
    main()
