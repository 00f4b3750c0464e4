"""One method of a comparison, in a process of its own: ``python -m ... TASK``.

Its peak memory is the method's, and when it dies the other methods go on. What was done stays:
run again, it goes on. Progress, and how it ended, are lines of JSON on stdout; everything else
that is printed goes to stderr.
"""

import json
import logging
import os
import pickle
import shutil
import sys
import time
from base64 import b64decode
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from pydantic import TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import (
    image_ids,
    keypoint_counts,
    open_database,
    unverified_pairs,
)
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.verification import (
    verified_pairs,
    verify,
)
from colmap_affrect.comparison.methods import SIFT_AFFINE_DSP
from colmap_affrect.comparison.results import MethodResult, SeedResult
from colmap_affrect.comparison.sift import extract_sift, match_sift, rename_images
from colmap_affrect.comparison.task import MethodTask
from colmap_affrect.errors import AffrectError
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.pairs.base import Pair, PairOptions
from colmap_affrect.pairs.lists import read_pairs
from colmap_affrect.parallel.executor import peak_memory_bytes
from colmap_affrect.parallel.subprocesses import end_with
from colmap_affrect.progress import SILENT, Advance, Progress, Stopwatch
from colmap_affrect.project.atomic_files import replace_text
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.inputs import Inputs
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

logger = logging.getLogger("colmap_affrect")


def main() -> None:
    """Run the method that the task asks for, unless its parent ends before."""
    end_with(int(sys.argv[2]))
    parent = _take_stdout()
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    try:
        task: MethodTask = pickle.loads(b64decode(sys.argv[1]))  # noqa: S301 (of our parent)
        with Workspace(task.folder).locked():
            compute(task, _Reported(parent))
    except AffrectError as error:
        _tell(parent, failed=str(error))
    except Exception as error:
        logger.exception("failed")
        _tell(parent, failed=f"{type(error).__name__}: {error}")


def compute(task: MethodTask, progress: "_Reported") -> None:
    """Extract, match, verify and map, and write ``result.json``; what is there is kept."""
    costs = _Costs(task.folder / "costs.json")
    if task.method.recipe:
        _match_recipe(task, task.method.recipe, costs, progress)
    else:
        _match_sift(task, costs, progress)
    num_keypoints, raw_matches = _count_features(task.folder / "database.db")
    seeds = tuple(_run_seed(task, seed, progress) for seed in task.all_options.seeds)
    costs.save()
    result = MethodResult(
        name=task.method.label,
        summary=task.method.summary,
        num_keypoints=num_keypoints,
        raw_matches=raw_matches,
        seeds=seeds,
        wall_s=costs.wall_s,
        peak_memory_bytes=costs.peak_memory_bytes,
        failures=costs.failures,
        options=task.options,
        folder=task.shown_folder,
    )
    content = {"seeds": task.all_options.seeds, "result": result.to_mapping()}
    replace_text(task.result, json.dumps(content, indent=1, ensure_ascii=False))


def _match_sift(task: MethodTask, costs: "_Costs", progress: "_Reported") -> None:
    affine = task.method.label == SIFT_AFFINE_DSP
    path, base = task.folder / "database.db", task.layout.database
    if not path.exists():
        copy_database(base, path)
    rename_images(path, {image_id: name for name, image_id in image_ids(base).items()})
    names = task.layout.image_names()
    pairs = read_pairs(task.layout.pairs, names)

    def extract_all() -> None:
        with progress.stage("extract", len(names), "images") as advance:
            images = task.image_path, names, task.all_options.masks
            costs.failures = extract_sift(path, *images, affine=affine)
            advance(len(names))

    def match_all() -> None:
        with progress.stage("match", len(pairs), "pairs") as advance:
            match_sift(path, pairs)
            advance(len(pairs))

    costs.stage("extract", extract_all)
    costs.stage("match", match_all)


def _match_recipe(task: MethodTask, recipe: Recipe, costs: "_Costs", progress: "_Reported") -> None:
    context = Context(Workspace(task.folder), task.all_options.resources, progress=progress)
    inputs = Inputs.of(
        task.image_path,
        image_list_path=task.layout.images,
        from_database=task.layout.database,
        masks=task.all_options.masks,
    )

    def extract_all() -> None:
        costs.failures = extract(context, inputs, recipe).failures

    costs.stage("extract", extract_all)
    choose_pairs(context, PairOptions(match_list_path=str(task.layout.pairs.resolve())))
    costs.stage("match", lambda: match(context))
    if task.method.climbs:
        verification = task.verification.changed(random_seed=task.all_options.seeds[0])
        verify_matches(replace(context, progress=SILENT), verification)
        costs.stage("escalate", lambda: escalate(context))


def _count_features(database_path: Path) -> tuple[dict[str, int], dict[Pair, int]]:
    with open_database(database_path) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        pair_ids, counts = database.read_num_matches()
    matches = {
        _pair(names, pycolmap.pair_id_to_image_pair(pair_id)): int(count)
        for pair_id, count in zip(pair_ids, counts, strict=True)
    }
    return dict(sorted(keypoint_counts(database_path).items())), matches


