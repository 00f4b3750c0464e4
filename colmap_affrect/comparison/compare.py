"""Run several methods on the same photographs, cameras and pairs, and compare what they register.

What differs between methods are features and raw matches, and nothing else: cameras, images,
masks, pairs, verification, mapping and seeds are the same for all.
"""

import hashlib
import json
import pickle
import signal
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from colmap_affrect.colmap.poses import Poses, read_poses
from colmap_affrect.comparison import DEFAULT_METHODS, LEARNED_METHODS, worker
from colmap_affrect.comparison.methods import Method, parse_methods, without_weights
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.pose_scores import disagreeing_images, pose_scores
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.comparison.tables import to_json
from colmap_affrect.comparison.task import METHODS, CompareOptions, MethodTask
from colmap_affrect.errors import ComparisonError, OptionError, StaleStoreError
from colmap_affrect.features.weights import install_hint, resolve
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import Options
from colmap_affrect.pairs.base import Pair, PairOptions
from colmap_affrect.parallel.subprocesses import child
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.contents import content_of
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.record import first_difference
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace

NUM_DIGITS = 16  # of the digests of photographs on record: messages name them


def compare(
    image_path: Path,
    output_path: Path,
    options: CompareOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Comparison:
    """Find out how many photographs each method registers, and which; go on after a stop.

    Each method runs in a process of its own. One that fails is reported as failed, and the others
    go on; with ``overwrite`` methods run again though they have results there. What is returned is
    also written to ``comparison.json`` and ``report.html`` in the output folder, which is made if
    missing. Raises AffrectError for anything that the caller can mend, before any method is run.
    """
    options = options or CompareOptions()
    Workspace(output_path).require_own(image_path)
    plan = _Plan.checked(image_path, output_path, options)
    tasks = [
        MethodTask(method, output_path.resolve(), image_path.resolve(), plan.options)
        for method in plan.methods
    ]
    todo = [item.method.recipe for item in tasks if overwrite or not item.finished()]
    keys = {key for recipe in todo if recipe for key in recipe.weights}
    resolve(sorted(keys), options.resources.weights_path, progress=progress)
    with Workspace(output_path).locked():
        _require_same_inputs(plan, overwrite=overwrite)
        for task in tasks:
            task.begin(overwrite=overwrite)
        results = []
        for number, task in enumerate(tasks, 1):
            title = f"method {number} of {len(tasks)}, {task.method.label}: "
            results.append(task.finished() or _run(task, progress, title))
        comparison = Comparison(
            image_names=tuple(plan.names),
            image_path=str(image_path.resolve()),
            methods=_measured(results, plan),
            seeds=tuple(options.seeds),
            num_pairs=len(plan.pairs),
            settings=plan.settings(),
            versions=installed_versions(),
        )
        replace_text(output_path / "comparison.json", to_json(comparison))
        write_page(comparison, output_path, progress)
    return comparison


@dataclass(frozen=True)
class _Plan:
    """A comparison whose options have been checked."""

    image_path: Path
    output_path: Path
    options: CompareOptions
    methods: tuple[Method, ...]
    names: list[str]
    pairs: list[Pair]
    truth: Poses | None
    not_compared: str  # learned methods without their weights, and how these are had

    @classmethod
    def checked(cls, image_path: Path, output_path: Path, options: CompareOptions) -> Self:
        """Refuse what cannot work before anything is written."""
        lacking = without_weights(options.resources.weights_path) if not options.methods else {}
        learned = [name for name in LEARNED_METHODS if name not in lacking]
        methods = parse_methods(options.methods or [*DEFAULT_METHODS, *learned])
        if not options.seeds or len(set(options.seeds)) < len(options.seeds):
            raise OptionError(f"--seeds {','.join(map(str, options.seeds))}: give different seeds")
        options.resources.require_device()
        for seed in options.seeds:
            options.verification.changed(random_seed=seed)
        inputs = options.inputs(image_path)
        inputs.check()
        names = inputs.names()
        if len(names) < 2:
            raise ComparisonError(
                f"{image_path}: only {names[0] if names else 'no image'} to use; a comparison "
                "needs at least two images"
            )
        inputs.check_names(names)
        if options.pairs != PairOptions(match_list_path=options.pairs.match_list_path):
            raise OptionError("pairs: a comparison matches all pairs, or those of match_list_path")
        pairs = list(options.pairs_of(names))
        truth = _ground_truth(options.ground_truth_path, names)
        options = replace(options, mapping=MAPPERS.make(options.mapping).options)
        files = {file.file_name: file for group in lacking.values() for file in group}
        hint = install_hint(files.values()).removesuffix(", or ")
        absent = f"{', '.join(lacking)}: {hint}" if lacking else ""
        return cls(image_path, output_path, options, methods, names, pairs, truth, absent)

    @cached_property
    def inputs(self) -> dict[str, Any]:
        """What all methods begin with, for the record; digests stand for the files."""
        given = self.options.inputs(self.image_path)
        files = {name: given.photographs.files(name) for name in self.names}
        files[""] = given.camera_files
        digests = {name: content_of(paths).digest[:NUM_DIGITS] for name, paths in files.items()}
        masks = self.options.masks.to_mapping()
        return {
            "photographs": digests,
            "images": _fingerprint(self.names),
            "pairs": _fingerprint([f"{first}\n{second}" for first, second in self.pairs]),
            "camera": self.options.cameras.to_mapping(),
            "masks": {key: bool(path) for key, path in masks.items()},
            "verification": _without_seed(self.options.verification),
            "mapping": _without_seed(self.options.mapping),
        }

    def settings(self) -> dict[str, Any]:
        """Return the settings of all methods, for people."""
        keys = ("image_list_path", "from_database", "ground_truth_path")
        paths: dict[str, Path | None] = {key: getattr(self.options, key) for key in keys}
        return {
            **{key: self.inputs[key] for key in ("camera", "verification", "mapping")},
            "masks": self.options.masks.to_mapping(),
            **{key: str(path.resolve()) if path else "" for key, path in paths.items()},
            "match_list_path": self.options.pairs.match_list_path,
            "not_compared": self.not_compared,
            "preset": self.options.mapping.preset_name,
        }


def _without_seed(options: Options) -> dict[str, Any]:
    """Return options without their seed: a comparison runs with several."""
    return {key: value for key, value in options.to_mapping().items() if key != "random_seed"}


def _fingerprint(lines: Sequence[str]) -> dict[str, Any]:
    """Return what a list can be recognised by; the number comes first in messages."""
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()
    return {"number": len(lines), "sha256": digest}


def _ground_truth(path: Path | None, names: Sequence[str]) -> Poses | None:
    if path is None:
        return None
    truth = read_poses(path)
    if not truth.keys() & set(names):
        raise ComparisonError(
            f"{path}: shares no image name with the photographs (it has {min(truth)}, they have "
            f"{min(names)}); rename the images of one of them"
        )
    return truth


def _require_same_inputs(plan: _Plan, *, overwrite: bool) -> None:
    """Refuse methods that were run there on something else; ``overwrite`` discards them."""
    methods = plan.output_path / METHODS
    record = methods / "inputs.json"
    if record.exists():
        known = json.loads(record.read_text(encoding="utf-8"))
        if difference := first_difference(known, plan.inputs):
            if not overwrite:
                raise StaleStoreError(
                    f"{plan.output_path}: methods were compared there with {difference}; use "
                    "--overwrite to discard these results, or another --output-path"
                )
            remove_own([methods])
    elif methods.exists():
        raise StaleStoreError(
            f"{methods}: was not made here, or by an older version; it is left as it is, use "
            "another --output-path"
        )
    methods.mkdir(exist_ok=True)
    replace_text(record, json.dumps(plan.inputs, indent=1))


def _run(task: MethodTask, progress: Progress, title: str) -> MethodResult:
    """Run a method in a process of its own; what it prints goes to ``run.log`` in its folder."""
    log_path, argument = Workspace(task.folder).log, b64encode(pickle.dumps((task, title))).decode()
    with (
        log_path.open("a", encoding="utf-8") as log,
        child(worker.__name__, argument, stdout=progress.file_number, stderr=log) as process,
    ):
        process.wait()
    failed = ""
    if code := process.returncode:
        ending = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        memory = " (perhaps for want of memory)" if code == -signal.SIGKILL else ""
        failed = f"its process ended {ending}{memory}; {log_path} may say why"
    elif task.failure.exists():
        failed = task.failure.read_text(encoding="utf-8")
    return task.finished() or replace(task.begun(), seeds=(), failed=failed)


def _measured(results: Sequence[MethodResult], plan: _Plan) -> tuple[MethodResult, ...]:
    """Add what needs the models: scores against ground truth, and where models contradict."""
    folder, truth = plan.output_path, plan.truth
    poses = {
        result.name: [
            read_poses(folder / seed.model_path) if seed.model_path else {} for seed in result.seeds
        ]
        for result in results
    }
    firsts = {name: of_seeds[0] for name, of_seeds in poses.items() if of_seeds}

    def with_scores(seed: SeedResult, of_seed: Poses) -> SeedResult:
        return replace(seed, scores=pose_scores(of_seed, truth, plan.names)) if truth else seed

    def measured(result: MethodResult) -> MethodResult:
        first = firsts.get(result.name, {})
        others = {n: disagreeing_images(first, p) for n, p in firsts.items() if n != result.name}
        unstable = {name for p in poses[result.name][1:] for name in disagreeing_images(first, p)}
        return replace(
            result,
            seeds=tuple(map(with_scores, result.seeds, poses[result.name])),
            unstable_names=tuple(sorted(unstable)),
            disagreements={name: images for name, images in others.items() if images},
        )

    return tuple(map(measured, results))
