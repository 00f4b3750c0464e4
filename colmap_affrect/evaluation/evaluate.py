"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables, plots.

The output folder has ``features/`` (features and costs by recipe), ``pairs/`` (scores of single
pairs by recipe and settings), ``evaluation.json``, ``evaluation.csv`` and plots. An evaluation that
was stopped goes on; scores of other settings are kept beside, so that only what changed is redone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_affrect.comparison.methods import Method, parse_methods, unique_methods
from colmap_affrect.errors import AffrectError, EvaluationError, OptionError
from colmap_affrect.evaluation.costs import ImageCost
from colmap_affrect.evaluation.pair_matches import MatchedPair, PairMatcher
from colmap_affrect.evaluation.plots import write_plots
from colmap_affrect.evaluation.protocol import (
    Dataset,
    EvaluationImage,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
)
from colmap_affrect.evaluation.published import COMPLEXITY, published
from colmap_affrect.evaluation.recipe_features import RecipeFeatures
from colmap_affrect.evaluation.records import RecordFile
from colmap_affrect.evaluation.registry import make_protocol
from colmap_affrect.evaluation.results import (
    Evaluation,
    Interval,
    RecipeResult,
    pair_from_mapping,
    pair_to_mapping,
)
from colmap_affrect.evaluation.statistics import bootstrap_interval, paired_test
from colmap_affrect.evaluation.tables import GROUP, SECONDS
from colmap_affrect.extraction import Resources
from colmap_affrect.files import replace_text
from colmap_affrect.imaging import require_png
from colmap_affrect.pipeline import installed_versions
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.recipes import Recipe
from colmap_affrect.workspace import Workspace

logger = logging.getLogger(__name__)

DEFAULT_RECIPES = ("unrectified-rootsift", "default")

NOTHING: NDArray[np.float64] = np.zeros((0, 2))
"""Matches of a pair that could not be matched."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Everything an evaluation depends on beside protocol, dataset and output folder.

    Attributes:
        recipes: by name as the command line takes them, or as methods.
        baseline: label of the recipe that the others are tested against; None for none.
        max_num_keypoints: budget: of each image the strongest of all its features are matched; None
            for all.
        random_seed: of the estimators and the statistics.
        resources: weights and device of networks.
    """

    recipes: Sequence[str | Method] = DEFAULT_RECIPES
    baseline: str | None = None
    max_num_keypoints: int | None = None
    random_seed: int = 0
    resources: Resources = field(default_factory=Resources)


