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
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import image_ids
from colmap_affrect.colmap.database_copy import copy_without_features
from colmap_affrect.colmap.initial_cameras import import_images, record_cameras
from colmap_affrect.colmap.poses import Poses, read_poses
from colmap_affrect.comparison import DEFAULT_METHODS, LEARNED_METHODS, worker
from colmap_affrect.comparison.methods import Method, parse_methods, without_weights
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.pose_scores import disagreeing_images, pose_scores
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.comparison.tables import to_json
from colmap_affrect.comparison.task import CompareOptions, Layout, MethodTask
from colmap_affrect.errors import ComparisonError, OptionError, StaleStoreError
from colmap_affrect.features.weights import install_hint, resolve
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import Options
from colmap_affrect.pairs.base import Pair, PairOptions
from colmap_affrect.pairs.lists import exhaustive_pairs, read_pairs, write_pairs
from colmap_affrect.parallel.subprocesses import child
from colmap_affrect.progress import SILENT, Advance, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.contents import content_of
from colmap_affrect.project.outputs import new_results, remove_own
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
    plan = _Plan.checked(image_path, Layout(output_path), options)
    tasks = [
        MethodTask(method, output_path.resolve(), image_path.resolve(), plan.options)
        for method in plan.methods
    ]
    todo = [item.method.recipe for item in tasks if overwrite or not item.finished()]
    keys = {key for recipe in todo if recipe for key in recipe.weights}
    resolve(sorted(keys), options.resources.weights_path, progress=progress)
    with Workspace(output_path).locked():
        unreadable = _share(plan, overwrite=overwrite)
        for task in tasks:
            task.begin(overwrite=overwrite)
        results = []
        for number, task in enumerate(tasks, 1):
            title = f"method {number} of {len(tasks)}, {task.method.label}"
            result = task.finished() or _run(task, progress, title)
            results.append(replace(result, failures={**unreadable, **result.failures}))
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
    layout: Layout
    options: CompareOptions
    methods: tuple[Method, ...]
    names: list[str]
    pairs: list[Pair]
    truth: Poses | None
    not_compared: str  # learned methods without their weights, and how these are had

    @classmethod
    def checked(cls, image_path: Path, layout: Layout, options: CompareOptions) -> Self:
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
        match_list = options.pairs.match_list_path
        if options.pairs != PairOptions(match_list_path=match_list):
            raise OptionError("pairs: a comparison matches all pairs, or those of match_list_path")
        pairs = read_pairs(Path(match_list), names) if match_list else exhaustive_pairs(names)
        truth = _ground_truth(options.ground_truth_path, names)
        options = replace(options, mapping=MAPPERS.make(options.mapping).options)
        files = {file.file_name: file for group in lacking.values() for file in group}
        hint = install_hint(files.values()).removesuffix(", or ")
        absent = f"{', '.join(lacking)}: {hint}" if lacking else ""
        return cls(image_path, layout, options, methods, names, list(pairs), truth, absent)

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


def _share(plan: _Plan, *, overwrite: bool) -> dict[str, str]:
    """Make the database and the lists that all methods begin with, unless they are there.

    Returns the images that COLMAP does not take, with the reason. Raises StaleStoreError when the
    lists were made for something else.
    """
    layout = plan.layout
    if layout.inputs.exists():
        known = json.loads(layout.inputs.read_text(encoding="utf-8"))
        if difference := first_difference(known, plan.inputs):
            if not overwrite:
                raise StaleStoreError(
                    f"{layout.path}: methods were compared there with {difference}; use "
                    "--overwrite to discard these results, or another --output-path"
                )
            remove_own([layout.methods, layout.shared])
    elif layout.shared.exists() or layout.methods.exists():
        raise StaleStoreError(
            f"{layout.path}: has a folder named shared or methods that was not made here; it is "
            "left as it is, use another --output-path"
        )
    if not layout.shared.exists():
        _make_shared(plan)
    reason = f"COLMAP cannot read it, or does not take it (camera mode {plan.options.cameras.mode})"
    return dict.fromkeys(sorted(set(plan.names) - set(layout.image_names())), reason)


def _make_shared(plan: _Plan) -> None:
    """Make the shared folder, which appears as a whole."""
    with new_results(plan.layout.shared) as (folder,):
        new, options = Layout(folder.parent), plan.options
        folder.mkdir()
        initial, known = None, None
        if options.from_database:
            copy_without_features(options.from_database, new.database)
            known = read_camera_records(options.from_database.with_name(new.cameras.name))
        else:
            import_images(new.database, plan.image_path, plan.names, options.cameras)
            initial = options.inputs(plan.image_path).initial_cameras
        record_cameras(new.database, new.cameras, initial, known)
        taken = image_ids(new.database)
        names = [name for name in plan.names if name in taken]
        pairs = [pair for pair in plan.pairs if set(pair) <= taken.keys()]
        if not pairs:
            raise ComparisonError(
                f"{plan.image_path}: COLMAP can use {len(names)} of the {len(plan.names)} images, "
                "and no pair that is to be matched; a comparison needs at least two images"
            )
        replace_text(new.images, "".join(f"{name}\n" for name in names))
        write_pairs(new.pairs, pairs)
        replace_text(new.inputs, json.dumps(plan.inputs, indent=1))


def _run(task: MethodTask, progress: Progress, title: str) -> MethodResult:
    """Run a method in a process of its own; what it prints goes to ``run.log`` in its folder."""
    log_path, failed = Workspace(task.folder).log, ""
    with (
        log_path.open("a", encoding="utf-8") as log,
        child(worker.__name__, b64encode(pickle.dumps(task)).decode(), stderr=log) as process,
        ExitStack() as stage,
    ):
        advance: Advance = stage.enter_context(SILENT.stage("", 0, ""))
        for line in process.stdout or ():
            event = json.loads(line)
            if "stage" in event:
                stage.close()
                name, total = f"{title}: {event['stage']}", event["total"]
                advance = stage.enter_context(progress.stage(name, total, event["unit"]))
            elif "advance" in event:
                advance(event["advance"])
            else:
                failed = event["failed"]
    if code := process.returncode:
        ending = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        memory = " (perhaps for want of memory)" if code == -signal.SIGKILL else ""
        failed = failed or f"its process ended {ending}{memory}; {log_path} may say why"
    result = None if failed else task.finished()
    return result or MethodResult(
        task.method.label, summary=task.method.summary, folder=task.begun().folder, failed=failed
    )


def _measured(results: Sequence[MethodResult], plan: _Plan) -> tuple[MethodResult, ...]:
    """Add what needs the models: scores against ground truth, and where models contradict."""
    folder, truth = plan.layout.path, plan.truth
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
