"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables.

``features/`` are by recipe and a digest of what decides them: only what changed is made again. A
pair is matched as a run of its two images alone would match it, with cameras unknown. Of levels of
escalation the one with most inliers of COLMAP's verification counts.
"""

import itertools
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from threading import Lock
from typing import Any, TypedDict, Unpack

import numpy as np

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.database import colmap_keypoints
from colmap_affrect.colmap.verification import (
    Side,
    VerificationOptions,
    estimate_geometry,
)
from colmap_affrect.comparison.methods import GivenMethods, Method, parse_methods
from colmap_affrect.errors import AffrectError, Logged, Option, OptionError
from colmap_affrect.evaluation import truths
from colmap_affrect.evaluation.datasets import PROTOCOLS, EvaluationPair
from colmap_affrect.evaluation.results import (
    SECONDS,
    Evaluation,
    RecipeResult,
    published,
)
from colmap_affrect.evaluation.truths import PairResult, ScoreOptions
from colmap_affrect.features.weights import digests
from colmap_affrect.geometry.arrays import Array, Floats
from colmap_affrect.geometry.conventions import DEFAULT_FOCAL_RATIO
from colmap_affrect.options import Options, digest_of, takes_fields_of
from colmap_affrect.parallel.executor import available_cores, map_ordered
from colmap_affrect.progress import GivenProgress, Progress, Stopwatch
from colmap_affrect.project.argument_types import require_bools
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.feature_store import FeatureStore
from colmap_affrect.project.image_failures import ImageFailure, failure_of
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.paths import PathLike, as_path, resolved
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Resources
from colmap_affrect.stages.match import CachedMatcher, Matching
from colmap_affrect.stages.one_image import prepare

logger = logging.getLogger(__name__)

NUM_DIGITS = 8  # of a digest in the name of a file of features; format


@dataclass
class _Matched:
    """The matches of a pair at the level with most verified inliers.

    Attributes:
        points: (M, 2) px, by image.
        num_keypoints: by image.
        level: see ``PairResult``.
        num_inliers: of COLMAP's two-view geometry; 0 where there is one level alone.
        failure: why the pair could not be matched.
    """

    points: tuple[Array, Array] = (np.zeros((0, 2)), np.zeros((0, 2)))
    num_keypoints: tuple[int, int] = (0, 0)
    level: str = ""
    num_inliers: int = 0
    failure: str = ""


class EvaluateOptions(Options):
    """Everything an evaluation depends on beside protocol, dataset and output folder."""

    recipes: GivenMethods = ("unrectified-rootsift", "default")
    """Recipes by name, or as ``LABEL=NAME:OPTION=VALUE``."""
    max_num_keypoints: int | None = None
    """Of each image the strongest are matched; None: all."""
    scores: ScoreOptions = ScoreOptions()
    """How models are estimated from matches."""
    resources: Resources = Resources()
    """Weights and device of networks."""


class EvaluateKeywords(TypedDict, total=False):
    """The fields of :class:`EvaluateOptions` as keywords of a function."""

    recipes: str | Sequence[str | Method]
    max_num_keypoints: int | None
    scores: ScoreOptions | Mapping[str, Any]
    resources: Resources | Mapping[str, Any]


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
        """Find everything that the recipe needs.

        Args:
            method: the recipe.
            pairs: of the dataset.
            output_path: folder of the evaluation, which keeps the features.
            inputs: what features depend on beside the recipe.
            options: of the evaluation.

        Raises:
            OptionError: the method is COLMAP's.
        """
        if method.recipe is None:
            raise OptionError(
                f"{method.label} is COLMAP's and no recipe", advice="compare can run it"
            )
        self.label = method.label
        self.recipe = method.recipe
        self._pairs = pairs
        self._options = options
        extraction = self.recipe.extraction
        images = set(itertools.chain.from_iterable(pair.images for pair in pairs))
        self._extractor = prepare(extraction, options.resources, sorted(images))
        made_from = [inputs, extraction.to_mapping(), digests(self._extractor.weights)]
        name = f"{method.folder_name}-{digest_of(made_from)[:NUM_DIGITS]}.h5"
        features = output_path / "features" / name
        features.parent.mkdir(parents=True, exist_ok=True)
        self._store = FeatureStore(features)
        self.failed: dict[str, ImageFailure] = {}  # images that cannot be used: why
        self._lock = Lock()  # of extraction and of the store

    def results(self, progress: Progress) -> list[PairResult]:
        """Match and score all pairs; images whose features are there are not read again."""
        matchers = {}
        for level in self._extractor.extractors:
            chosen = self.recipe.extraction.levels[level]
            matching = Matching(
                store=self._store,
                options=chosen.matching or self.recipe.matching,
                level=level,
                base=chosen.base,
                extractor=chosen.features.name,
                resources=self._options.resources,
                max_num_features=self._options.max_num_keypoints or 0,
            )
            matchers[level] = CachedMatcher(matching)
        results = []
        with progress.stage(self.label, len(self._pairs), "pairs") as advance:
            work = partial(self._result, matchers)
            for result in map_ordered(work, self._pairs, available_cores()):
                results.append(result)
                advance(1)
        return results

    def _result(
        self, matchers: Mapping[int, CachedMatcher], pair: EvaluationPair
    ) -> PairResult:
        """Match a pair, and score it; an unforeseen error of the score fails this pair only."""
        watch = Stopwatch("extract", "match", "estimate")
        matched = self._matched(matchers, pair, watch)
        try:
            with watch.step("estimate"):
                score = pair.truth.score(*matched.points, self._options.scores)
        except Exception as error:
            logger.exception("%s: %s cannot be scored", self.label, pair.name)
            matched = _Matched(failure=f"{type(error).__name__}: {error}")
            score = pair.truth.score(*matched.points, self._options.scores)
        seconds_by_step = {} if matched.failure else watch.seconds
        return PairResult(
            **vars(score),
            name=pair.name,
            category=pair.category,
            num_matches=len(matched.points[0]),
            num_keypoints=matched.num_keypoints,
            seconds=sum(seconds_by_step.values(), 0.0),
            seconds_by_step=seconds_by_step,
            level=matched.level,
            failure=matched.failure,
        )

    def _matched(
        self,
        matchers: Mapping[int, CachedMatcher],
        pair: EvaluationPair,
        watch: Stopwatch,
    ) -> _Matched:
        """Match a pair, level by level, until it has many verified inliers."""
        best = None
        most = 0
        strong = max(1, self.recipe.escalate.strong_num_inliers)
        for level, matcher in matchers.items():
            found = self._matched_at(level, matcher, pair, watch)
            if found is None:
                break
            if best is None or not most or found.num_inliers > most:
                most = found.num_inliers
                best = found
            if most >= strong:
                break
        if best is not None:
            return best
        failures = [self.failed[n].text() for n in pair.images if n in self.failed]
        return _Matched(failure="; ".join(failures))

    def _matched_at(
        self, level: int, matcher: CachedMatcher, pair: EvaluationPair, watch: Stopwatch
    ) -> _Matched | None:
        """Match a pair by the features of a level, and verify it if there are other levels.

        Args:
            level: of the recipe.
            matcher: with the features of the level.
            pair: the images.
            watch: takes the seconds.

        Returns:
            The matches; None if an image cannot be used.
        """
        with self._lock, watch.step("extract"):
            if not self._extract_pair(pair, level):
                return None
            first, second = map(matcher.prepared, pair.images)
        with watch.step("match"):
            matches = matcher.matcher.match(first.content, second.content)
            rows1, rows2 = matches.indices.T
            lafs = (first.frames[rows1], second.frames[rows2])
            num_inliers = 0
            name = ""
            if len(self._extractor.extractors) > 1:
                num_inliers = self._verified_inliers(pair, lafs, level)
                name = self.recipe.extraction.levels[level].name
        return _Matched(
            points=(lafs[0][:, :, 2], lafs[1][:, :, 2]),
            num_keypoints=(len(first.frames), len(second.frames)),
            level=name if num_inliers or not name else "none",
            num_inliers=num_inliers,
        )

    def _extract_pair(self, pair: EvaluationPair, level: int) -> bool:
        """Extract what the images of a pair lack of a level; tell whether both can be used."""
        image1, image2 = zip(pair.images, pair.paths, pair.intrinsics, strict=True)
        is_usable1 = self._extract(*image1, level)
        is_usable2 = self._extract(*image2, level)
        return is_usable1 and is_usable2

    def _extract(
        self, name: str, path: Path, intrinsics: Array | None, level: int
    ) -> bool:
        """Extract what an image lacks of a level; tell whether it can be used."""
        store = self._store
        base = self.recipe.extraction.levels[level].base
        there = store.level_ranges(name) if name in store.names() else {}
        for missing in sorted({0, base, level} - there.keys()):
            if name in self.failed:
                return False
            try:
                found = self._extractor.extract_file(path, name, intrinsics, missing)
            except AffrectError as error:
                self.failed[name] = failure_of(error)
                logger.warning("%s", Logged(self.failed[name].words))
                return False
            if found.not_rectified:
                logger.warning("%s: not rectified: %s", name, found.not_rectified)
            if missing:
                store.extend(name, found.features, missing)
            else:
                store.write(name, found.features, found.image_size)
        return True

    def _verified_inliers(
        self, pair: EvaluationPair, lafs: tuple[Floats, Floats], level: int
    ) -> int:
        """Return the number of inliers of COLMAP's two-view geometry; 0 if a run would not take it.

        Args:
            pair: the images.
            lafs: (M, 2, 3) of the matched features, by image.
            level: of the features.
        """
        sides = []
        for number, name in enumerate(pair.images):
            with self._lock:
                width, height = self._store.image_size(name)
            # COLMAP's camera of an image without EXIF. Each image has one of its own, since two
            # images of one camera are verified in another way.
            camera = pycolmap.Camera.create_from_model_name(
                number + 1,
                "SIMPLE_RADIAL",
                DEFAULT_FOCAL_RATIO * max(width, height),
                width,
                height,
            )
            sides.append(Side(camera, colmap_keypoints(lafs[number])))
        indices = np.arange(len(lafs[0]))
        geometry = estimate_geometry(
            sides=(sides[0], sides[1]),
            matches=np.stack([indices, indices], axis=1),
            options=VerificationOptions(random_seed=0),
            extracted_px=self.recipe.extraction.levels[level].max_image_size_px,
        )
        return len(geometry.inlier_matches)


@takes_fields_of(EvaluateOptions)
def evaluate(
    protocol: str,
    dataset_path: PathLike,
    output_path: PathLike,
    options: EvaluateOptions | None = None,
    *,
    overwrite: bool = False,
    progress: GivenProgress = None,
    **keywords: Unpack[EvaluateKeywords],
) -> Evaluation:
    """Score recipes on a dataset, and write ``evaluation.json``, too.

    A pair with an image that cannot be used counts as failed. AffrectError for what the caller can
    mend, before any image is worked on.

    Args:
        protocol: one of ``PROTOCOLS``.
        dataset_path: folder of the dataset.
        output_path: folder for all results; features that are there are used again.
        options: options to begin with; None for the usual ones.
        overwrite: discard the features of these recipes.
        progress: True, False, or None for where somebody looks at it.
        keywords: fields of :class:`EvaluateOptions`, as ``recipes=["default"]``.
    """
    dataset_path = as_path(dataset_path, "dataset_path")
    output_path = as_path(output_path, "output_path")
    if protocol not in PROTOCOLS:
        raise OptionError(
            f"unknown protocol '{protocol}'", advice=f"give {' or '.join(PROTOCOLS)}"
        )
    options = EvaluateOptions.with_keywords(options, keywords)
    require_bools(overwrite=overwrite)
    progress = Progress.given(progress)
    methods = parse_methods(options.recipes)
    _check(options, dataset_path)
    Workspace(output_path).require_own(dataset_path)
    inputs = {"protocol": protocol, "dataset_path": str(resolved(dataset_path))}
    with Workspace(output_path).locked():
        pairs = PROTOCOLS[protocol](dataset_path)
        runs = [
            RecipeRun(
                method=method,
                pairs=pairs,
                output_path=output_path,
                inputs=inputs,
                options=options,
            )
            for method in methods
        ]
        for method in methods if overwrite else ():
            pattern = f"features/{method.folder_name}-{'?' * NUM_DIGITS}.h5"
            remove_own(output_path.glob(pattern))
        results = {run.label: run.results(progress) for run in runs}
        evaluation = Evaluation(
            protocol=protocol,
            dataset_path=inputs["dataset_path"],
            settings={
                "scores": options.scores.to_mapping(),
                "max_num_keypoints": options.max_num_keypoints,
            },
            recipes=tuple(_recipe_result(run, results[run.label]) for run in runs),
            published=published(protocol),
            versions=installed_versions(),
        )
        replace_text(output_path / "evaluation.json", evaluation.to_json())
    return evaluation


def _check(options: EvaluateOptions, dataset_path: Path) -> None:
    """Refuse options out of range, and a dataset that is not there; OptionError."""
    if options.max_num_keypoints is not None and options.max_num_keypoints < 1:
        raise OptionError(
            "must be at least 1",
            where=Option("max-num-keypoints", options.max_num_keypoints),
        )
    if options.scores.random_seed < 0:
        raise OptionError(
            "must be at least 0",
            where=Option("random-seed", options.scores.random_seed),
        )
    if not dataset_path.is_dir():
        raise OptionError(
            "no such folder",
            where=dataset_path,
            advice="give the folder of the dataset",
        )


def _recipe_result(run: RecipeRun, results: Sequence[PairResult]) -> RecipeResult:
    """Sum up the results of all pairs."""
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
        failed=run.failed,
        pairs=tuple(results),
    )
