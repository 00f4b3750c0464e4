"""Core seconds for speed.py: of the stages of extraction, by pixels, by features."""

from __future__ import annotations

import pkgutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import combinations
from pathlib import Path
from statistics import mean, median
from typing import Any
from unittest import mock

import numpy as np
from machine import one_core

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    image_ids,
    open_database,
    write_descriptors,
    write_keypoints,
)
from colmap_affrect.colmap.initial_cameras import import_images
from colmap_affrect.comparison.methods import SIFT, Method
from colmap_affrect.comparison.sift import extraction_options
from colmap_affrect.conventions import camera_matrix
from colmap_affrect.data import GrayImage, LocalFeatures, Photograph
from colmap_affrect.features.sift import DogOptions, RootSift, make_sift
from colmap_affrect.images.photographs import CameraOptions
from colmap_affrect.images.reading import read_gray, shrink_to
from colmap_affrect.matchers.nearest import match_features, matchable
from colmap_affrect.matchers.nearest_8bit import coarse_descriptors
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.recipes import load_recipe
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.one_image import prepare

Curve = list[tuple[float, float]]
"""Pairs of a size and core seconds."""

SIZES_PX = (320, 640, 1280, 2400)
FEATURE_COUNTS = (1000, 2000, 4000, 8000, 16000)
NUM_MATCHED_IMAGES = 3
MANY_FEATURES = (
    "features.contrast_threshold=0.002",
    f"features.max_num_features={max(FEATURE_COUNTS)}",
)

STAGES = {
    "colmap_affrect.stages.one_image.decode": "reading",
    "colmap_affrect.stages.one_image.shrink_to": "reading",
    "colmap_affrect.features.shapes.second_moment.SecondMoment.grid": "shapes",
    "colmap_affrect.stages.one_image.ImageExtractor.plan": "cover",
    "colmap_affrect.rectifiers.execute.warp": "warps",
    "colmap_affrect.rectifiers.execute.warp_mask": "warps",
    "colmap_affrect.features.sift.RootSift.detect": "detector",
    "colmap_affrect.stages.one_image.extract_rectified": "de-duplication",
}
"""What each function does apart from the others of this list that it calls."""


class StageClock:
    """Adds up core seconds by stage, each without those of the stages inside of it."""

    def __init__(self) -> None:
        """Start with nothing."""
        self.seconds: dict[str, float] = defaultdict(float)
        self._inside = [0.0]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Take the time of a block, or of each call of a decorated function."""
        start = time.process_time()
        self._inside.append(0.0)
        try:
            yield
        finally:
            elapsed = time.process_time() - start
            self.seconds[name] += elapsed - self._inside.pop()
            self._inside[-1] += elapsed

    @contextmanager
    def watching(self, functions: dict[str, str]) -> Iterator[None]:
        """Take the time of functions, by their dotted names, while the block runs."""
        with ExitStack() as stack:
            for target, name in functions.items():
                timed = self.stage(name)(pkgutil.resolve_name(target))
                stack.enter_context(mock.patch(target, timed))
            yield


class OnlyDetecting:
    """OpenCV's SIFT without its descriptors, which are all ones."""

    def __init__(self, options: DogOptions) -> None:
        """Make the detector."""
        self.sift = make_sift(options)

    def detectAndCompute(self, image: Any, mask: Any) -> tuple[Any, Any]:
        """Detect, as OpenCV's class does."""
        keypoints = self.sift.detect(image, mask)
        return keypoints, np.ones((len(keypoints), RootSift.descriptor_size), np.uint8)


def stage_seconds(method: Method, paths: Sequence[Path]) -> dict[str, float]:
    """Return the core seconds per image of the stages of extraction by a recipe with RootSIFT.

    OpenCV detects and describes in one call: descriptors are what the same images take less
    without them.
    """
    assert method.recipe is not None
    extractor = prepare(method.recipe.extraction)
    clock, without = StageClock(), StageClock()
    with one_core(), tempfile.TemporaryDirectory() as scratch:
        store = FeatureStore(Path(scratch, "features.h5"))
        for path in paths:
            with clock.watching(STAGES), clock.stage("other"):
                found = extractor.extract_file(path)
            with clock.stage("writing"):
                store.write(path.name, found.features, found.image_size)
            with (
                mock.patch("colmap_affrect.features.sift.make_sift", OnlyDetecting),
                without.watching(STAGES),
            ):
                extractor.extract_file(path)
    clock.seconds["descriptor"] = clock.seconds["detector"] - without.seconds["detector"]
    clock.seconds["detector"] = without.seconds["detector"]
    return {stage: seconds / len(paths) for stage, seconds in clock.seconds.items()}


def mosaic(paths: Sequence[Path]) -> GrayImage:
    """Put four photographs side by side, cut to one size: more px than one has, with detail."""
    images = [read_gray(paths[index % len(paths)]) for index in range(4)]
    height, width = np.min([image.shape for image in images], axis=0)
    cut = [image[:height, :width] for image in images]
    return np.ascontiguousarray(np.block([cut[:2], cut[2:]]), dtype=np.uint8)


