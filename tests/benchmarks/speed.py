"""Speed of feature extraction and matching next to COLMAP SIFT, in interleaved rounds.

Both write their results into a COLMAP database and use all cores; matching is measured without
geometric verification. Nothing is asserted: other load on the machine shows in the spread. Usage:

    python tests/benchmarks/speed.py --image-path ../shared/scenes/strecha_fountain_p11/images
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
from pathlib import Path
from statistics import median

from registration import compute_sift, link_images, match_recipe

from colmap_affrect.colmap import pycolmap
from colmap_affrect.executor import available_cores, peak_memory_bytes
from colmap_affrect.options import CameraOptions
from colmap_affrect.pipeline import installed_versions
from colmap_affrect.recipes import load_recipe

Seconds = list[dict[str, float]]


def peak_memory_mib() -> float:
    """Return the largest resident size that this process has had."""
    return peak_memory_bytes() / 2**20


def describe_machine() -> str:
    """Return processor, load and versions."""
    versions = ", ".join(f"{name} {version}" for name, version in installed_versions().items())
    load = f"{os.getloadavg()[0]:.1f}"
    return f"{platform.machine()}, {available_cores()} cores, load {load} at the start\n{versions}"


def comparison(stage: str, count: int, unit: str, sift: Seconds, ours: Seconds) -> str:
    """Format the medians of one stage, and the median and range of its ratios by round."""
    medians = [median(seconds[stage] for seconds in rounds) / count for rounds in (sift, ours)]
    ratios = [mine[stage] / theirs[stage] for theirs, mine in zip(sift, ours, strict=True)]
    return (
        f"| {stage} | {medians[0]:.3f} s/{unit} | {medians[1]:.3f} s/{unit} "
        f"| {median(ratios):.2f} [{min(ratios):.2f}-{max(ratios):.2f}] |"
    )


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--image-path", type=Path, required=True, help="folder of images")
    parser.add_argument("--num-images", type=int, default=4, help="use the first so many")
    parser.add_argument("--num-rounds", type=int, default=5)
    parser.add_argument("--recipe", default="default", help="name or TOML path")
    return parser.parse_args()


def main() -> None:
    """Run the rounds and print medians, ratios and peak memory."""
    arguments = parse_arguments()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    print(describe_machine() + "\n")
    recipe, cameras = load_recipe(arguments.recipe), CameraOptions()
    paths = sorted(arguments.image_path.iterdir())[: arguments.num_images]
    sift: Seconds = []
    ours: Seconds = []
    sift_peak = 0.0
    for _ in range(arguments.num_rounds):
        with tempfile.TemporaryDirectory() as scratch:
            image_path = Path(scratch) / "images"
            link_images(paths, image_path)
            sift.append(compute_sift(Path(scratch) / "sift.db", image_path, cameras, affine=False))
            sift_peak = sift_peak or peak_memory_mib()
            (Path(scratch) / "ours").mkdir()
            ours.append(match_recipe(Path(scratch) / "ours", image_path, cameras, recipe))
    num_pairs = len(paths) * (len(paths) - 1) // 2
    print(f"| stage | COLMAP SIFT | {arguments.recipe} | ratio by round |\n|---|--:|--:|--:|")
    print(comparison("extraction", len(paths), "image", sift, ours))
    print(comparison("matching", num_pairs, "pair", sift, ours))
    print(f"\npeak memory: {sift_peak:.0f} MiB after SIFT, {peak_memory_mib():.0f} MiB after both")


if __name__ == "__main__":
    main()
