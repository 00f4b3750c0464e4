"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables, plots.

The output folder has ``features/`` (features and costs by recipe), ``pairs/`` (scores of single
pairs by recipe and settings), ``evaluation.json`` and plots. An evaluation that
was stopped goes on; scores of other settings are kept beside, so that only what changed is redone.
"""

import hashlib
import json
import logging
import math
import sys
import time
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from colmap_affrect.comparison.methods import Method, parse_methods
from colmap_affrect.errors import AffrectError, EvaluationError, OptionError
from colmap_affrect.evaluation.evd import Evd
from colmap_affrect.evaluation.pair_matches import MatchedPair, PairMatcher
from colmap_affrect.evaluation.pairs import Pairs
from colmap_affrect.evaluation.plots import write_plots
from colmap_affrect.evaluation.posed_scenes import Imc, Svp
from colmap_affrect.evaluation.protocol import (
    Dataset,
    EvaluationPair,
    EvaluationProtocol,
    PairResult,
    PairScore,
)
from colmap_affrect.evaluation.recipe_features import (
    PAIR_STEPS,
    ImageCost,
    RecipeFeatures,
    RecordFile,
)
from colmap_affrect.evaluation.results import (
    COMPLEXITY,
    PAIR_RESULT,
    SECONDS,
    Evaluation,
    RecipeResult,
    Solved,
    published,
)
from colmap_affrect.evaluation.statistics import bootstrap_intervals, paired_test
from colmap_affrect.geometry.arrays import Array
from colmap_affrect.images.reading import require_png
from colmap_affrect.options import digest_of
from colmap_affrect.pipeline import installed_versions
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Resources

logger = logging.getLogger(__name__)

PROTOCOLS: Mapping[str, type[EvaluationProtocol]] = {
    protocol.name: protocol for protocol in (Evd, Svp, Imc, Pairs)
}
DEFAULT_RECIPES = ("unrectified-rootsift", "default")

NOTHING: Array = np.zeros((0, 2))  # matches of a pair that could not be matched


def make_protocol(name: str, settings: Sequence[str] = ()) -> EvaluationProtocol:
    """Return a protocol, some of its options changed by ``KEY=VALUE``.

    Raises OptionError for an unknown protocol or option, or a value that it cannot have.
    """
    if name not in PROTOCOLS:
        raise OptionError(f"unknown protocol '{name}': known are {', '.join(PROTOCOLS)}")
    values = {}
    for setting in settings:
        key, separator, text = (part.strip() for part in setting.partition("="))
        if not separator:
            raise OptionError(f"{setting}: expected KEY=VALUE")
        try:
            values[key] = tomllib.loads(f"value = {text}")["value"]
        except (ValueError, RecursionError):
            values[key] = text
    return PROTOCOLS[name].from_mapping(values, name)


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Everything an evaluation depends on beside protocol, dataset and output folder.

    Attributes:
        recipes: by name as the command line takes them, or as methods.
        baseline: label of the recipe that the others are tested against; None for none.
        max_num_keypoints: of each image so many of its strongest features are matched; None: all.
        random_seed: of the estimators and the statistics.
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
    """Score recipes on a dataset by a protocol (its name, or one with changed settings).

    An image or pair that cannot be used counts as failed, and the others go on; so does an
    evaluation that was stopped, unless ``overwrite`` discards features and scores of these recipes
    first. What is returned is also written to ``evaluation.json`` and plots in
    the output folder, which is made if missing. Raises AffrectError for anything that the caller
    can mend, before any image is worked on.
    """
    require_png()
    options = options or EvaluateOptions()
    chosen = make_protocol(protocol) if isinstance(protocol, str) else protocol
    methods = _methods(options)
    if not dataset_path.is_dir():
        raise OptionError(f"{dataset_path}: no such folder; give the folder of the dataset")
    Workspace(output_path).require_own(dataset_path)
    with Workspace(output_path).locked():
        dataset = _loaded(chosen, dataset_path, progress)
        settings = {
            "scores": chosen.settings(),
            "random_seed": options.random_seed,
            "max_num_keypoints": options.max_num_keypoints,
        }
        inputs = {"protocol": chosen.name, "dataset_path": str(dataset_path.resolve())}
        rest = (dataset.pairs, output_path, inputs, settings, options)
        runs = [_Run(method, chosen, *rest, overwrite=overwrite) for method in methods]
        results = {run.label: run.results(progress) for run in runs}
        baseline = results.get(options.baseline or "")
        evaluation = Evaluation(
            protocol=chosen.name,
            error_title=chosen.error_title,
            category_title=chosen.category_title,
            dataset_path=inputs["dataset_path"],
            settings=settings,
            baseline=options.baseline or "",
            notes=dataset.notes,
            recipes=tuple(run.summarized(results[run.label], baseline) for run in runs),
            published=tuple(published(chosen.name)),
            published_complexity=tuple(published(COMPLEXITY)),
            versions=installed_versions(),
        )
        replace_text(output_path / "evaluation.json", evaluation.to_json())
        write_plots(evaluation, output_path)
    return evaluation


def _methods(options: EvaluateOptions) -> tuple[Method, ...]:
    methods = parse_methods(options.recipes)
    labels = [method.label for method in methods]
    for method in methods:
        _recipe(method)
    if options.baseline is not None and options.baseline not in labels:
        raise OptionError(
            f"--baseline {options.baseline}: is not among the recipes {', '.join(labels)}"
        )
    if options.max_num_keypoints is not None and options.max_num_keypoints < 1:
        raise OptionError(f"--max-num-keypoints {options.max_num_keypoints}: must be at least 1")
    if options.random_seed < 0:
        raise OptionError(f"--random-seed {options.random_seed}: must be at least 0")
    return methods


def _loaded(protocol: EvaluationProtocol, path: Path, progress: Progress) -> Dataset:
    with progress.stage("check dataset", 1, "datasets") as advance:
        dataset = protocol.load(path)
        advance(1)
    if all(pair.problem for pair in dataset.pairs):
        why = dataset.pairs[0].problem if dataset.pairs else "it has none"
        raise EvaluationError(f"{path}: no pair can be evaluated; the first: {why}")
    return dataset


def _recipe(method: Method) -> Recipe:
    if method.recipe is None:
        raise OptionError(f"{method.label} is COLMAP's and no recipe; compare can run it")
    return method.recipe


class _Run:
    """One recipe on the pairs of a dataset."""

    def __init__(
        self,
        method: Method,
        protocol: EvaluationProtocol,
        pairs: Sequence[EvaluationPair],
        output_path: Path,
        inputs: Mapping[str, Any],
        settings: Mapping[str, Any],
        options: EvaluateOptions,
        *,
        overwrite: bool,
    ) -> None:
        """Find everything that the recipe needs before any image is worked on.

        Features depend on ``inputs``, and scores on ``settings`` beside them; both are recorded.
        """
        self.label, self.recipe = method.label, _recipe(method)
        self.protocol, self.pairs, self.options = protocol, pairs, options
        images = {image.name: image for p in pairs if not p.problem for image in p.images}
        self.features = RecipeFeatures(
            output_path / "features" / method.folder_name,
            self.recipe.extraction,
            images,
            inputs,
            options.resources,
            overwrite=overwrite,
        )
        decisive = {
            "features": self.features.settings,
            "matching": self.recipe.matching.to_mapping(),
            **settings,
        }
        path = output_path / "pairs" / f"{method.folder_name}-{digest_of(decisive)[:8]}.jsonl"
        if overwrite:
            remove_own(path.parent.glob(f"{method.folder_name}-????????.jsonl"))
        self.records = RecordFile(path, decisive)

    def results(self, progress: Progress) -> list[PairResult]:
        """Match and score all pairs that have not been; what fails is tried again next time."""
        truths = {pair.name: _fingerprint(pair.truth) for pair in self.pairs}
        done = {
            record["name"]: PAIR_RESULT.validate_python(record["result"])
            for record in self.records.records
            if truths.get(record["name"]) == record["truth"]
        }
        todo = [pair for pair in self.pairs if not pair.problem and pair.name not in done]
        budget = self.options.max_num_keypoints
        matcher = PairMatcher(self.recipe, self.features, budget, self.label, progress)
        for result in matcher.run(todo, self._scored):
            if not result.failure:
                values = json.loads(PAIR_RESULT.dump_json(result))
                record = {"name": result.name, "truth": truths[result.name], "result": values}
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
            logger.exception("%s: %s cannot be scored", self.label, pair.name)
            return self._failed(pair, f"{type(error).__name__}: {error}")
        estimate_s = time.perf_counter() - start
        return PairResult(
            **vars(score),
            name=pair.name,
            category=pair.category,
            num_matches=len(matched.points[0]),
            num_keypoints=matched.num_keypoints,
            seconds=matched.seconds + estimate_s,
            seconds_by_step={"match": matched.seconds, "estimate": estimate_s},
            level=matched.level,
            num_levels=matched.num_levels,
        )

    def _failed(self, pair: EvaluationPair, failure: str = "") -> PairResult:
        """Return the result of a pair that has no matches."""
        score, why = PairScore(math.inf, 0), failure or pair.problem
        if not why:
            failures = self.features.failures
            why = "; ".join(failures[im.name] for im in pair.images if im.name in failures)
            score = self.protocol.score(pair, NOTHING, NOTHING, self.options.random_seed)
        return PairResult(**vars(score), name=pair.name, category=pair.category, failure=why)

    def summarized(
        self, results: Sequence[PairResult], baseline: Sequence[PairResult] | None
    ) -> RecipeResult:
        num_levels: dict[str, int] = {}
        for pair, result in zip(self.pairs, results, strict=True):
            for image in pair.images:
                num_levels[image.name] = max(num_levels.get(image.name, 0), result.num_levels)
        costs = self.features.costs(num_levels)
        cost, seed = ImageCost.mean(costs), self.options.random_seed
        seconds = sum(cost.total_s for cost in costs) + sum(result.seconds for result in results)
        timed = [result.seconds_by_step for result in results if result.seconds_by_step]
        per_pair = {
            step: math.fsum(seconds[step] for seconds in timed) / max(1, len(timed))
            for step in PAIR_STEPS
        }
        successes = self._successes(results)
        p_value = None
        if baseline is not None and baseline is not results:
            p_value = paired_test(successes, self._successes(baseline), seed)
        (interval,) = bootstrap_intervals(len(results), lambda rows: [successes[rows].mean()], seed)
        by_category = _by_category(results).items()
        return RecipeResult(
            name=self.label,
            description=self.recipe.summary,
            summary={**self.protocol.summarize(results), SECONDS: seconds},
            solved=Solved(float(successes.mean()), interval),
            solved_by_category={name: float(successes[rows].mean()) for name, rows in by_category},
            p_value=p_value,
            num_images=len(costs),
            complexity=cost.complexity(),
            seconds_per_step={**cost.seconds(), **per_pair},
            failures=self.features.failures,
            warnings=self.features.warnings,
            pairs=tuple(results),
        )

    def _successes(self, results: Sequence[PairResult]) -> Array:
        return np.array([self.protocol.success(result) for result in results])


def _by_category(results: Sequence[PairResult]) -> dict[str, list[int]]:
    """Return the rows of the pairs of each category, of those that have one."""
    names = dict.fromkeys(result.category for result in results if result.category)
    return {name: [row for row, r in enumerate(results) if r.category == name] for name in names}


def _fingerprint(truth: Any) -> str:
    """Return what a truth of any type can be recognised by: all of its numbers, in words."""
    with np.printoptions(floatmode="unique", threshold=sys.maxsize):
        return hashlib.sha256(repr(truth).encode()).hexdigest()
