"""How cost grows: with the pixels of an image, the features of a pair, the number of images."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from itertools import combinations
from pathlib import Path
from statistics import mean, median

import numpy as np
from machine import one_core
from registration import link_images
from speed_measure import Method, Row, matching_variants, measure_commands, sift_options

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    image_ids,
    import_images,
    open_database,
    write_descriptors,
    write_keypoints,
)
from colmap_affrect.conventions import camera_matrix
from colmap_affrect.extraction import prepare
from colmap_affrect.imaging import read_gray, shrink_to
from colmap_affrect.matching.coarse import MakeCoarse
from colmap_affrect.matching.nearest import match_features, matchable
from colmap_affrect.options import CameraOptions
from colmap_affrect.recipes import load_recipe
from colmap_affrect.types import GrayImage, LocalFeatures, Photograph

SIZES_PX = (320, 640, 1280, 2400)
FEATURE_COUNTS = (1000, 2000, 4000, 8000, 16000)
NUM_MATCHED_IMAGES = 3
MANY_FEATURES = (
    "features.contrast_threshold=0.002",
    f"features.max_num_features={max(FEATURE_COUNTS)}",
)

Curve = list[tuple[float, float]]
"""Pairs of a size and core seconds."""


def growth_exponent(curve: Iterable[Sequence[float]]) -> float:
    """Return p of seconds ~ size^p, by least squares of logarithms."""
    sizes, seconds = np.log(np.array([point[:2] for point in curve], dtype=np.float64)).T
    return float(np.polyfit(sizes, seconds, 1)[0])


def mosaic(paths: Sequence[Path]) -> GrayImage:
    """Put four photographs side by side, cut to one size: more px than one has, with detail."""
    images = [read_gray(paths[index % len(paths)]) for index in range(4)]
    height, width = np.min([image.shape for image in images], axis=0)
    cut = [image[:height, :width] for image in images]
    return np.ascontiguousarray(np.block([cut[:2], cut[2:]]), dtype=np.uint8)


def pixel_growth(
    methods: Sequence[Method], paths: Sequence[Path], num_rounds: int
) -> dict[str, Curve]:
    """Extract the features of one picture at several sizes on one core.

    Returns:
        For each method (pixels, median core seconds) by size; without reading and writing.
    """
    full = mosaic(paths)
    sizes = [size for size in SIZES_PX if size <= max(full.shape)]
    pictures = [np.ascontiguousarray(shrink_to(full, size)) for size in sizes]
    extract = {method.name: _extraction(method) for method in methods}
    seconds: dict[str, list[list[float]]] = {name: [[] for _ in pictures] for name in extract}
    with one_core():
        for _ in range(num_rounds):
            for index, picture in enumerate(pictures):
                for name, function in extract.items():
                    start = time.process_time()
                    function(picture)
                    seconds[name][index].append(time.process_time() - start)
    return {
        name: [(p.size, median(s)) for p, s in zip(pictures, by_size, strict=True)]
        for name, by_size in seconds.items()
    }


def _extraction(method: Method) -> Callable[[GrayImage], object]:
    if method.is_sift:
        sift = pycolmap.Sift(sift_options(method.name), pycolmap.Device.cpu)
        return sift.extract
    extractor = method.extractor()

    def extract(image: GrayImage) -> LocalFeatures:
        camera = camera_matrix((image.shape[1], image.shape[0]))
        return extractor.execute(image, extractor.plan(Photograph(image, "", None, camera)))

    return extract


def feature_growth(paths: Sequence[Path], num_rounds: int) -> dict[str, Curve]:
    """Match the same RootSIFT features, the strongest of each image, by us and by COLMAP.

    One core; three images, of which each meets the others.

    Returns:
        For each matcher (mean number of features, median core seconds per pair).
    """
    paths = paths[:NUM_MATCHED_IMAGES]
    extractor = prepare(load_recipe("unrectified-rootsift", MANY_FEATURES).extraction)
    found = {path.name: extractor.extract_file(path).features for path in paths}
    variants = matching_variants()
    curves: dict[str, Curve] = {name: [] for name in ("COLMAP", *(f"ours{v}" for v in variants))}
    num_pairs = len(paths) * (len(paths) - 1) // 2
    with one_core(), tempfile.TemporaryDirectory() as scratch:
        link_images(list(paths), Path(scratch, "images"))
        most = max(len(features) for features in found.values())
        for count in (number for number in FEATURE_COUNTS if number <= most):
            strongest = {
                name: features.select(np.argsort(-features.responses, kind="stable")[:count])
                for name, features in found.items()
            }
            seconds: dict[str, list[float]] = {name: [] for name in curves}
            for number in range(num_rounds):
                database_path = Path(scratch, f"{count}-{number}.db")
                seconds["COLMAP"].append(_match_by_colmap(database_path, strongest) / num_pairs)
                for variant, make_coarse in variants.items():
                    ours = _match_by_us(list(strongest.values()), make_coarse)
                    seconds[f"ours{variant}"].append(ours / num_pairs)
            size = mean(len(features) for features in strongest.values())
            for name, values in seconds.items():
                curves[name].append((size, median(values)))
    return curves


def _match_by_us(images: Sequence[LocalFeatures], make_coarse: MakeCoarse | None) -> float:
    """Prepare images and match each with the others; return core seconds."""
    options = load_recipe("unrectified-rootsift").matching
    start = time.process_time()
    ready = [
        matchable(image.descriptors, image.keypoints, options, make_coarse) for image in images
    ]
    for first, second in combinations(ready, 2):
        match_features(first, second, options)
    return time.process_time() - start


def _match_by_colmap(database_path: Path, features: dict[str, LocalFeatures]) -> float:
    """Match each image with the others by COLMAP's default, not verified; return core seconds."""
    image_path = database_path.parent / "images"
    names = list(features)
    import_images(database_path, image_path, names, CameraOptions())
    ids = image_ids(database_path)
    with open_database(database_path) as database:
        for name, image in features.items():
            write_keypoints(database, ids[name], image.lafs)
            write_descriptors(database, ids[name], image.descriptors)
    list_path = database_path.with_suffix(".txt")
    list_path.write_text("".join(f"{a} {b}\n" for a, b in combinations(names, 2)))
    start = time.process_time()
    pycolmap.match_image_pairs(
        database_path,
        matching_options=pycolmap.FeatureMatchingOptions(
            skip_geometric_verification=True, num_threads=1
        ),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_path),
    )
    return time.process_time() - start


def image_growth(
    methods: Sequence[Method], paths: Sequence[Path], max_num_images: int
) -> dict[str, list[Row]]:
    """Run the whole commands on the first quarter, the first half and all of the images.

    Returns:
        For each method a row of :func:`speed_measure.measure_commands` for each number.
    """
    total = min(max_num_images, len(paths))
    counts = sorted({max(2, total // 4), max(2, total // 2), total})
    return {
        method.name: [measure_commands(method, paths[:count]) for count in counts]
        for method in methods
    }
