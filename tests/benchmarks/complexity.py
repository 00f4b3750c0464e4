"""Cost of rectification per image, as in the paper's complexity table, and its time.

For every recipe: area of all warps, keypoints, segments ("components"), warps per segment, and
the seconds of extraction without reading. The last column is the time over that of the same
features on the photographs as they are, measured in the same rounds. The areas of the paper are
those of the warps alone; keypoints are all of an image. Usage:

    python tests/benchmarks/complexity.py --image-path PHOTOS --methods default dense-affnet \
        --weights WEIGHTS

Of recipes with escalation only the first level counts: the others depend on pairs.
"""

from __future__ import annotations

from pathlib import Path
from statistics import median

import numpy as np
from machine import describe_machine, parser_of, span, table

from colmap_affrect.comparison.methods import parse_method
from colmap_affrect.images.photographs import list_images
from colmap_affrect.recipes import ExtractionOptions
from colmap_affrect.rectifiers.affine_warps import IdentityOptions
from colmap_affrect.report.inspection import inspect_level
from colmap_affrect.session.context import Resources
from colmap_affrect.stages.one_image import ImageExtractor, prepare

HEADER = (
    "recipe", "warped area (Mpx)", "keypoints (K)", "regions", "warps per region", "seconds",
    "ratio",
)  # fmt: skip


def without_warps(options: ExtractionOptions) -> ExtractionOptions:
    """Return the options for the same features without rectification."""
    return ExtractionOptions(
        rectifier=IdentityOptions(),
        features=options.features.changed(max_num_rectified_features=1),
        max_image_size_px=options.max_image_size_px,
    )


def cost(extractor: ImageExtractor, path: Path) -> np.ndarray:
    """Return megapixels of warps, keypoints, regions, warps, and seconds without reading."""
    photograph, _ = extractor.photograph(path)
    level = inspect_level(extractor, photograph, 0)
    area_mpx = level.plan.rectified_area_px / 1_000_000
    regions = {item.segment_id for item in level.plan.items}
    counts = len(level.features), len(regions), len(level.plan.items)
    return np.array([area_mpx, *counts, level.seconds])


def table_row(label: str, costs: np.ndarray) -> list[str]:
    """Format the costs (rounds, 2, 5) of a method, with warps and without."""
    area_mpx, keypoints, regions, warps, _ = costs[0, 0]
    return [
        label,
        f"{area_mpx:.1f}",
        f"{keypoints / 1000:.1f}",
        f"{regions:.1f}",
        f"{warps / regions:.1f}" if regions else "-",
        f"{median(costs[:, 0, 4]):.1f}",
        span(costs[:, 0, 4] / costs[:, 1, 4], 1),
    ]


def main() -> None:
    """Print the table: means over images, of the seconds the median over rounds."""
    parser = parser_of(__doc__)
    parser.add_argument(
        "--methods", nargs="+", default=["rectified", "second-moment-shapes"],
        help="[LABEL=]RECIPE[:KEY=VALUE[,...]]",
    )  # fmt: skip
    parser.add_argument(
        "--image-path", type=Path, required=True, help="folder of images"
    )
    parser.add_argument("--depth-path", type=Path, help="folder of their depth maps")
    parser.add_argument("--num-images", type=int, default=2, help="evenly spaced")
    parser.add_argument("--num-rounds", type=int, default=3)
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    arguments = parser.parse_args()
    depth = [f"depth.path={arguments.depth_path}"] if arguments.depth_path else []
    every = [arguments.image_path / name for name in list_images(arguments.image_path)]
    paths = every[:: max(1, len(every) // arguments.num_images)][: arguments.num_images]
    extractors = {}
    for text in arguments.methods:
        extraction = parse_method(text, depth).recipe.extraction
        both = extraction, without_warps(extraction)
        extractors[text] = [
            prepare(options, Resources(weights_path=arguments.weights))
            for options in both
        ]
    rounds = [
        [
            [np.mean([cost(way, path) for path in paths], axis=0) for way in both]
            for both in extractors.values()
        ]
        for _ in range(arguments.num_rounds)
    ]
    costs = np.array(rounds).swapaxes(0, 1)
    rows = [table_row(text, each) for text, each in zip(extractors, costs, strict=True)]
    print(f"{describe_machine()}\n\n{table(HEADER, rows)}")


if __name__ == "__main__":
    main()
