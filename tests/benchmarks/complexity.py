"""Cost of rectification per image, as in the paper's complexity table, and its time.

For every recipe: area of all warps, keypoints, segments ("components"), warps per segment, and
the seconds of planning, warping (with what belongs to it: masks, carrying features back, choosing)
and features (detection and description). The last column is the time over that of the same
features on the photographs as they are, measured in the same rounds. The areas of the paper are
those of the warps alone; keypoints are all of an image. Usage:

    python tests/benchmarks/complexity.py --methods default dense-affnet --weights WEIGHTS

Recipes that need depth maps run on the image folders that have some. Of recipes with escalation
only the first level counts: the others depend on pairs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median

from machine import describe_machine

from colmap_affrect.comparison.methods import Method, parse_method
from colmap_affrect.evaluation.costs import ImageCost, extract_measured
from colmap_affrect.extraction import Resources, prepare
from colmap_affrect.options import ExtractionOptions, IdentityOptions

DEFAULT_METHODS = ["default", "affnet-shapes-recommended"]


@dataclass(frozen=True)
class ImageSet:
    """Some images of a folder.

    Attributes:
        name: name in the table.
        paths: the images.
        depth_path: folder of their depth maps, if any.
    """

    name: str
    paths: list[Path]
    depth_path: Path | None = None


def median_cost(costs: Sequence[ImageCost]) -> ImageCost:
    """Take medians over rounds."""
    keys = vars(costs[0])
    return ImageCost(**{key: median(getattr(cost, key) for cost in costs) for key in keys})


def baseline_of(options: ExtractionOptions) -> ExtractionOptions:
    """Return the options for the same features without rectification.

    They leave out all that has no effect without warps, so that recipes share a baseline.
    """
    features = replace(options.features, max_num_rectified_features=1)
    return ExtractionOptions(
        rectifier=IdentityOptions(),
        features=features,
        max_image_size_px=options.max_image_size_px,
    )


def image_sets(arguments: argparse.Namespace) -> list[ImageSet]:
    """List the images that the command line names, else some of three scenes."""
    if arguments.image_path:
        folders = [(arguments.image_path, arguments.depth_path)]
    else:
        scenes, svp = arguments.shared_path / "scenes", arguments.shared_path / "pairs/svp_sample"
        folders = [
            (scenes / "strecha_herz_jesus_p25" / "images", None),
            (scenes / "sceaux" / "images", None),
            (svp / "scene1" / "images", svp / "depth" / "mega_depth" / "scene1"),
        ]
    return [
        ImageSet(
            f"{folder.parent.name}/{folder.name}",
            chosen(sorted(folder.iterdir()), arguments.num_images),
            depth,
        )
        for folder, depth in folders
    ]


def chosen(paths: list[Path], count: int) -> list[Path]:
    """Take ``count`` of the paths, evenly spaced, or all if there are fewer."""
    return paths[:: max(1, len(paths) // count)][:count]


def table_row(method: str, costs: list[ImageCost], baseline: list[ImageCost]) -> str:
    """Format the costs of a method by round, and its ratio to the baseline by round."""
    cost = median_cost(costs)
    ratios = [mine.total_s / base.total_s for mine, base in zip(costs, baseline, strict=True)]
    warps = f"{cost.warps_per_region:.2f}" if cost.num_regions else "-"
    return (
        f"| {method} | {cost.area_mpx:.2f} | {cost.num_keypoints / 1000:.1f} "
        f"| {cost.num_regions:.2f} | {warps} | {cost.plan_s:.2f} | {cost.warp_s:.2f} "
        f"| {cost.detect_s + cost.describe_s:.2f} | {cost.total_s:.2f} "
        f"| {median(ratios):.2f} [{min(ratios):.2f}-{max(ratios):.2f}] |"
    )


def run_set(images: ImageSet, methods: list[Method], weights: Path | None, rounds: int) -> str:
    """Measure all methods on a set of images, round by round; return a Markdown table."""
    options: dict[str, ExtractionOptions] = {}
    baselines: dict[str, str] = {}
    for method in methods:
        extraction = method.recipe.extraction
        if any(rectifier.uses_depth for rectifier in extraction.rectifiers):
            if images.depth_path is None:
                continue
            depth = replace(extraction.depth, path=str(images.depth_path), model="")
            extraction = replace(extraction, depth=depth)
        base = baseline_of(extraction)
        known = [label for label in baselines.values() if options[label] == base]
        baselines[method.label] = known[0] if known else f"without warps: {method.label}"
        options |= {baselines[method.label]: base, method.label: extraction}
    extractors = {
        label: prepare(extraction, Resources(weights)) for label, extraction in options.items()
    }
    costs: dict[str, list[ImageCost]] = {label: [] for label in options}
    for _ in range(rounds):
        found: dict[str, list[ImageCost]] = {label: [] for label in options}
        for path in images.paths:
            for label, extractor in extractors.items():
                found[label].append(extract_measured(extractor, path)[1])
        for label, of_images in found.items():
            costs[label].append(ImageCost.mean(of_images))
    lines = [
        f"{images.name}: mean of {len(images.paths)} images, median of {rounds} rounds",
        "",
        "| recipe | area (Mpx) | keypoints (K) | regions | warps/region | plan (s) | warp (s)"
        " | features (s) | all (s) | ratio to no warps by round |",
        f"|---|{'--:|' * 9}",
    ]
    lines += [
        table_row(label, costs[label], costs[baselines.get(label, label)]) for label in options
    ]
    return "\n".join(lines) + "\n"


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    root = Path(__file__).resolve().parents[2]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--methods", nargs="+", default=DEFAULT_METHODS, help="[LABEL=]RECIPE[:KEY=VALUE[,...]]"
    )
    parser.add_argument("--image-path", type=Path, help="folder of images")
    parser.add_argument("--depth-path", type=Path, help="folder of their depth maps")
    parser.add_argument("--shared-path", type=Path, default=root.parent / "shared")
    parser.add_argument("--num-images", type=int, default=3, help="of each folder")
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    return parser.parse_args()


def main() -> None:
    """Print a table per folder of images."""
    arguments = parse_arguments()
    methods = [parse_method(text) for text in arguments.methods]
    print(describe_machine() + "\n")
    for images in image_sets(arguments):
        print(run_set(images, methods, arguments.weights, arguments.num_rounds), flush=True)


if __name__ == "__main__":
    main()
