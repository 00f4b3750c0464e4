"""Run several methods on the same photographs, cameras and pairs, and compare what they register.

What differs between methods are features and raw matches, and nothing else: cameras, images,
masks, pairs, verification, mapping and seeds are the same for all.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from colmap_affrect.colmap.model_files import Poses, read_poses
from colmap_affrect.comparison.method_run import CompareOptions, MethodRun
from colmap_affrect.comparison.methods import parse_methods
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.results import Comparison, MethodResult, pose_scores
from colmap_affrect.comparison.tables import to_json
from colmap_affrect.comparison.worker import run_alone
from colmap_affrect.errors import AffrectError, OptionError
from colmap_affrect.features.weights import resolve
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import digest_of
from colmap_affrect.pairs.lists import Pair, PairOptions, exhaustive_pairs, read_pairs
from colmap_affrect.progress import SILENT, Progress, show
from colmap_affrect.project.argument_types import checks_arguments
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import PathLike, as_path
from colmap_affrect.project.record import content_of
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.stages.context import Inputs

NUM_DIGITS = 16  # of the digests of photographs on record: messages name them


@checks_arguments
def compare(
    image_path: PathLike,
    output_path: PathLike,
    options: CompareOptions | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = SILENT,
) -> Comparison:
    """Find out how many photographs each method registers, and which; go on after a stop.

    Each method runs in a process of its own; one that fails is reported, and the others go on. With
    ``overwrite`` methods run again. Writes ``comparison.json`` and ``report.html``, too. Raises
    AffrectError for anything that the caller can mend, before any method is run.
    """
    image_path, output_path = as_path(image_path), as_path(output_path)
    options = options or CompareOptions()
    Workspace(output_path).require_own(image_path)
    Workspace(output_path).refuse_run()
    methods = parse_methods(options.methods)
    inputs, names = _checked(image_path, options)
    listed = options.pairs.match_list_path
    pairs = list(read_pairs(Path(listed), names, image_path)) if listed else exhaustive_pairs(names)
    truth = _ground_truth(options.ground_truth_path, names)
    options = replace(options, mapping=MAPPERS.make(options.mapping).options)
    same = _same_for_all(inputs, names, pairs, options)
    given = output_path.resolve(), image_path.resolve(), options, same
    runs = [MethodRun(method, *given) for method in methods]
    recipes = [run.method.recipe for run in runs if overwrite or not run.finished()]
    keys = {key for recipe in recipes if recipe for key in recipe.required_weights}
    resolve(sorted(keys), options.resources.weights_path, progress=progress)
    with Workspace(output_path).locked():
        for run in runs:
            run.begin(overwrite=overwrite)
        results, units, pace, start_s = [], len(names) + len(pairs) / 4, 1.0, time.monotonic()
        left = {run.method.label: units * run.seconds for run in runs if not run.finished()}
        total = sum(left.values())
        for number, run in enumerate(runs, 1):
            title = f"method {number} of {len(runs)}, {run.method.label}: "
            if run.method.label in left and progress.stream:
                minutes = max(1.0, pace * sum(left.values()) / 60)
                show(f"{title}about {minutes:.0f} min left for all", file=progress.stream)
            failed = "" if run.finished() else run_alone(run, title, progress)
            if left.pop(run.method.label, 0.0):
                pace = (time.monotonic() - start_s) / (total - sum(left.values()))
            found = run.finished() or replace(run.result, seeds=())
            results.append(replace(found, failed=failed or found.failed))
        if truth:
            results = [_measured(result, output_path, truth, names) for result in results]
        comparison = Comparison(
            image_names=tuple(names),
            image_path=str(image_path.resolve()),
            methods=tuple(results),
            seeds=tuple(options.seeds),
            num_pairs=len(pairs),
            settings=_settings(same, options),
            versions=installed_versions(),
        )
        replace_text(output_path / "comparison.json", to_json(comparison))
        write_page(comparison, output_path, progress)
    return comparison


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
        only = f"only {names[0] if names else 'no image'} to use"
        raise AffrectError(f"{image_path}: {only}; a comparison needs at least two images")
    inputs.check_names(names)
    return inputs, names


def _same_for_all(
    inputs: Inputs, names: Sequence[str], pairs: Sequence[Pair], options: CompareOptions
) -> dict[str, Any]:
    """Return what all methods begin with, for the record; digests stand for the files."""
    files = {name: inputs.photographs.files(name) for name in names}
    files[""] = inputs.camera_files
    but_seeds: dict[str, Any] = {"mode": "json", "exclude_none": True, "exclude": {"random_seed"}}
    return {
        "photographs": {k: content_of(paths).digest[:NUM_DIGITS] for k, paths in files.items()},
        "pairs": {"number": len(pairs), "sha256": digest_of(pairs)},
        "camera": options.cameras.to_mapping(),
        "masks": {key: bool(path) for key, path in options.masks.to_mapping().items()},
        "verification": options.verification.model_dump(**but_seeds),
        "mapping": options.mapping.model_dump(**but_seeds),
    }


def _settings(same: Mapping[str, Any], options: CompareOptions) -> dict[str, Any]:
    return {
        **{key: value for key, value in same.items() if key != "photographs"},
        "image_list_path": str(options.image_list_path or ""),
        "from_database": str(options.from_database or ""),
        "ground_truth_path": str(options.ground_truth_path or ""),
        "match_list_path": options.pairs.match_list_path,
        "preset": options.mapping.preset_name,
    }


def _ground_truth(path: Path | None, names: Sequence[str]) -> Poses | None:
    if path is None:
        return None
    truth = read_poses(path)
    if not truth.keys() & set(names):
        raise AffrectError(
            f"{path}: shares no image name with the photographs (it has {min(truth)}, they have "
            f"{min(names)}); rename the images of one of them"
        )
    return truth


def _measured(
    result: MethodResult, folder: Path, truth: Poses, names: Sequence[str]
) -> MethodResult:
    """Add the scores of the models against ground truth."""
    seeds = []
    for seed in result.seeds:
        poses = read_poses(folder / seed.model_path) if seed.model_path else {}
        seeds.append(replace(seed, scores=pose_scores(poses, truth, names)))
    return replace(result, seeds=tuple(seeds))
