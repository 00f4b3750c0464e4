"""Matches and homographies on real image pairs with known homographies.

A method is a recipe, by name or TOML path, with settings: ``[LABEL=]RECIPE[:KEY=VALUE[,...]]``.
Each image's features are computed once per method, and matched by the recipe's options. A match
is correct if its transfer error in image 2 is below 3 px. The error of a homography (OpenCV's
USAC_MAGSAC on all matches; the median of five orders of the matches) is its mean over what image 2
shows of image 1, in px of image 2.
Recipes with escalation go from level to level until COLMAP's geometric verification succeeds with
enough inliers, and keep the level with most of them, as a run of the two images does. Usage:

    python tests/benchmarks/pairs.py --methods default on-demand \
        asift=asift-recommended:features.profile=rootsift --output-path out/pairs.json

Prints Markdown tables of everything in the JSON file; rows of methods and pairs that are not run
this time are kept.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean, median_low
from typing import Any

import cv2
import numpy as np
from homographies import (
    CORRECT_PX,
    THRESHOLDS_PX,
    counts_below,
    homography_error,
    transfer_errors,
)
from numpy.typing import NDArray
from pair_data import SETS, HomographyPair, load_pairs

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.verification import two_view_options
from colmap_affrect.comparison.methods import Method, parse_method
from colmap_affrect.conventions import DEFAULT_FOCAL_RATIO, colmap_from_pixel
from colmap_affrect.escalation import open_pairs
from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.matching.nearest import MatchableImage, match_features, matchable
from colmap_affrect.options import VerificationOptions
from colmap_affrect.types import LocalFeatures, union

Row = dict[str, Any]
"""What was measured for one method on one pair."""
Size = tuple[int, int]

DEFAULT_METHODS = [
    "unrectified-rootsift",
    "default",
    "affnet-shapes-recommended",
    "asift-rootsift=asift-recommended:features.profile=rootsift",
    "on-demand",
]
CONFIDENCE = 0.9999
MAX_ITERATIONS = 100_000
NUM_ESTIMATES = 5
VERIFICATION_SEED = 0


@dataclass(frozen=True)
class TimedImage:
    """An image ready to be matched, with its (width, height) and the seconds its features took."""

    matchable: MatchableImage
    size: Size
    seconds: float


@dataclass
class FeatureCache:
    """The features of one method, computed once per image and level of escalation."""

    method: Method
    extractor: ImageExtractor
    levels: dict[Path, list[LocalFeatures]] = field(default_factory=dict)
    images: dict[tuple[Path, int], TimedImage] = field(default_factory=dict)

    def image(self, path: Path, level: int) -> TimedImage:
        """Return the features of the image itself and of a level, and the time of all levels."""
        if (path, level) not in self.images:
            before = self.image(path, level - 1).seconds if level else 0.0
            start = time.perf_counter()
            extracted = self.extractor.extract_file(path, level=level)
            seconds = before + time.perf_counter() - start
            parts = self.levels.setdefault(path, [])
            parts.append(extracted.features)
            features = union([parts[0], *parts[level:]]) if level else parts[0]
            ready = matchable(features.descriptors, features.keypoints, self.method.recipe.matching)
            self.images[path, level] = TimedImage(ready, extracted.image_size, seconds)
        return self.images[path, level]


@dataclass(frozen=True)
class Attempt:
    """The matches of a pair at one level.

    Attributes:
        level: of escalation, from 0.
        images: both, with their features.
        points: (N, 2) pixel-centre px of the matches in each image.
        verified_inliers: of COLMAP's two-view geometry; 0 if a run would not take it.
        seconds: of matching.
    """

    level: int
    images: tuple[TimedImage, TimedImage]
    points: tuple[NDArray[np.floating], NDArray[np.floating]]
    verified_inliers: int
    seconds: float


def attempt(pair: HomographyPair, cache: FeatureCache, level: int) -> Attempt:
    """Match and verify a pair by the features of the images themselves and of a level."""
    images = cache.image(pair.path1, level), cache.image(pair.path2, level)
    start = time.perf_counter()
    matches = match_features(
        images[0].matchable, images[1].matchable, cache.method.recipe.matching
    ).indices
    seconds = time.perf_counter() - start
    points = (
        images[0].matchable.keypoints[matches[:, 0]],
        images[1].matchable.keypoints[matches[:, 1]],
    )
    num_verified = verified_inliers(*points, images[0].size, images[1].size)
    return Attempt(level, images, points, num_verified, seconds)


def evaluate(pair: HomographyPair, cache: FeatureCache, threshold_px: float) -> Row:
    """Match a pair, level by level as a run would, and measure it against the truth."""
    options = cache.method.recipe.extraction
    rectifiers = options.rectifiers
    attempts: list[Attempt] = []
    for level in range(len(rectifiers)):
        attempts.append(attempt(pair, cache, level))
        best = max(attempts, key=lambda item: item.verified_inliers)
        counts = {("1", "2"): best.verified_inliers}
        if not open_pairs(counts, options.escalation_strong_num_inliers):
            break
    last = best if best.verified_inliers else attempts[-1]
    sizes = last.images[0].size, last.images[1].size
    estimates = [
        estimate_homography(*last.points, threshold_px, seed) for seed in range(NUM_ESTIMATES)
    ]
    errors_px = [
        math.inf if estimate is None else homography_error(estimate, pair.truth, *sizes)
        for estimate, _ in estimates
    ]
    finite_px = [error if math.isfinite(error) else None for error in sorted(errors_px)]
    return {
        "keypoints": [len(image.matchable.keypoints) for image in last.images],
        "matches": len(last.points[0]),
        "correct": int((transfer_errors(pair.truth, *last.points) < CORRECT_PX).sum()),
        "verified_inliers": last.verified_inliers,
        "level": rectifiers[last.level].name if last.verified_inliers else None,
        "inliers": median_low(num_inliers for _, num_inliers in estimates),
        "error_px": finite_px[NUM_ESTIMATES // 2],
        "errors_px": finite_px,
        "seconds": {
            "features": sum(image.seconds for image in last.images),
            "matching": sum(item.seconds for item in attempts),
        },
    }


def verified_inliers(
    points1: NDArray[np.floating], points2: NDArray[np.floating], size1: Size, size2: Size
) -> int:
    """Return the inliers of COLMAP's two-view geometry; 0 if a run would not take it.

    Args:
        points1: (N, 2) pixel-centre px of image 1.
        points2: (N, 2) those of image 2 that match them.
        size1: (width, height) of image 1 in px.
        size2: (width, height) of image 2 in px.
    """
    options = VerificationOptions()
    geometry = pycolmap.estimate_two_view_geometry(
        unknown_camera(1, size1),
        colmap_from_pixel(points1),
        unknown_camera(2, size2),
        colmap_from_pixel(points2),
        np.stack([np.arange(len(points1))] * 2, axis=1),
        two_view_options(options, VERIFICATION_SEED),
    )
    kinds = pycolmap.TwoViewGeometryConfiguration
    if geometry.config in (kinds.UNDEFINED, kinds.DEGENERATE):
        return 0
    count = len(geometry.inlier_matches)
    return count if count >= options.min_num_inliers else 0


def unknown_camera(camera_id: int, size: Size) -> pycolmap.Camera:
    """Return what COLMAP assumes of an image without EXIF: a camera of its own, of unknown focus.

    The id matters: two images of one camera are verified in another way.
    """
    focal_px = DEFAULT_FOCAL_RATIO * max(size)
    return pycolmap.Camera.create_from_model_name(camera_id, "SIMPLE_RADIAL", focal_px, *size)


def estimate_homography(
    points1: NDArray[np.floating], points2: NDArray[np.floating], threshold_px: float, seed: int
) -> tuple[NDArray[np.float64] | None, int]:
    """Estimate a (3, 3) homography from (N, 2) matches; also return the number of inliers.

    OpenCV draws the same samples every time, so the seed decides the order of the matches.
    """
    if len(points1) < 4:
        return None, 0
    order = np.random.default_rng(seed).permutation(len(points1))
    estimate, inliers = cv2.findHomography(
        points1[order],
        points2[order],
        cv2.USAC_MAGSAC,
        threshold_px,
        maxIters=MAX_ITERATIONS,
        confidence=CONFIDENCE,
    )
    found = None if estimate is None else np.asarray(estimate, dtype=np.float64)
    return found, int(np.count_nonzero(inliers))


def table(set_name: str, rows: list[Row]) -> str:
    """Format correct matches and homography errors of one set as a Markdown table."""
    pairs = list(dict.fromkeys(row["pair"] for row in rows))
    thresholds = " | ".join(f"< {threshold:g}" for threshold in THRESHOLDS_PX)
    lines = [
        f"{set_name}: correct matches (px error of the homography), number of pairs below an error",
        "",
        f"| method | {' | '.join(pairs)} | {thresholds} | s/pair |",
        f"|---|{'--:|' * (len(pairs) + len(THRESHOLDS_PX) + 1)}",
    ]
    for method in dict.fromkeys(row["method"] for row in rows):
        found = {row["pair"]: row for row in rows if row["method"] == method}
        cells = [cell(found[pair]) if pair in found else "" for pair in pairs]
        counts = map(str, counts_below(row["error_px"] for row in found.values()))
        seconds = fmean(sum(row["seconds"].values()) for row in found.values())
        lines.append(f"| {method} | {' | '.join(cells)} | {' | '.join(counts)} | {seconds:.1f} |")
    return "\n".join(lines) + "\n"


def cell(row: Row) -> str:
    """Format one pair: correct matches, error, and the level if the recipe has several."""
    error = row["error_px"]
    text = f"{row['correct']} ({'-' if error is None else f'{error:.1f}'})"
    return f"{text} {row['level'] or 'none'}" if row["escalating"] else text


def merge(rows: list[Row], new: Row) -> list[Row]:
    """Put a row in the place of the one of the same set, pair and method, or at the end."""
    key = ("set", "pair", "method")
    same = [index for index, row in enumerate(rows) if all(row[k] == new[k] for k in key)]
    if not same:
        return [*rows, new]
    return [*rows[: same[0]], new, *rows[same[0] + 1 :]]


def parse_arguments() -> argparse.Namespace:
    """Parse the command line."""
    root = Path(__file__).resolve().parents[2]
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--methods", nargs="+", default=DEFAULT_METHODS, metavar="METHOD")
    parser.add_argument("--sets", nargs="+", choices=SETS, default=SETS, metavar="SET")
    parser.add_argument("--pairs-path", type=Path, default=root.parent / "shared" / "pairs")
    parser.add_argument("--weights", type=Path, help="folder of the networks' weights")
    parser.add_argument(
        "--threshold-px", type=float, default=5.0, help="USAC_MAGSAC's largest noise"
    )
    parser.add_argument("--output-path", type=Path, required=True, help="JSON file")
    return parser.parse_args()


def main() -> None:
    """Run all methods on all sets."""
    arguments = parse_arguments()
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    output_path = arguments.output_path
    rows = json.loads(output_path.read_text()) if output_path.exists() else []
    for method in map(parse_method, arguments.methods):
        extractor = prepare(method.recipe.extraction, Resources(arguments.weights))
        for set_name in arguments.sets:
            cache = FeatureCache(method, extractor)
            for pair in load_pairs(arguments.pairs_path, set_name):
                key = {"set": set_name, "pair": pair.name, "method": method.label}
                kind = {"escalating": bool(method.recipe.extraction.escalation)}
                row = key | kind | evaluate(pair, cache, arguments.threshold_px)
                print(json.dumps(row), file=sys.stderr, flush=True)
                rows = merge(rows, row)
                output_path.write_text(json.dumps(rows, indent=1) + "\n")
    for set_name in SETS:
        if found := [row for row in rows if row["set"] == set_name]:
            print(table(set_name, found))


if __name__ == "__main__":
    main()
