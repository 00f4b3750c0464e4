"""The measurements of the speed benchmark: whole commands, and stages on one core."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from machine import PeakMemory, one_core
from registration import link_images, match_recipe
from speed_stages import matching_work, timed_functions
from stage_clock import StageClock, Timed

from colmap_affrect import stages
from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import (
    image_ids,
    import_images,
    open_database,
    write_keypoints,
)
from colmap_affrect.colmap.mapping import map_database
from colmap_affrect.colmap.verification import PairVerifier, verified_pairs, verify
from colmap_affrect.comparison.sift import extraction_options, match_sift
from colmap_affrect.extraction import ImageExtractor, Resources, prepare
from colmap_affrect.features.dog import make_sift
from colmap_affrect.features.rootsift import RootSift
from colmap_affrect.matching.coarse import MakeCoarse, coarse_descriptors
from colmap_affrect.matching.nearest import match_features, matchable
from colmap_affrect.matching.pairs import exhaustive_pairs
from colmap_affrect.options import (
    CameraOptions,
    DogOptions,
    MappingOptions,
    VerificationOptions,
)
from colmap_affrect.recipes import Recipe, load_recipe
from colmap_affrect.store import FeatureStore
from colmap_affrect.types import LocalFeatures
from colmap_affrect.workspace import Workspace

Row = dict[str, float]

SIFT_METHODS = {
    "sift": {"estimate_affine_shape": False, "domain_size_pooling": False},
    "sift-affine": {"estimate_affine_shape": True, "domain_size_pooling": False},
    "sift-affine-dsp": {"estimate_affine_shape": True, "domain_size_pooling": True},
}
SEED = 0


def matching_variants() -> dict[str, MakeCoarse | None]:
    """Return how matching compares descriptors, by what to add to the name of its stages.

    Many pairs are compared in 8 bits at first, where the processor is fast at that.
    """
    in_8_bit = coarse_descriptors(math.inf)
    return {"": None, ", 8 bit": in_8_bit} if in_8_bit else {"": None}


@dataclass(frozen=True)
class Method:
    """COLMAP's SIFT, or a recipe.

    Attributes:
        name: one of SIFT_METHODS, or ``RECIPE[:KEY=VALUE[,...]]``.
        resources: weights of networks.
    """

    name: str
    resources: Resources

    @property
    def is_sift(self) -> bool:
        """Whether it is COLMAP's."""
        return self.name in SIFT_METHODS

    @property
    def recipe(self) -> Recipe:
        """The recipe of that name."""
        recipe, _, settings = self.name.partition(":")
        return load_recipe(recipe, settings.split(",") if settings else ())

    def extractor(self) -> ImageExtractor:
        """Build the recipe's parts."""
        return prepare(self.recipe.extraction, self.resources)


def sift_options(name: str) -> pycolmap.FeatureExtractionOptions:
    """Return COLMAP's options of one of SIFT_METHODS."""
    options = extraction_options(affine=False)
    for key, value in SIFT_METHODS[name].items():
        setattr(options.sift, key, value)
    return options


def measure_commands(method: Method, paths: Sequence[Path]) -> Row:
    """Extract, match, verify and map images once by the whole commands, on all cores.

    Returns:
        Seconds of each stage as ``extract_s``, ``match_s``, ``verify_s``, ``map_s``; numbers of
        ``images``, ``pairs``, ``features``, ``inliers`` (of verified pairs, all together),
        ``registered`` (in the largest model); ``peak_mib``, memory above that before; of files
        ``features_bytes``, ``matches_bytes`` (both 0 for COLMAP's SIFT), ``database_bytes``.
    """
    with tempfile.TemporaryDirectory() as scratch:
        image_path, folder = Path(scratch, "images"), Path(scratch, "out")
        link_images(list(paths), image_path)
        folder.mkdir()
        run = _run_sift if method.is_sift else _run_recipe
        with PeakMemory() as memory:
            row = run(method, image_path, folder)
        workspace = Workspace(folder)
        inliers = verified_pairs(workspace.database, VerificationOptions().min_num_inliers)
        with open_database(workspace.database) as database:
            features = database.num_keypoints()
        row |= {
            "images": len(paths),
            "pairs": len(paths) * (len(paths) - 1) // 2,
            "features": features,
            "inliers": sum(inliers.values()),
            "features_bytes": _size(workspace.features),
            "matches_bytes": _size(workspace.matches),
            "database_bytes": _size(workspace.database),
        }
        return row if memory.mib is None else {**row, "peak_mib": memory.mib}


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _run_sift(method: Method, image_path: Path, folder: Path) -> Row:
    database_path = Workspace(folder).database
    names = sorted(path.name for path in image_path.iterdir())
    import_images(database_path, image_path, names, CameraOptions())
    times = [time.perf_counter()]
    pycolmap.extract_features(
        database_path, image_path, extraction_options=sift_options(method.name)
    )
    times.append(time.perf_counter())
    match_sift(database_path, exhaustive_pairs(names), folder / "sift_pairs.txt")
    times.append(time.perf_counter())
    verify(database_path, VerificationOptions(), SEED)
    times.append(time.perf_counter())
    models = map_database(
        database_path,
        image_path,
        folder / "sparse",
        MappingOptions(),
        SEED,
        intrinsics_given=False,
        next_image=lambda _: None,
    )
    times.append(time.perf_counter())
    seconds = [end - begin for begin, end in pairwise(times)]
    row = dict(zip(("extract_s", "match_s", "verify_s", "map_s"), seconds, strict=True))
    return {**row, "registered": len(models[0].registered_names) if models else 0}


