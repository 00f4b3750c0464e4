"""Run several methods on the same photographs, cameras and pairs, and compare what they register.

What differs between methods are features and raw matches, and nothing else: cameras, images,
masks, pairs, verification, mapping and seeds are the same for all.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

from colmap_affrect.colmap.model_files import Poses, read_poses
from colmap_affrect.comparison.method_run import (
    CompareKeywords,
    CompareOptions,
    MethodRun,
)
from colmap_affrect.comparison.methods import parse_methods
from colmap_affrect.comparison.page import write_page
from colmap_affrect.comparison.results import Comparison, MethodResult, pose_scores
from colmap_affrect.comparison.tables import to_json
from colmap_affrect.comparison.worker import run_alone
from colmap_affrect.errors import AffrectError, Option, OptionError
from colmap_affrect.features.weights import resolve
from colmap_affrect.mappers.base import MAPPERS
from colmap_affrect.options import digest_of, takes_fields_of
from colmap_affrect.pairs.lists import Pair, PairOptions, exhaustive_pairs, read_pairs
from colmap_affrect.progress import GivenProgress, Progress, show
from colmap_affrect.project.argument_types import require_bools
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.paths import PathLike, as_path, resolved
from colmap_affrect.project.record import content_of
from colmap_affrect.project.report import installed_versions
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.session.context import Inputs

NUM_DIGITS = 16  # of the digests of photographs on record: messages name them; display
PAIRS_PER_IMAGE = 4  # that take roughly as long as an image, for the forecast; measured


@takes_fields_of(CompareOptions)
def compare(
    image_path: PathLike,
    output_path: PathLike,
    options: CompareOptions | None = None,
    *,
    overwrite: bool = False,
    progress: GivenProgress = None,
    **keywords: Unpack[CompareKeywords],
) -> Comparison:
    """Find out how many photographs each method registers, and which.

    Each method runs in a process of its own; one that fails is reported, and the others go on.
    Writes ``comparison.json`` and ``report.html``, too. A comparison that was stopped goes on.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: options to begin with; None for the usual ones.
        overwrite: run methods again that have results.
        progress: True shows it on standard error, False nowhere; None where somebody looks at it,
            on a terminal or in a notebook.
        keywords: fields of :class:`CompareOptions`, as ``methods=["sift", "default"]``.

    Returns:
        What each method registers, and how long it takes.

    Raises:
        OptionError: for wrong arguments, by their names.
        AffrectError: for anything else that the caller can mend, before any method is run.
    """
    image_path = as_path(image_path, "image_path")
    output_path = as_path(output_path, "output_path")
    options = CompareOptions.with_keywords(options, keywords)
    require_bools(overwrite=overwrite)
    return _compare(
        image_path=image_path,
        output_path=output_path,
        options=options,
        progress=Progress.given(progress),
        again=overwrite,
    )


def _compare(
    image_path: Path,
    output_path: Path,
    options: CompareOptions,
    progress: Progress,
    *,
    again: bool,
) -> Comparison:
    """Compare with checked arguments; ``again``: also methods that have results."""
    workspace = Workspace(output_path)
    workspace.require_own(image_path)
    workspace.refuse_run()
    methods = parse_methods(options.methods)
    inputs, names = _checked_inputs(image_path, options)
    pairs = _pairs(image_path, names, options.pairs)
    truth = _ground_truth(options.ground_truth_path, names)
    options = options.changed(mapping=MAPPERS.make(options.mapping).options)
    common = _common_record(inputs, names, pairs, options)
    runs = list[MethodRun]()
    for method in methods:
        run = MethodRun(
            method=method,
            output_path=resolved(output_path),
            image_path=resolved(image_path),
            options=options,
            inputs=common,
        )
        runs.append(run)
    _resolve_weights(runs, options, progress, overwrite=again)
    with workspace.locked():
        num_images = len(names) + len(pairs) / PAIRS_PER_IMAGE
        results = _run_methods(runs, num_images, progress, overwrite=again)
        if truth:
            results = [_scored(result, output_path, truth, names) for result in results]
        comparison = Comparison(
            image_names=tuple(names),
            image_path=str(resolved(image_path)),
            methods=tuple(results),
            seeds=tuple(options.seeds),
            num_pairs=len(pairs),
            settings=_settings(common, options),
            versions=installed_versions(),
        )
        replace_text(output_path / "comparison.json", to_json(comparison))
        write_page(comparison, output_path, progress)
    return comparison


def _pairs(image_path: Path, names: Sequence[str], options: PairOptions) -> list[Pair]:
    """Return the listed pairs, or all."""
    if options.match_list_path:
        return list(read_pairs(Path(options.match_list_path), names, image_path))
    return exhaustive_pairs(names)


def _resolve_weights(
    runs: Sequence[MethodRun],
    options: CompareOptions,
    progress: Progress,
    *,
    overwrite: bool,
) -> None:
    """Find or download the weights of all methods that are to be run."""
    keys: set[str] = set()
    for run in runs:
        is_to_be_run = overwrite or not run.finished()
        if is_to_be_run and run.method.recipe:
            keys.update(run.method.recipe.required_weights)
    resolve(sorted(keys), options.resources.weights_path, progress=progress)


def _run_methods(
    runs: Sequence[MethodRun], num_images: float, progress: Progress, *, overwrite: bool
) -> list[MethodResult]:
    """Run the methods that are not finished.

    Args:
        runs: of all methods.
        num_images: a measure of the work; a pair counts as part of an image.
        progress: where to show it, and how long all methods take by the pace of those before.
        overwrite: discard what is there.

    Returns:
        The result of each method.
    """
    for run in runs:
        run.begin(overwrite=overwrite)
    left_s = dict[str, float]()  # estimated, by the label of a method that is to be run
    for run in runs:
        if not run.finished():
            left_s[run.method.label] = num_images * run.seconds_per_image
    total_s = sum(left_s.values())
    pace = 1.0  # seconds that pass in an estimated one
    start_s = time.monotonic()
    results = []
    for number, run in enumerate(runs, 1):
        label = run.method.label
        title = f"method {number} of {len(runs)}, {label}: "
        failed = ""
        if label in left_s:
            _show_time_left(title, pace * sum(left_s.values()), progress)
            failed = run_alone(run, title, progress)
            del left_s[label]
            pace = (time.monotonic() - start_s) / (total_s - sum(left_s.values()))
        result = run.finished() or replace(run.result, seeds=())
        results.append(replace(result, failed=failed or result.failed))
    return results


def _show_time_left(title: str, left_s: float, progress: Progress) -> None:
    """Say how long all methods still take, where somebody looks at it."""
    if progress.stream:
        minutes = max(1.0, left_s / 60)
        show(f"{title}about {minutes:.0f} min left for all", file=progress.stream)


def _checked_inputs(
    image_path: Path, options: CompareOptions
) -> tuple[Inputs, list[str]]:
    """Return the photographs and their names; refuse what cannot work before anything is done."""
    if not options.seeds or len(set(options.seeds)) < len(options.seeds):
        raise OptionError(
            "give different seeds",
            where=Option("seeds", ",".join(map(str, options.seeds))),
        )
    options.resources.require_device()
    for seed in options.seeds:
        options.verification.changed(random_seed=seed)
    if options.pairs != PairOptions(match_list_path=options.pairs.match_list_path):
        raise OptionError(
            "a comparison matches all pairs, or those of match_list_path", where="pairs"
        )
    inputs = options.inputs(image_path)
    inputs.check()
    names = inputs.names()
    if len(names) < 2:
        only = f"only {names[0] if names else 'no image'} to use"
        raise AffrectError(
            only, where=image_path, advice="a comparison needs at least two images"
        )
    inputs.check_names(names)
    return inputs, names


def _common_record(
    inputs: Inputs, names: Sequence[str], pairs: Sequence[Pair], options: CompareOptions
) -> dict[str, Any]:
    """Return what all methods begin with, for the record; digests stand for the files."""
    digests = {}
    for name in names:
        digests[name] = content_of(inputs.photographs.files(name)).digest[:NUM_DIGITS]
    digests[""] = content_of(inputs.camera_files).digest[:NUM_DIGITS]
    without_seeds: dict[str, Any] = {
        "mode": "json",
        "exclude_none": True,
        "exclude": {"random_seed"},
    }
    return {
        "photographs": digests,
        "pairs": {"number": len(pairs), "sha256": digest_of(pairs)},
        "camera": options.cameras.to_mapping(),
        "masks": {key: bool(path) for key, path in options.masks.to_mapping().items()},
        "verification": options.verification.model_dump(**without_seeds),
        "mapping": options.mapping.model_dump(**without_seeds),
    }


def _settings(common: Mapping[str, Any], options: CompareOptions) -> dict[str, Any]:
    """Return what ``comparison.json`` says of the options of all methods."""
    return {
        **{key: value for key, value in common.items() if key != "photographs"},
        "image_list_path": str(options.image_list_path or ""),
        "from_database": str(options.from_database or ""),
        "ground_truth_path": str(options.ground_truth_path or ""),
        "match_list_path": options.pairs.match_list_path,
        "preset": options.mapping.preset_name,
    }


def _ground_truth(path: Path | None, names: Sequence[str]) -> Poses | None:
    """Read the true poses; AffrectError where they are of other photographs."""
    if path is None:
        return None
    truth = read_poses(path)
    if not truth.keys() & set(names):
        raise AffrectError(
            f"shares no image name with the photographs (it has {min(truth)}, they "
            f"have {min(names)})",
            where=path,
            advice="rename the images of one of them",
        )
    return truth


def _scored(
    result: MethodResult, folder: Path, truth: Poses, names: Sequence[str]
) -> MethodResult:
    """Add the scores of the models of all seeds against ground truth."""
    seeds = []
    for seed in result.seeds:
        poses = read_poses(folder / seed.model_path) if seed.model_path else {}
        seeds.append(replace(seed, scores=pose_scores(poses, truth, names)))
    return replace(result, seeds=tuple(seeds))