def pixel_growth(
    methods: Sequence[Method], paths: Sequence[Path], num_rounds: int, resources: Resources
) -> dict[str, Curve]:
    """Extract the features of one picture at several sizes on one core.

    Returns:
        For each method (pixels, median core seconds) by size; without reading and writing.
    """
    full = mosaic(paths)
    sizes = [size for size in SIZES_PX if size <= max(full.shape)]
    pictures = [np.ascontiguousarray(shrink_to(full, size)) for size in sizes]
    extract = {method.label: extraction(method, resources) for method in methods}
    curves: dict[str, Curve] = {name: [] for name in extract}
    with one_core():
        for picture in pictures:
            seconds: dict[str, list[float]] = {name: [] for name in extract}
            for _ in range(num_rounds):
                for name, function in extract.items():
                    start = time.process_time()
                    function(picture)
                    seconds[name].append(time.process_time() - start)
            for name, values in seconds.items():
                curves[name].append((picture.size, median(values)))
    return curves


def extraction(method: Method, resources: Resources) -> Callable[[GrayImage], object]:
    """Return a function that extracts the features of an image in memory."""
    if method.recipe is None:
        options = extraction_options(affine=method.label != SIFT)
        return pycolmap.Sift(options, pycolmap.Device.cpu).extract
    extractor = prepare(method.recipe.extraction, resources)

    def extract(image: GrayImage) -> LocalFeatures:
        camera = camera_matrix((image.shape[1], image.shape[0]))
        return extractor.execute(image, extractor.plan(Photograph(image, "", None, camera)))

    return extract


def feature_growth(paths: Sequence[Path], num_rounds: int) -> dict[str, Curve]:
    """Match the same RootSIFT features, the strongest of each image, by us and by COLMAP.

    One core; three images, of which each meets the others. Ours are exact, after a comparison in
    8 bits where the processor is fast at that.

    Returns:
        For each matcher (mean number of features, median core seconds per pair).
    """
    paths = paths[:NUM_MATCHED_IMAGES]
    extractor = prepare(load_recipe("unrectified-rootsift", MANY_FEATURES).extraction)
    found = {path.name: extractor.extract_file(path).features for path in paths}
    most = max(len(features) for features in found.values())
    num_pairs = len(paths) * (len(paths) - 1) // 2
    curves: dict[str, Curve] = {name: [] for name in ("COLMAP", "ours", "ours, 8 bit")}
    with one_core(), tempfile.TemporaryDirectory() as scratch:
        for count in (number for number in FEATURE_COUNTS if number <= most):
            strongest = {
                name: features.select(np.argsort(-features.responses, kind="stable")[:count])
                for name, features in found.items()
            }
            seconds: dict[str, list[float]] = {name: [] for name in curves}
            for number in range(num_rounds):
                database_path = Path(scratch, f"{count}-{number}.db")
                seconds["COLMAP"].append(match_by_colmap(database_path, paths, strongest))
                seconds["ours"].append(match_by_us(strongest, in_8_bit=False))
                seconds["ours, 8 bit"].append(match_by_us(strongest, in_8_bit=True))
            size = mean(len(features) for features in strongest.values())
            for name, values in seconds.items():
                curves[name].append((size, median(values) / num_pairs))
    return curves


def match_by_us(features: dict[str, LocalFeatures], *, in_8_bit: bool) -> float:
    """Prepare images and match each with the others; return core seconds."""
    options = load_recipe("unrectified-rootsift").matching
    make_coarse = coarse_descriptors(np.inf) if in_8_bit else None
    start = time.process_time()
    ready = [
        matchable(image.descriptors, image.keypoints, options, make_coarse)
        for image in features.values()
    ]
    for first, second in combinations(ready, 2):
        match_features(first, second, options)
    return time.process_time() - start


def match_by_colmap(
    database_path: Path, paths: Sequence[Path], features: dict[str, LocalFeatures]
) -> float:
    """Match each image with the others by COLMAP's default, not verified; return core seconds."""
    import_images(database_path, paths[0].parent, list(features), CameraOptions())
    ids = image_ids(database_path)
    with open_database(database_path) as database:
        for name, image in features.items():
            write_keypoints(database, ids[name], image.lafs)
            write_descriptors(database, ids[name], image.descriptors)
    list_path = database_path.with_suffix(".txt")
    list_path.write_text("".join(f"{a} {b}\n" for a, b in combinations(features, 2)))
    start = time.process_time()
    pycolmap.match_image_pairs(
        database_path,
        matching_options=pycolmap.FeatureMatchingOptions(
            skip_geometric_verification=True, num_threads=1
        ),
        pairing_options=pycolmap.ImportedPairingOptions(match_list_path=list_path),
    )
    return time.process_time() - start