def _run_recipe(method: Method, image_path: Path, folder: Path) -> Row:
    workspace = Workspace(folder)
    seconds = match_recipe(folder, image_path, CameraOptions(), method.recipe, method.resources)
    verification = stages.verify_matches(workspace, VerificationOptions(), SEED)
    mapping, models = stages.map_images(workspace, MappingOptions(), SEED)
    return {
        "extract_s": seconds["extraction"],
        "match_s": seconds["matching"] + seconds.get("escalation", 0.0),
        "verify_s": verification.wall_s,
        "map_s": mapping.wall_s,
        "registered": len(models[0].registered_names) if models else 0,
    }


class StageMeasurement:
    """Stages of one method on one core, image by image and pair by pair."""

    def __init__(self, method: Method, paths: Sequence[Path]) -> None:
        """Load what the method needs, which is not measured."""
        self.method, self.paths = method, paths
        self.sift = self.extractor = None
        self.variants = matching_variants()
        if method.is_sift:
            self.sift = pycolmap.Sift(sift_options(method.name), pycolmap.Device.cpu)
        else:
            self.extractor = method.extractor()

    def run(self) -> StageClock:
        """Run all images, then all their pairs."""
        clock = StageClock()
        with one_core():
            if self.sift:
                for path in self.paths:
                    with clock.stage("decode"):
                        image = pycolmap.Bitmap.read(path, as_rgb=False).to_array()
                    with clock.stage("detect"):
                        self.sift.extract(image)
            elif self.extractor:
                self._run_recipe(self.extractor, clock)
        return clock

    def _run_recipe(self, extractor: ImageExtractor, clock: StageClock) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            image_path = Path(scratch, "images")
            link_images(list(self.paths), image_path)
            names = [path.name for path in self.paths]
            database_path = Path(scratch, "database.db")
            import_images(database_path, image_path, names, CameraOptions())
            store, ids = FeatureStore(Path(scratch, "features.h5")), image_ids(database_path)
            features: dict[str, LocalFeatures] = {}
            for path in self.paths:
                with clock.watching(timed_functions(extractor.options)), clock.stage("other"):
                    found = extractor.extract_file(path)
                with clock.stage("write"), open_database(database_path) as database:
                    store.write(path.name, found.features, found.image_size)
                    write_keypoints(database, ids[path.name], found.features.lafs)
                features[path.name] = found.features
            if isinstance(extractor.profile, RootSift):
                _split_rootsift(extractor, self.paths, clock)
            self._match(features, PairVerifier(database_path, VerificationOptions(), SEED), clock)

    def _match(
        self, features: dict[str, LocalFeatures], verifier: PairVerifier, clock: StageClock
    ) -> None:
        options = self.method.recipe.matching
        for variant, make_coarse in self.variants.items():
            with clock.stage(f"prepare{variant}"):
                ready = {
                    name: matchable(found.descriptors, found.keypoints, options, make_coarse)
                    for name, found in features.items()
                }
            for names in combinations(features, 2):
                found1, found2 = (features[name] for name in names)
                with clock.stage(f"match{variant}"):
                    matches = match_features(*(ready[name] for name in names), options)
                clock.work[f"match{variant}"] += matching_work(
                    len(found1), len(found2), found1.descriptors.shape[1]
                )
                if not variant:
                    with clock.stage("verify"):
                        points = (found1.keypoints, found2.keypoints)
                        verifier.num_inliers(names, points, matches.indices)


class _Detector:
    """OpenCV's SIFT without its descriptors, which are all ones."""

    def __init__(self, options: DogOptions) -> None:
        self.sift = make_sift(options)

    def detectAndCompute(self, image: Any, mask: Any) -> tuple[Any, Any]:
        keypoints = self.sift.detect(image, mask)
        return keypoints, np.ones((len(keypoints), RootSift.descriptor_size), np.uint8)


def _split_rootsift(extractor: ImageExtractor, paths: Sequence[Path], clock: StageClock) -> None:
    """Move the time of descriptors, which OpenCV computes while detecting, to their own stage.

    It is what the same images take less without descriptors.
    """
    without = StageClock()
    detection = [Timed("detect", "colmap_affrect.features.rootsift.RootSift.detect")]
    with (
        mock.patch("colmap_affrect.features.rootsift.make_sift", _Detector),
        without.watching(detection),
    ):
        for path in paths:
            extractor.extract_file(path)
    clock.seconds["describe"] += clock.seconds["detect"] - without.seconds["detect"]
    clock.seconds["detect"] = without.seconds["detect"]
