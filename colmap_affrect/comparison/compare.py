"""Run several methods on the same photographs, cameras and pairs, and compare what they register.

What differs between methods are features and raw matches, and nothing else: cameras, images,
masks, pairs, verification, mapping and seeds are the same for all.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import signal
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from colmap_affrect.children import child
from colmap_affrect.colmap.copies import copy_without_features
from colmap_affrect.colmap.database import check_cameras, image_ids, import_images
from colmap_affrect.colmap.mapping import checked_mapping_options
from colmap_affrect.comparison import worker
from colmap_affrect.comparison.methods import (
    DEFAULT_METHODS,
    Method,
    parse_methods,
    unique_methods,
)
from colmap_affrect.comparison.metrics import Poses, disagreeing_images, pose_scores, read_poses
from colmap_affrect.comparison.request import Layout, Request
from colmap_affrect.comparison.results import Comparison, MethodResult, SeedResult
from colmap_affrect.errors import ComparisonError, OptionError, StaleStoreError
from colmap_affrect.files import replace_text
from colmap_affrect.imaging import require_png
from colmap_affrect.matching.pairs import Pair, exhaustive_pairs, read_pairs, write_pairs
from colmap_affrect.options import CameraOptions
from colmap_affrect.photographs import Photographs, refuse_colliding_keys, refuse_mixed_sizes
from colmap_affrect.pipeline import InputOptions, installed_versions
from colmap_affrect.progress import SILENT, Advance, Progress
from colmap_affrect.report.page import write_page
from colmap_affrect.stages import images_to_use
from colmap_affrect.workspace import Workspace, first_difference

DEFAULT_SEEDS = (0, 1, 2)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(InputOptions):
    """Everything a comparison depends on beside its images and its output folder.

    Attributes:
        methods: names of methods as the command line takes them, or methods.
        seeds: of verification and mapping, which run once for each.
        ground_truth_path: folder of a COLMAP model with true poses, in any frame; None for none.
    """

    methods: Sequence[str | Method] = DEFAULT_METHODS
    seeds: Sequence[int] = DEFAULT_SEEDS
    ground_truth_path: Path | None = None


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
    go on.

    Args:
        image_path: folder of the photographs, searched with its sub-folders.
        output_path: folder for all results, made if missing.
        options: see :class:`CompareOptions`.
        overwrite: run the methods again though they have results there.
        progress: where to show progress.

    Returns:
        What is also written to ``comparison.json``, ``comparison.csv`` and ``report.html``.

    Raises:
        AffrectError: for anything that the caller can mend, before any method is run.
    """
    require_png()
    options = options or CompareOptions()
    plan = _Plan.checked(image_path, Layout(output_path), options)
    with Workspace(output_path).locked():
        unreadable = _share(plan, overwrite=overwrite)
        requests = plan.requests()
        for request in requests:
            _claim(request, overwrite=overwrite)
        results = [_finished(request) or _run(request, progress) for request in requests]
        results = [
            replace(result, failures={**unreadable, **result.failures}) for result in results
        ]
        comparison = Comparison(
            image_names=tuple(plan.names),
            image_path=str(image_path.resolve()),
            methods=_measured(results, plan),
            seeds=tuple(options.seeds),
            num_pairs=len(plan.pairs),
            settings=plan.settings(),
            versions=installed_versions(),
        )
        replace_text(output_path / "comparison.json", comparison.to_json())
        replace_text(output_path / "comparison.csv", comparison.to_csv())
        write_page(comparison, output_path, progress, options.resources)
    return comparison


