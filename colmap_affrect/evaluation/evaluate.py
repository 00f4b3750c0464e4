"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables.

``features/`` are by recipe and a digest of what decides them: only what changed is made again. A
pair is matched as a run of its two images alone would match it, with cameras unknown. Of levels of
escalation the one with most inliers of COLMAP's verification counts.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from statistics import fmean
from threading import Lock
from typing import Any

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import colmap_keypoints
from colmap_affrect.colmap.verification import Side, VerificationOptions, estimate_geometry
from colmap_affrect.comparison.methods import Method, parse_methods
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.evaluation import truths
from colmap_affrect.evaluation.datasets import PROTOCOLS, EvaluationPair
from colmap_affrect.evaluation.results import SECONDS, Evaluation, RecipeResult, published
from colmap_affrect.evaluation.truths import PairResult, ScoreOptions
from colmap_affrect.features.weights import digests
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.conventions import DEFAULT_FOCAL_RATIO
from colmap_affrect.options import digest_of
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import SILENT, Progress, Stopwatch
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.paths import PathLike, TakesPaths, as_path
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.stores import FeatureStore
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Resources
from colmap_affrect.stages.match import CachedMatcher, Matching
from colmap_affrect.stages.one_image import prepare

logger = logging.getLogger(__name__)

NOTHING = np.zeros((0, 2)), np.zeros((0, 2))  # points of a pair that could not be matched


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(TakesPaths):
    """Everything an evaluation depends on beside protocol, dataset and output folder."""

    recipes: Sequence[str | Method] = ("unrectified-rootsift", "default")  # also by name
    max_num_keypoints: int | None = None  # of each image the strongest are matched; None: all
    scores: ScoreOptions = field(default_factory=ScoreOptions)
    resources: Resources = field(default_factory=Resources)


class RecipeRun:
    """One recipe on the pairs of a dataset."""

    def __init__(
        self,
        method: Method,
        pairs: Sequence[EvaluationPair],
        output_path: Path,
        inputs: Mapping[str, Any],
        options: EvaluateOptions,
    ) -> None:
        """Find everything that the recipe needs; features depend on it and on ``inputs``."""
        if method.recipe is None:
            raise OptionError(f"{method.label} is COLMAP's and no recipe; compare can run it")
        self.label, self.recipe, self._pairs = method.label, method.recipe, pairs
        self._options, extraction = options, self.recipe.extraction
        images = {name for pair in pairs for name in pair.images}
        self._extractor = prepare(extraction, options.resources, sorted(images))
        made = digest_of([inputs, extraction.to_mapping(), digests(self._extractor.weights)])
        features = output_path / "features" / f"{method.folder_name}-{made[:8]}.h5"
        features.parent.mkdir(parents=True, exist_ok=True)
        self._store = FeatureStore(features)
        self.failures: dict[str, str] = {}  # images that could not be used in this run: why
        self._lock = Lock()  # of extraction and of the store

    def results(self, progress: Progress) -> list[PairResult]:
        """Match and score all pairs; images whose features are there are not read again."""
        results, matchers = [], dict[int, CachedMatcher]()
        given = self._options.resources, self._options.max_num_keypoints or 0
        for level in self._extractor.extractors:
            chosen = self.recipe.extraction.levels[level]
            options, kind = chosen.matching or self.recipe.matching, chosen.features.name
            matching = Matching(self._store, options, level, chosen.base, kind, *given)
            matchers[level] = CachedMatcher(matching)
        with progress.stage(self.label, len(self._pairs), "pairs") as advance:
            work = partial(self._result, matchers)
            for result in map_ordered(work, self._pairs, available_cores()):
                results.append(result)
                advance(1)
        return results

    def _result(self, matchers: Mapping[int, CachedMatcher], pair: EvaluationPair) -> PairResult:
        """Match a pair, and score it; an unforeseen error of the score fails this pair only."""
        watch = Stopwatch("extract", "match", "estimate")
        found, points = self._matched(matchers, pair, watch)
        try:
            with watch.step("estimate"):
                score = pair.truth.score(*points, self._options.scores)
        except Exception as error:
            logger.exception("%s: %s cannot be scored", self.label, pair.name)
            score = pair.truth.score(*NOTHING, self._options.scores)
            found = {"failure": f"{type(error).__name__}: {error}"}
        if "failure" not in found:
            found |= {"seconds": sum(watch.seconds.values()), "seconds_by_step": watch.seconds}
        return PairResult(**vars(score), name=pair.name, category=pair.category, **found)

    def _matched(
        self, matchers: Mapping[int, CachedMatcher], pair: EvaluationPair, watch: Stopwatch
    ) -> tuple[dict[str, Any], tuple[Array, Array]]:
        """Return what a result says of matches, and (M, 2) and (M, 2) points, of the best level.

        Of a pair with an image that cannot be used that is the failure.
        """
        found, points, most = dict[str, Any](), NOTHING, 0
        for level, matcher in matchers.items():
            with self._lock, watch.step("extract"):
                images = zip(pair.images, pair.paths, pair.intrinsics, strict=True)
                usable = [self._extract(*image, level) for image in images]
                if not all(usable):
                    break
                first, second = map(matcher.prepared, pair.images)
            with watch.step("match"):
                rows1, rows2 = matcher.matcher.match(first.content, second.content).indices.T
                frames = first.frames[rows1], second.frames[rows2]
                count, decided = 0, ""
                if len(matchers) > 1:
                    count = self._verified_inliers(pair, frames, level)
                    decided = self.recipe.extraction.levels[level].name if count else "none"
            if count > most or not most:
                most, points = count, (frames[0][:, :, 2], frames[1][:, :, 2])
                num_keypoints = len(first.frames), len(second.frames)
                found = {"num_matches": len(rows1), "num_keypoints": num_keypoints}
                found["level"] = decided
            if most >= max(1, self.recipe.escalate.strong_num_inliers):
                break
        failures = filter(None, (self.failures.get(name) for name in pair.images))
        return found or {"failure": "; ".join(failures)}, points

    def _extract(self, name: str, path: Path, intrinsics: Array | None, level: int) -> bool:
        """Extract what an image lacks of a level; tell whether it can be used."""
        store, base = self._store, self.recipe.extraction.levels[level].base
        there = store.level_ranges(name) if name in store.names() else {}
        for missing in sorted({0, base, level} - there.keys()):
            if name in self.failures:
                return False
            try:
                found = self._extractor.extract_file(path, name, intrinsics, missing)
            except AffrectError as error:
                logger.warning("%s", error)
                self.failures[name] = str(error)
                return False
            if found.warning:
                logger.warning("%s: %s", name, found.warning)
            if missing:
                store.extend(name, found.features, missing)
            else:
                store.write(name, found.features, found.image_size)
        return True

    def _verified_inliers(self, pair: EvaluationPair, frames: Sequence[Floats], level: int) -> int:
        """Return the inliers of COLMAP's two-view geometry; 0 if a run would not take it."""
        with self._lock:
            sizes = [self._store.image_size(name) for name in pair.images]
        # What COLMAP assumes of an image without EXIF: a camera of its own, of unknown focus.
        # The id matters: two images of one camera are verified in another way.
        model, make = "SIMPLE_RADIAL", pycolmap.Camera.create_from_model_name
        focal_px = [DEFAULT_FOCAL_RATIO * max(size) for size in sizes]
        first, second = (
            Side(make(k + 1, model, focal_px[k], *sizes[k]), colmap_keypoints(frames[k]))
            for k in (0, 1)
        )
        rows = np.stack([np.arange(len(frames[0]))] * 2, axis=1)
        options = VerificationOptions(random_seed=0)
        extracted_px = self.recipe.extraction.levels[level].max_image_size_px
        return len(estimate_geometry((first, second), rows, options, extracted_px).inlier_matches)


