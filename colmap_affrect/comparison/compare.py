"""Run several methods on the same photographs, cameras and pairs, and compare what they register.

What differs between methods are features and raw matches, and nothing else: cameras, images,
masks, pairs, verification, mapping and seeds are the same for all.
"""

import json
import pickle
import signal
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from colmap_affrect.colmap.poses import Poses, read_poses
from colmap_affrect.comparison import DEFAULT_METHODS, LEARNED_METHODS, worker
from colmap_affrect.comparison.method_run import METHODS, CompareOptions, MethodRun
from colmap_affrect.comparison.methods import Method, parse_methods, without_weights
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.pose_scores import disagreeing_images, pose_scores
from colmap_affrect.comparison.results import Comparison, MethodResult
from colmap_affrect.comparison.tables import to_json
from colmap_affrect.errors import ComparisonError, OptionError, StaleStoreError
from colmap_affrect.features.weights import install_hint, resolve
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import Options, digest_of
from colmap_affrect.pairs.base import Pair, PairOptions
from colmap_affrect.parallel.subprocesses import child
from colmap_affrect.progress import SILENT, Progress
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.contents import content_of
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.record import first_difference
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.inputs import Inputs

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
    methods, not_compared = _methods(options)
    inputs, names = _checked(image_path, options)
    pairs = list(options.pairs_of(names))
    truth = _ground_truth(options.ground_truth_path, names)
    options = replace(options, mapping=MAPPERS.make(options.mapping).options)
    folders = output_path.resolve(), image_path.resolve()
    runs = [MethodRun(method, *folders, options) for method in methods]
    recipes = [run.method.recipe for run in runs if overwrite or not run.finished()]
    keys = {key for recipe in recipes if recipe for key in recipe.weights}
    resolve(sorted(keys), options.resources.weights_path, progress=progress)
    with Workspace(output_path).locked():
        same = _same_for_all(inputs, names, pairs, options)
        _require_same(same, output_path, overwrite=overwrite)
        for run in runs:
            run.begin(overwrite=overwrite)
        results = []
        for number, run in enumerate(runs, 1):
            title = f"method {number} of {len(runs)}, {run.method.label}: "
            results.append(run.finished() or _run(run, progress, title))
        comparison = Comparison(
            image_names=tuple(names),
            image_path=str(folders[1]),
            methods=_measured(results, output_path, truth, names),
            seeds=tuple(options.seeds),
            num_pairs=len(pairs),
            settings=_settings(same, options) | {"not_compared": not_compared},
            versions=installed_versions(),
        )
        replace_text(output_path / "comparison.json", to_json(comparison))
        write_page(comparison, output_path, progress)
    return comparison


def _methods(options: CompareOptions) -> tuple[tuple[Method, ...], str]:
    """Return the methods, and which learned ones are left out without weights, and the remedy."""
    if options.methods:
        return parse_methods(options.methods), ""
    lacking = without_weights(options.resources.weights_path)
    learned = [name for name in LEARNED_METHODS if name not in lacking]
    files = {file.file_name: file for group in lacking.values() for file in group}
    hint = install_hint(files.values()).removesuffix(", or ")
    absent = f"{', '.join(lacking)}: {hint}" if lacking else ""
    return parse_methods([*DEFAULT_METHODS, *learned]), absent


def _checked(image_path: Path, options: CompareOptions) -> tuple[Inputs, list[str]]:
    """Return the photographs and their names; refuse what cannot work before anything is done."""
    if not options.seeds or len(set(options.seeds)) < len(options.seeds):
        raise OptionError(f"--seeds {','.join(map(str, options.seeds))}: give different seeds")
    options.resources.require_device()
    for seed in options.seeds:
        options.verification.changed(random_seed=seed)
    if options.pairs != PairOptions(match_list_path=options.pairs.match_list_path):
        raise OptionError("pairs: a comparison matches all pairs, or those of match_list_path")
    inputs = options.inputs(image_path)
    inputs.check()
    names = inputs.names()
    if len(names) < 2:
        raise ComparisonError(
            f"{image_path}: only {names[0] if names else 'no image'} to use; a comparison "
            "needs at least two images"
        )
    inputs.check_names(names)
    return inputs, names


