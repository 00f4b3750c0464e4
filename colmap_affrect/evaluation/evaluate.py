"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables.

``features/`` are by recipe and a digest of what decides them: only what changed is made again.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import fmean

from colmap_affrect.comparison.methods import parse_methods
from colmap_affrect.errors import OptionError
from colmap_affrect.evaluation import datasets, truths
from colmap_affrect.evaluation.datasets import Pairs
from colmap_affrect.evaluation.results import SECONDS, Evaluation, RecipeResult, published
from colmap_affrect.evaluation.runner import EvaluateOptions, RecipeRun
from colmap_affrect.evaluation.truths import PairResult
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace

PROTOCOLS: dict[str, Callable[[Path], Pairs]] = {
    "evd": datasets.load_evd,
    "svp": datasets.load_svp,
    "imc": datasets.load_imc,
    "pairs": datasets.load_pairs,
}
"""How datasets are read."""


def evaluate(
    protocol: str,
    dataset_path: Path,
    output_path: Path,
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
    scores, budget = asdict(options.scores), options.max_num_keypoints
    inputs = {"protocol": protocol, "dataset_path": str(dataset_path.resolve())}
    with Workspace(output_path).locked():
        pairs = PROTOCOLS[protocol](dataset_path)
        given = pairs, output_path, inputs, options
        runs = [RecipeRun(method, *given, overwrite=overwrite) for method in methods]
        results = {run.label: run.results(progress) for run in runs}
        evaluation = Evaluation(
            protocol=protocol,
            dataset_path=inputs["dataset_path"],
            settings={"scores": scores, "max_num_keypoints": budget},
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