@checks_arguments
def evaluate(
    protocol: str,
    dataset_path: PathLike,
    output_path: PathLike,
    options: EvaluateOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Evaluation:
    """Score recipes on a dataset by one of ``PROTOCOLS``.

    A pair with an image that cannot be used counts as failed. Features that are there are used
    again, unless ``overwrite`` discards those of these recipes. Writes ``evaluation.json``, too.
    AffrectError for what the caller can mend, before any image is worked on.
    """
    dataset_path, output_path = as_path(dataset_path), as_path(output_path)
    if protocol not in PROTOCOLS:
        raise OptionError(f"unknown protocol '{protocol}': known are {', '.join(PROTOCOLS)}")
    options = options or EvaluateOptions()
    methods = parse_methods(options.recipes)
    if options.max_num_keypoints is not None and options.max_num_keypoints < 1:
        raise OptionError(f"--max-num-keypoints {options.max_num_keypoints}: must be at least 1")
    if options.scores.random_seed < 0:
        raise OptionError(f"--random-seed {options.scores.random_seed}: must be at least 0")
    if not dataset_path.is_dir():
        raise OptionError(f"{dataset_path}: no such folder; give the folder of the dataset")
    Workspace(output_path).require_own(dataset_path)
    inputs = {"protocol": protocol, "dataset_path": str(dataset_path.resolve())}
    with Workspace(output_path).locked():
        pairs = PROTOCOLS[protocol](dataset_path)
        runs = [RecipeRun(method, pairs, output_path, inputs, options) for method in methods]
        for method in methods if overwrite else ():
            remove_own(output_path.glob(f"features/{method.folder_name}-????????.h5"))
        results = {run.label: run.results(progress) for run in runs}
        evaluation = Evaluation(
            protocol=protocol,
            dataset_path=inputs["dataset_path"],
            settings={
                "scores": asdict(options.scores),
                "max_num_keypoints": options.max_num_keypoints,
            },
            recipes=tuple(_summed(run, results[run.label]) for run in runs),
            published=published(protocol),
            versions=installed_versions(),
        )
        replace_text(output_path / "evaluation.json", evaluation.to_json())
    return evaluation


def _summed(run: RecipeRun, results: Sequence[PairResult]) -> RecipeResult:
    return RecipeResult(
        name=run.label,
        summary=truths.columns(results),
        costs={
            "solved": fmean(result.solved for result in results),
            "failed": sum(bool(result.failure) for result in results),
            "keypoints": fmean(fmean(result.num_keypoints) for result in results),
            "matches": fmean(result.num_matches for result in results),
            "inliers": fmean(result.num_inliers for result in results),
            SECONDS: sum(result.seconds for result in results),
        },
        failures=run.failures,
        pairs=tuple(results),
    )