def _same_for_all(
    inputs: Inputs, names: Sequence[str], pairs: Sequence[Pair], options: CompareOptions
) -> dict[str, Any]:
    """Return what all methods begin with, for the record; digests stand for the files."""
    files = {name: inputs.photographs.files(name) for name in names}
    files[""] = inputs.camera_files
    masks = options.masks.to_mapping()
    return {
        "photographs": {k: content_of(paths).digest[:NUM_DIGITS] for k, paths in files.items()},
        "pairs": {"number": len(pairs), "sha256": digest_of(pairs)},
        "camera": options.cameras.to_mapping(),
        "masks": {key: bool(path) for key, path in masks.items()},
        "verification": _without_seed(options.verification),
        "mapping": _without_seed(options.mapping),
    }


def _settings(same: Mapping[str, Any], options: CompareOptions) -> dict[str, Any]:
    """Return the settings of all methods, for people."""
    paths = {
        "image_list_path": options.image_list_path,
        "from_database": options.from_database,
        "ground_truth_path": options.ground_truth_path,
    }
    return {
        **{key: same[key] for key in ("camera", "verification", "mapping")},
        "masks": options.masks.to_mapping(),
        **{key: str(path.resolve()) if path else "" for key, path in paths.items()},
        "match_list_path": options.pairs.match_list_path,
        "preset": options.mapping.preset_name,
    }


def _without_seed(options: Options) -> dict[str, Any]:
    """Return options without their seed: a comparison runs with several."""
    return {key: value for key, value in options.to_mapping().items() if key != "random_seed"}


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


def _require_same(same: Mapping[str, Any], output_path: Path, *, overwrite: bool) -> None:
    """Refuse methods that were run there on something else; ``overwrite`` discards them."""
    methods = output_path / METHODS
    record = methods / "inputs.json"
    if record.exists():
        known = json.loads(record.read_text(encoding="utf-8"))
        if difference := first_difference(known, same):
            if not overwrite:
                raise StaleStoreError(
                    f"{output_path}: methods were compared there with {difference}; use "
                    "--overwrite to discard these results, or another --output-path"
                )
            remove_own([methods])
    elif methods.exists():
        raise StaleStoreError(
            f"{methods}: was not made here, or by an older version; it is left as it is, use "
            "another --output-path"
        )
    methods.mkdir(exist_ok=True)
    replace_text(record, json.dumps(same, indent=1))


def _run(run: MethodRun, progress: Progress, title: str) -> MethodResult:
    """Run a method in a process of its own; what it prints goes to ``run.log`` in its folder."""
    log_path, argument = run.workspace.log, b64encode(pickle.dumps((run, title))).decode()
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
    elif run.failure.exists():
        failed = run.failure.read_text(encoding="utf-8")
    return run.finished() or replace(run.result, seeds=(), failed=failed)


def _measured(
    results: Sequence[MethodResult], folder: Path, truth: Poses | None, names: Sequence[str]
) -> tuple[MethodResult, ...]:
    """Add what needs the models: scores against ground truth, and where models contradict."""
    firsts, measured = dict[str, Poses](), list[MethodResult]()
    for result in results:
        seeds = []
        for seed in result.seeds:
            poses = read_poses(folder / seed.model_path) if seed.model_path else {}
            firsts.setdefault(result.name, poses)
            seeds.append(replace(seed, scores=pose_scores(poses, truth, names)) if truth else seed)
        measured.append(replace(result, seeds=tuple(seeds)))
    return tuple(
        replace(
            result,
            disagreements={
                name: images
                for name, poses in firsts.items()
                if name != result.name
                and (images := disagreeing_images(firsts.get(result.name, {}), poses))
            },
        )
        for result in measured
    )
