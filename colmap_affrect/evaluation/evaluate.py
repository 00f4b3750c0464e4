"""Evaluate recipes on a dataset by a protocol: features, matches, scores, tables, a plot.

The output folder has ``features/`` and ``pairs/`` (scores of single pairs), both by recipe and a
digest of all that decides them, ``evaluation.json`` and ``errors.png``. An evaluation that was
stopped goes on, and after a change only what depends on it is made again.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean

from colmap_affrect.comparison.methods import Method, parse_methods
from colmap_affrect.errors import EvaluationError, OptionError, such_as
from colmap_affrect.evaluation import datasets, truths
from colmap_affrect.evaluation.data import Dataset, PairResult, ScoreOptions
from colmap_affrect.evaluation.results import (
    SECONDS,
    Evaluation,
    RecipeResult,
    published,
    write_plot,
)
from colmap_affrect.evaluation.runner import RecipeRun
from colmap_affrect.images.reading import require_png
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Resources


@dataclass(frozen=True)
class Protocol:
    """How a dataset is read and summed up."""

    load: Callable[[Path], Dataset]
    columns: Callable[[Sequence[PairResult]], dict[str, float]]  # of the table, in order
    error_title: str  # what the error of a score is, with its unit


ERROR_PX, ERROR_DEG = "mean reprojection error of the visible part (px)", "rotation error [deg]"
PROTOCOLS = {
    "evd": Protocol(datasets.load_evd, truths.homography_columns, ERROR_PX),
    "svp": Protocol(datasets.load_svp, truths.pose_columns, ERROR_DEG),
    "imc": Protocol(datasets.load_imc, truths.pose_columns, ERROR_DEG),
    "pairs": Protocol(datasets.load_pairs, truths.columns_by_kind, "error (px; poses: degrees)"),
}


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Everything an evaluation depends on beside protocol, dataset and output folder."""

    recipes: Sequence[str | Method] = ("unrectified-rootsift", "default")  # also by name
    max_num_keypoints: int | None = None  # of each image the strongest are matched; None: all
    random_seed: int = 0  # of the estimators
    scores: ScoreOptions = field(default_factory=ScoreOptions)
    resources: Resources = field(default_factory=Resources)

    def methods(self) -> tuple[Method, ...]:
        """Return the recipes as methods; OptionError for options that nothing can be made of."""
        methods = parse_methods(self.recipes)
        if self.max_num_keypoints is not None and self.max_num_keypoints < 1:
            raise OptionError(f"--max-num-keypoints {self.max_num_keypoints}: must be at least 1")
        if self.random_seed < 0:
            raise OptionError(f"--random-seed {self.random_seed}: must be at least 0")
        return methods


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

    An image or pair that cannot be used counts as failed, and the others go on; so does an
    evaluation that was stopped, unless ``overwrite`` discards features and scores of these recipes
    first. What is returned is also written to ``evaluation.json`` and ``errors.png`` in the output
    folder, which is made if missing. Raises AffrectError for anything that the caller can mend,
    before any image is worked on.
    """
    require_png()
    if protocol not in PROTOCOLS:
        raise OptionError(f"unknown protocol '{protocol}': known are {', '.join(PROTOCOLS)}")
    chosen, options = PROTOCOLS[protocol], options or EvaluateOptions()
    methods = options.methods()
    if not dataset_path.is_dir():
        raise OptionError(f"{dataset_path}: no such folder; give the folder of the dataset")
    Workspace(output_path).require_own(dataset_path)
    settings = {
        "scores": options.scores.to_mapping(),
        "random_seed": options.random_seed,
        "max_num_keypoints": options.max_num_keypoints,
    }
    inputs = {"protocol": protocol, "dataset_path": str(dataset_path.resolve())}
    with Workspace(output_path).locked():
        dataset = chosen.load(dataset_path)
        problems = [f"{pair.name}: {pair.problem}" for pair in dataset.pairs if pair.problem]
        note = f"{len(problems)} of {len(dataset.pairs)} pairs count as failed: {such_as(problems)}"
        if len(problems) == len(dataset.pairs):
            raise EvaluationError(f"{dataset_path}: no pair can be evaluated; {note}")
        given = dataset.pairs, output_path, inputs, settings, options.resources
        runs = [RecipeRun(method, *given, overwrite=overwrite) for method in methods]
        results = {run.label: run.results(progress) for run in runs}
        evaluation = Evaluation(
            protocol=protocol,
            error_title=chosen.error_title,
            dataset_path=inputs["dataset_path"],
            settings=settings,
            notes=(*dataset.notes, *([note] if problems else [])),
            recipes=tuple(_summed(run, results[run.label], chosen) for run in runs),
            published=published(protocol),
            versions=installed_versions(),
        )
        replace_text(output_path / "evaluation.json", evaluation.to_json())
        write_plot(evaluation, output_path / "errors.png")
    return evaluation


def _summed(run: RecipeRun, results: Sequence[PairResult], protocol: Protocol) -> RecipeResult:
    extracted = sorted(
        run.extracted.values(), key=lambda record: (record["image"], record["level"])
    )
    num_images = len({record["image"] for record in extracted})
    extract_s = sum(record["seconds"] for record in extracted)
    timed = [result.seconds_by_step for result in results if result.seconds_by_step]
    steps = {s: sum(each[s] for each in timed) / max(1, len(timed)) for s in ("match", "estimate")}
    total_s = extract_s + sum(result.seconds for result in results)
    return RecipeResult(
        name=run.label,
        description=run.recipe.summary,
        summary={**protocol.columns(results), SECONDS: total_s},
        solved=fmean(result.solved for result in results),
        num_images=num_images,
        seconds_per_step={"extract": extract_s / max(1, num_images), **steps},
        failures=run.failures,
        warnings={r["image"]: r["warning"] for r in extracted if r["warning"]},
        pairs=tuple(results),
    )