def _pair(names: Mapping[int, str], ids: tuple[int, int]) -> Pair:
    first, second = sorted((names[ids[0]], names[ids[1]]))
    return first, second


def _run_seed(task: MethodTask, seed: int, progress: "_Reported") -> SeedResult:
    """Verify and map a copy of the database of the method, unless that is done."""
    folder = task.folder / f"seed-{seed}"
    result_path = folder / "result.json"
    if result_path.exists():
        known = json.loads(result_path.read_text(encoding="utf-8"))
        return TypeAdapter(SeedResult).validate_python(known)
    with new_results(folder) as (new,):
        new.mkdir()
        result = _seed_result(task, seed, new, progress)
        replace_text(new / result_path.name, json.dumps(result.to_mapping(), ensure_ascii=False))
    return result


def _seed_result(task: MethodTask, seed: int, folder: Path, progress: "_Reported") -> SeedResult:
    """Verify and map in a folder that is called after the seed when all is done."""
    database_path = folder / "database.db"
    copy_database(task.folder / "database.db", database_path)
    with open_database(database_path) as database:
        database.clear_two_view_geometries()
        names = {image.image_id: image.name for image in database.read_all_images()}
    watch, told = Stopwatch(), progress.of_seed(seed)
    options = task.verification.changed(random_seed=seed)
    mapper = MAPPERS.make(task.mapping.changed(random_seed=seed))
    workspace = Workspace(task.folder).branch(folder) if task.method.recipe else Workspace(folder)
    context = Context(workspace, task.all_options.resources, progress=told)
    with watch.step("verify"):
        if task.method.recipe:
            verify_matches(context, options)
        else:
            num_pairs = len(unverified_pairs(database_path))
            with told.stage("verify", num_pairs, "pairs") as advance:
                verify(database_path, options, advance=advance)
            shutil.copy(task.layout.cameras, workspace.cameras)
    may_share = task.all_options.may_share
    with watch.step("map"):
        if task.method.recipe:
            guide(context)
            _, models = map_images(context, mapper, may_share=may_share)
        else:
            with told.stage("map", len(names), "images") as advance:
                records = read_camera_records(workspace.cameras)
                mapping = MappingTask(
                    database_path, task.image_path, cameras=records, may_share=may_share
                )
                models = map_database(mapper, mapping, folder / "sparse", advance)
    largest = models[0] if models else ModelSummary((), 0, 0.0, 0.0)
    model_path = folder / "sparse" / "0" if models else None
    model = pycolmap.Reconstruction(model_path) if model_path else pycolmap.Reconstruction()
    inliers = verified_pairs(database_path, task.verification.min_num_inliers)
    return SeedResult(
        seed=seed,
        model_names=tuple(item.registered_names for item in models),
        model_path=f"{task.shown_folder}/{folder.name}/sparse/0" if models else "",
        num_points3D=largest.num_points3D,
        mean_track_length=largest.mean_track_length,
        mean_observations=float(model.compute_mean_observations_per_reg_image()) if models else 0.0,
        mean_reprojection_error_px=largest.mean_reprojection_error_px,
        pair_inliers={_pair(names, ids): count for ids, count in inliers.items()},
        scores=None,
        wall_s=watch.seconds,
        num_observations={
            model.images[image_id].name: model.images[image_id].num_points3D
            for image_id in sorted(model.reg_image_ids())
        },
        doubtful=largest.doubtful,
        doubts=largest.doubts,
    )


class _Costs:
    """Seconds of the stages that are done, memory, and images that could not be used, on disk.

    A stage that was killed counts from where it went on.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        known = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        self.wall_s: dict[str, float] = known.get("wall_s", {})
        self.failures: dict[str, str] = known.get("failures", {})
        self.peak_memory_bytes: int = known.get("peak_memory_bytes", 0)

    def stage(self, name: str, work: Callable[[], object]) -> None:
        if name not in self.wall_s:
            start = time.perf_counter()
            work()
            self.wall_s[name] = time.perf_counter() - start
            self.save()

    def save(self) -> None:
        self.peak_memory_bytes = max(self.peak_memory_bytes, peak_memory_bytes())
        values = {key: value for key, value in vars(self).items() if key != "_path"}
        replace_text(self._path, json.dumps(values))


class _Reported(Progress):
    """Progress that is told to the parent process, in stages whose names end with the suffix."""

    def __init__(self, parent: TextIO, suffix: str = "") -> None:
        super().__init__()
        self._parent, self._suffix = parent, suffix

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[Advance]:
        _tell(self._parent, stage=f"{name}{self._suffix}", total=total, unit=unit)
        yield lambda count: _tell(self._parent, advance=count)

    def of_seed(self, seed: int) -> "_Reported":
        """Return the same whose stages name the seed."""
        return _Reported(self._parent, f", seed {seed}")


def _tell(parent: TextIO, **event: Any) -> None:
    parent.write(json.dumps(event) + "\n")
    parent.flush()


def _take_stdout() -> TextIO:
    """Return stdout for the lines of JSON; what others print goes to stderr from now on."""
    stream = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return stream


if __name__ == "__main__":
    main()