def evaluate(
    protocol: str | EvaluationProtocol,
    dataset_path: Path,
    output_path: Path,
    options: EvaluateOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Evaluation:
    """Score recipes on a dataset; go on after a stop.

    An image or pair that cannot be used counts as failed, and the others go on.

    Args:
        protocol: its name, or one with changed settings.
        dataset_path: folder of the dataset, in the layout of the protocol.
        output_path: folder for all results, made if missing.
        options: see :class:`EvaluateOptions`.
        overwrite: discard features and scores of these recipes first.
        progress: where to show progress.

    Returns:
        What is also written to ``evaluation.json``, ``evaluation.csv`` and the plots.

    Raises:
        AffrectError: for anything that the caller can mend, before any image is worked on.
    """
    require_png()
    options = options or EvaluateOptions()
    chosen = make_protocol(protocol) if isinstance(protocol, str) else protocol
    methods = _methods(options)
    if not dataset_path.is_dir():
        raise EvaluationError(f"{dataset_path}: no such folder; give the folder of the dataset")
    with Workspace(output_path).locked():
        with progress.stage("check dataset", 1, "datasets") as advance:
            dataset = chosen.load(dataset_path)
            advance(1)
        _refuse_unusable(dataset, dataset_path)
        settings = {
            "scores": chosen.settings(),
            "random_seed": options.random_seed,
            "max_num_keypoints": options.max_num_keypoints,
        }
        inputs = {"protocol": chosen.name, "dataset_path": str(dataset_path.resolve())}
        runs = [
            _Run.prepared(
                method, chosen, dataset, output_path, inputs, settings, options, overwrite=overwrite
            )
            for method in methods
        ]
        results = {run.method.label: run.results(progress) for run in runs}
        baseline = options.baseline or ""
        evaluation = Evaluation(
            protocol=chosen.name,
            error_title=chosen.error_title,
            category_title=chosen.category_title,
            dataset_path=inputs["dataset_path"],
            settings=settings,
            recipes=tuple(
                run.summarized(results[run.method.label], results.get(baseline)) for run in runs
            ),
            notes=dataset.notes,
            baseline=baseline,
            published=tuple(published(chosen.name)),
            published_complexity=tuple(published(COMPLEXITY)),
            versions=installed_versions(),
        )
        replace_text(output_path / "evaluation.json", evaluation.to_json())
        replace_text(output_path / "evaluation.csv", evaluation.to_csv())
        write_plots(evaluation, output_path)
    return evaluation


def _methods(options: EvaluateOptions) -> tuple[Method, ...]:
    """Parse recipes and refuse what cannot work."""
    methods = unique_methods(
        [
            method
            for item in options.recipes
            for method in ([item] if isinstance(item, Method) else parse_methods([item]))
        ]
    )
    labels = [method.label for method in methods]
    for method in methods:
        if method.recipe is None:
            raise OptionError(f"{method.label} is COLMAP's and no recipe; compare can run it")
    if options.baseline is not None and options.baseline not in labels:
        raise OptionError(
            f"--baseline {options.baseline}: is not among the recipes {', '.join(labels)}"
        )
    if options.max_num_keypoints is not None and options.max_num_keypoints < 1:
        raise OptionError(f"--max-num-keypoints {options.max_num_keypoints}: must be at least 1")
    return methods


def _refuse_unusable(dataset: Dataset, path: Path) -> None:
    if all(pair.problem for pair in dataset.pairs):
        why = dataset.pairs[0].problem if dataset.pairs else "it has none"
        raise EvaluationError(f"{path}: no pair can be evaluated; the first: {why}")


@dataclass(frozen=True)
class _Run:
    """One recipe on the pairs of a dataset.

    Attributes:
        method: the recipe under its label.
        protocol: scores its matches.
        pairs: of the dataset.
        features: of the recipe.
        records: results of pairs, with a fingerprint of the truth that they are of.
        options: of the evaluation.
    """

    method: Method
    protocol: EvaluationProtocol
    pairs: tuple[EvaluationPair, ...]
    features: RecipeFeatures
    records: RecordFile
    options: EvaluateOptions

    @classmethod
    def prepared(
        cls,
        method: Method,
        protocol: EvaluationProtocol,
        dataset: Dataset,
        output_path: Path,
        inputs: Mapping[str, Any],
        settings: Mapping[str, Any],
        options: EvaluateOptions,
        *,
        overwrite: bool,
    ) -> _Run:
        """Find everything that the recipe needs before any image is worked on."""
        recipe = _recipe(method)
        usable = [pair for pair in dataset.pairs if not pair.problem]
        images: dict[str, EvaluationImage] = {
            image.name: image for pair in usable for image in pair.images
        }
        features = RecipeFeatures(
            output_path / "features",
            method,
            recipe,
            list(images.values()),
            inputs,
            options.resources,
            overwrite=overwrite,
        )
        decisive = {
            "features": features.settings,
            "matching": recipe.matching.to_mapping(),
            **settings,
        }
        digest = hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()
        path = output_path / "pairs" / f"{method.folder_name}-{digest[:8]}.jsonl"
        if overwrite:
            for old in path.parent.glob(f"{method.folder_name}-????????.jsonl"):
                old.unlink()
        return cls(method, protocol, dataset.pairs, features, RecordFile(path, decisive), options)

    def results(self, progress: Progress) -> list[PairResult]:
        """Match and score all pairs that have not been; what fails is tried again next time."""
        truths = {pair.name: _fingerprint(pair.truth) for pair in self.pairs}
        done = {
            record["name"]: pair_from_mapping(record["result"])
            for record in self.records.records
            if truths.get(record["name"]) == record["truth"]
        }
        todo = [pair for pair in self.pairs if not pair.problem and pair.name not in done]
        matcher = PairMatcher(
            self.features, self.options.max_num_keypoints, self.method.label, progress
        )
        for result in matcher.run(todo, self._scored):
            if not result.failure:
                record = {
                    "name": result.name,
                    "truth": truths[result.name],
                    "result": pair_to_mapping(result),
                }
                self.records.append(record)
            done[result.name] = result
        return [done.get(pair.name) or self._failed(pair) for pair in self.pairs]

    def _scored(self, matched: MatchedPair) -> PairResult:
        """Score matches; an unforeseen error fails this pair only."""
        pair, start = matched.pair, time.perf_counter()
        try:
            score = self.protocol.score(pair, *matched.points, self.options.random_seed)
        except AffrectError as error:
            return self._failed(pair, str(error))
        except Exception as error:
            logger.exception("%s: %s cannot be scored", self.method.label, pair.name)
            return self._failed(pair, f"{type(error).__name__}: {error}")
        estimate_s = time.perf_counter() - start
        level = ""
        if self.method.climbs:
            rectifiers = self.features.recipe.extraction.rectifiers
            level = "none" if matched.level is None else rectifiers[matched.level].name
        return PairResult(
            pair.name,
            pair.category,
            score,
            len(matched.points[0]),
            matched.seconds + estimate_s,
            matched.num_keypoints,
            {"match": matched.seconds, "estimate": estimate_s},
            level,
            matched.num_levels,
        )

    def _failed(self, pair: EvaluationPair, failure: str = "") -> PairResult:
        """Return the result of a pair that has no matches."""
        lost = [self.features.failures.get(image.name, "") for image in pair.images]
        why = failure or pair.problem or "; ".join(filter(None, lost))
        score = PairScore(math.inf, 0)
        if not pair.problem and not failure:
            score = self.protocol.score(pair, NOTHING, NOTHING, self.options.random_seed)
        return PairResult(pair.name, pair.category, score, 0, 0.0, failure=why)

    def summarized(
        self, results: Sequence[PairResult], baseline: Sequence[PairResult] | None
    ) -> RecipeResult:
        """Sum up the results of the pairs, and test them against those of the baseline."""
        num_levels: dict[str, int] = {}
        for pair, result in zip(self.pairs, results, strict=True):
            for image in pair.images:
                num_levels[image.name] = max(num_levels.get(image.name, 0), result.num_levels)
        costs = list(self.features.costs(num_levels).values())
        seconds = sum(cost.total_s for cost in costs) + sum(result.seconds for result in results)
        seed = self.options.random_seed
        successes = [self.protocol.success(result.score) for result in results]
        p_value = None
        if baseline is not None and baseline is not results:
            others = [self.protocol.success(result.score) for result in baseline]
            p_value = paired_test(successes, others, seed)
        recipe = _recipe(self.method)
        return RecipeResult(
            name=self.method.label,
            description=recipe.summary,
            pairs=tuple(results),
            summary={**self.protocol.summarize(results), SECONDS: seconds},
            intervals=_intervals(self.protocol, results, seed),
            solved=(float(np.mean(successes)), bootstrap_interval(successes, _mean, seed)),
            solved_by_category={
                category: float(np.mean([successes[row] for row in rows]))
                for category, rows in _by_category(results).items()
            },
            p_value=p_value,
            cost=ImageCost.mean(costs),
            num_images=len(costs),
            failures=self.features.failures,
            warnings=self.features.warnings,
        )


def _recipe(method: Method) -> Recipe:
    """Return the recipe of a method that has been checked to have one."""
    if method.recipe is None:
        raise OptionError(f"{method.label} is no recipe")
    return method.recipe


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean())