@dataclass(frozen=True)
class _Plan:
    """A comparison whose options have been checked.

    Attributes:
        image_path: folder of the images.
        layout: of the output folder.
        options: with checked mapping options.
        methods: the methods.
        names: all images given, sorted.
        pairs: to match.
        truth: true poses; None without ground truth.
    """

    image_path: Path
    layout: Layout
    options: CompareOptions
    methods: tuple[Method, ...]
    names: list[str]
    pairs: list[Pair]
    truth: Poses | None

    @classmethod
    def checked(cls, image_path: Path, layout: Layout, options: CompareOptions) -> _Plan:
        """Refuse what cannot work before anything is written."""
        methods = _methods(options.methods)
        if not options.seeds or len(set(options.seeds)) < len(options.seeds):
            raise OptionError(f"--seeds {','.join(map(str, options.seeds))}: give different seeds")
        mapping = checked_mapping_options(options.mapping)
        check_cameras(options.cameras)
        Photographs(image_path, options.cameras, options.masks).check()
        names = images_to_use(image_path, options.image_list_path, options.from_database)
        if len(names) < 2:
            raise ComparisonError(
                f"{image_path}: only {names[0] if names else 'no image'} to use; a comparison "
                "needs at least two images"
            )
        refuse_colliding_keys(names)
        if options.from_database and options.cameras != CameraOptions():
            raise OptionError(
                f"the cameras of {options.from_database} are used; leave out camera mode, model "
                "and parameters"
            )
        if options.cameras.mode in ("single", "per-folder"):
            refuse_mixed_sizes(image_path, names, options.cameras.mode, {})
        pairs = exhaustive_pairs(names)
        if options.match_list_path:
            pairs = read_pairs(options.match_list_path, names)
        truth = _ground_truth(options.ground_truth_path, names)
        options = replace(options, mapping=mapping)
        return cls(image_path, layout, options, methods, names, pairs, truth)

    def inputs(self) -> dict[str, Any]:
        """Return what the results of every method depend on."""
        options = self.options
        return {
            "image_path": str(self.image_path.resolve()),
            "from_database": _absolute(options.from_database),
            "images": _fingerprint(self.names),
            "pairs": _fingerprint([f"{first}\n{second}" for first, second in self.pairs]),
            "camera": options.cameras.to_mapping(),
            "masks": options.masks.to_mapping(),
            "verification": options.verification.to_mapping(),
            "mapping": options.mapping.to_mapping(),
        }

    def settings(self) -> dict[str, Any]:
        """Return what all methods had, for the report."""
        options = self.options
        return {
            "camera": options.cameras.to_mapping(),
            "masks": options.masks.to_mapping(),
            "image_list_path": _absolute(options.image_list_path),
            "match_list_path": _absolute(options.match_list_path),
            "from_database": _absolute(options.from_database),
            "ground_truth_path": _absolute(options.ground_truth_path),
            "preset": options.mapping.preset_name,
            "verification": options.verification.to_mapping(),
            "mapping": options.mapping.to_mapping(),
        }

    def requests(self) -> list[Request]:
        """Return what the process of each method is to do."""
        options = self.options
        return [
            Request(
                method=method,
                output_path=self.layout.path.resolve(),
                image_path=self.image_path.resolve(),
                masks=options.masks,
                verification=options.verification,
                mapping=options.mapping,
                intrinsics_given=bool(options.cameras.params),
                seeds=tuple(options.seeds),
                resources=options.resources,
            )
            for method in self.methods
        ]


def _methods(given: Sequence[str | Method]) -> tuple[Method, ...]:
    """Parse the names among the methods; no two may have one name."""
    methods = [
        method
        for item in given
        for method in ([item] if isinstance(item, Method) else parse_methods([item]))
    ]
    return unique_methods(methods)