def _intervals(
    protocol: EvaluationProtocol, results: Sequence[PairResult], seed: int
) -> dict[str, Interval]:
    """Return bootstrap intervals of the columns; those of a category over its pairs."""
    summaries: dict[bytes, dict[str, float]] = {}
    categories = _by_category(results)
    columns = protocol.summarize(results)

    def interval(column: str) -> Interval:
        rows = categories.get(column.rpartition(GROUP)[2], list(range(len(results))))

        def statistic(picked: NDArray[np.float64]) -> float:
            key = picked.tobytes()  # columns of the same pairs are resampled alike
            if key not in summaries:
                summaries[key] = protocol.summarize([results[int(row)] for row in picked])
            return summaries[key].get(column, 0.0)

        return bootstrap_interval(list(map(float, rows)), statistic, seed)

    return {column: interval(column) for column in columns}


def _by_category(results: Sequence[PairResult]) -> dict[str, list[int]]:
    """Return the rows of the pairs of each category, of those that have one."""
    categories: dict[str, list[int]] = {}
    for row, result in enumerate(results):
        if result.category:
            categories.setdefault(result.category, []).append(row)
    return categories


def _fingerprint(truth: Any) -> str:
    """Return what a truth of any type can be recognised by."""
    digest = hashlib.sha256()
    _update(digest.update, truth)
    return digest.hexdigest()


def _update(update: Callable[[bytes], None], value: Any) -> None:
    if isinstance(value, np.ndarray):
        update(str(value.shape).encode() + np.ascontiguousarray(value).tobytes())
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            _update(update, getattr(value, item.name))
    elif isinstance(value, list | tuple):
        for item in value:
            _update(update, item)
    else:
        update(repr(value).encode())