def _absolute(path: Path | None) -> str:
    return str(path.resolve()) if path else ""


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

    Returns:
        Images that COLMAP does not take, with the reason.

    Raises:
        StaleStoreError: when they were made for something else.
    """
    layout, inputs = plan.layout, plan.inputs()
    if layout.inputs.exists():
        known = json.loads(layout.inputs.read_text(encoding="utf-8"))
        difference = first_difference(known, inputs)
        if difference and not overwrite:
            raise StaleStoreError(
                f"{layout.path}: methods were compared there with {difference}; use --overwrite "
                "to discard these results, or another --output-path"
            )
        if difference:
            shutil.rmtree(layout.methods, ignore_errors=True)
            shutil.rmtree(layout.shared)
    elif layout.shared.exists() or layout.methods.exists():
        raise StaleStoreError(
            f"{layout.path}: has a folder named shared or methods that was not made here; it is "
            "left as it is, use another --output-path"
        )
    if not layout.shared.exists():
        _make_shared(plan, inputs)
    reason = f"COLMAP cannot read it, or does not take it (camera mode {plan.options.cameras.mode})"
    return dict.fromkeys(sorted(set(plan.names) - set(layout.image_names())), reason)


def _make_shared(plan: _Plan, inputs: Mapping[str, Any]) -> None:
    """Make the shared folder, which appears as a whole."""
    partial = plan.layout.shared.with_name("shared.partial")
    shutil.rmtree(partial, ignore_errors=True)
    new = Layout(plan.layout.path, shared_name=partial.name)
    try:
        partial.mkdir()
        if plan.options.from_database:
            copy_without_features(plan.options.from_database, new.database)
        else:
            import_images(new.database, plan.image_path, plan.names, plan.options.cameras)
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
        replace_text(new.inputs, json.dumps(inputs, indent=1))
        partial.rename(plan.layout.shared)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _claim(request: Request, *, overwrite: bool) -> None:
    """Put a request on record before its method is run.

    Raises:
        StaleStoreError: when there are results of other options.
    """
    folder, path, name = request.folder, request.path, request.method.label
    if path.exists() and overwrite:
        shutil.rmtree(folder)
    if path.exists():
        known = Request.from_json(path.read_text(encoding="utf-8"))
        difference = first_difference(known.decisive(), request.decisive())
        if difference:
            raise StaleStoreError(
                f"{folder}: {name} was run there with {difference}; use --overwrite to redo the "
                "methods that are named, another name (NAME=RECIPE), or another --output-path"
            )
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(path, request.to_json())


def _finished(request: Request) -> MethodResult | None:
    """Return the result of a method that has been run with the same seeds."""
    if not request.result.exists():
        return None
    content = json.loads(request.result.read_text(encoding="utf-8"))
    if content["seeds"] != list(request.seeds):
        return None
    return MethodResult.from_mapping(request.method.label, content["result"])


def _run(request: Request, progress: Progress) -> MethodResult:
    """Run a method in a process of its own; what it prints goes to ``run.log`` in its folder."""
    failed = ""
    with (
        request.log.open("a", encoding="utf-8") as log,
        child(worker.__name__, str(request.path), stderr=log) as process,
        ExitStack() as stage,
    ):
        advance: Advance = stage.enter_context(SILENT.stage("", 0, ""))
        for line in process.stdout or ():
            event = json.loads(line)
            if "stage" in event:
                title = f"{request.method.label}: {event['stage']}"
                advance = stage.enter_context(progress.stage(title, event["total"], event["unit"]))
            elif "advance" in event:
                advance(event["advance"])
            elif "end" in event:
                stage.close()
            else:
                failed = event["failed"]
    if process.returncode and not failed:
        failed = f"its process ended {_ending(process.returncode)}; {request.log} may say why"
    result = None if failed else _finished(request)
    return result or MethodResult(
        request.method.label,
        request.method.summary,
        folder=request.folder.relative_to(request.output_path).as_posix(),
        failed=failed,
    )


def _ending(code: int) -> str:
    """Say how a process ended by its exit code."""
    if code == -signal.SIGKILL:
        return "by SIGKILL (perhaps for want of memory)"
    return f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"


def _measured(results: Sequence[MethodResult], plan: _Plan) -> tuple[MethodResult, ...]:
    """Add what needs the models: scores against ground truth, and where models contradict."""
    poses = {
        (result.name, seed.seed): read_poses(plan.layout.path / seed.model_path)
        for result in results
        for seed in result.seeds
        if seed.model_path
    }
    first = plan.options.seeds[0]

    def scored(result: MethodResult, seed: SeedResult) -> SeedResult:
        if plan.truth is None:
            return seed
        estimated = poses.get((result.name, seed.seed), {})
        return replace(seed, scores=pose_scores(estimated, plan.truth, plan.names))

    def contradicting(name1: str, seed1: int, name2: str, seed2: int) -> tuple[str, ...]:
        return disagreeing_images(poses.get((name1, seed1), {}), poses.get((name2, seed2), {}))

    measured = []
    for result in results:
        name = result.name
        unstable = {
            image
            for seed in result.seeds[1:]
            for image in contradicting(name, first, name, seed.seed)
        }
        others = {
            other.name: contradicting(name, first, other.name, first)
            for other in results
            if other is not result
        }
        measured.append(
            replace(
                result,
                seeds=tuple(scored(result, seed) for seed in result.seeds),
                unstable_names=tuple(sorted(unstable)),
                disagreements={other: images for other, images in others.items() if images},
            )
        )
    return tuple(measured)
