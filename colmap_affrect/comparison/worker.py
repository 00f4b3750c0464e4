"""One method of a comparison, in a process of its own: ``python -m ... TASK``.

Its peak memory is the method's, and when it dies the other methods go on. What was done stays:
run again, it goes on. Progress goes to stdout; everything else that is printed goes to stderr.
"""

import logging
import os
import pickle
import shutil
import sys
import time
from base64 import b64decode
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import (
    image_ids,
    keypoint_counts,
    open_database,
    unverified_pairs,
)
from colmap_affrect.colmap.database_copy import copy_database, copy_without_features
from colmap_affrect.colmap.initial_cameras import import_images, record_cameras
from colmap_affrect.colmap.verification import verified_pairs, verify
from colmap_affrect.comparison.methods import SIFT_AFFINE_DSP
from colmap_affrect.comparison.results import SeedResult
from colmap_affrect.comparison.sift import extract_sift, match_sift
from colmap_affrect.comparison.task import RESULT, MethodTask
from colmap_affrect.errors import AffrectError, ComparisonError
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.pairs.base import Pair
from colmap_affrect.parallel.executor import peak_memory_bytes
from colmap_affrect.parallel.subprocesses import end_with
from colmap_affrect.progress import SILENT, Progress, Stopwatch
from colmap_affrect.project.atomic_files import replace_bytes, replace_text
from colmap_affrect.project.outputs import new_results
from colmap_affrect.project.report import ModelSummary
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import Recipe
from colmap_affrect.stages.context import Context
from colmap_affrect.stages.escalate import escalate
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches

SEED_RESULT = TypeAdapter(SeedResult)  # from and to JSON

logger = logging.getLogger("colmap_affrect")


def main() -> None:
    """Run the method that the task asks for, unless its parent ends before."""
    end_with(int(sys.argv[2]))
    shown = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what others print
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    logger.addHandler(handler)
    task, title = pickle.loads(b64decode(sys.argv[1]))  # noqa: S301 (of our parent)
    try:
        with Workspace(task.folder).locked():
            _Method(task, Progress(shown, 1).titled(title)).run()
    except AffrectError as error:
        replace_text(task.failure, str(error))
    except Exception as error:
        logger.exception("failed")
        replace_text(task.failure, f"{type(error).__name__}: {error}")


class _Method:
    """A method that is run; what is done of it is on disk after every stage."""

    def __init__(self, task: MethodTask, progress: Progress) -> None:
        self.task, self.progress = task, progress
        self.options, self.result = task.all_options, task.begun()
        self.inputs = self.options.inputs(task.image_path)
        self.workspace = Workspace(task.folder)
        self.database = self.workspace.database

    def run(self) -> None:
        """Extract, match, verify and map; what is there is kept."""
        if self.task.method.recipe:
            self._match_recipe(self.task.method.recipe)
        else:
            self._match_sift()
        seeds = tuple(map(self._run_seed, self.options.seeds))
        self._keep(seeds=seeds, num_keypoints=dict(sorted(keypoint_counts(self.database).items())))

    def _keep(self, **values: Any) -> None:
        peak = max(self.result.peak_memory_bytes, peak_memory_bytes())
        self.result = replace(self.result, peak_memory_bytes=peak, **values)
        replace_bytes(self.task.result, RESULT.dump_json(self.result, by_alias=True, indent=1))

    def _stage(self, name: str, work: Callable[[], object]) -> None:
        """Do what is not done; a stage that was killed counts from where it went on."""
        if name not in self.result.wall_s:
            start = time.perf_counter()
            work()
            self._keep(wall_s={**self.result.wall_s, name: time.perf_counter() - start})

    def _match_sift(self) -> None:
        affine, names = self.task.method.label == SIFT_AFFINE_DSP, self.inputs.names()

        def extract_all() -> None:
            with self.progress.stage("extract", len(names), "images") as advance:
                failures = self._import_images(names)
                taken = [name for name in names if name not in failures]
                if not taken:
                    raise ComparisonError(f"COLMAP cannot use any of the {len(names)} images")
                images = self.task.image_path, taken, self.options.masks
                failures |= extract_sift(self.database, *images, affine=affine)
                self._keep(failures=failures)
                advance(len(names))

        def match_all() -> None:
            taken = image_ids(self.database).keys()
            pairs = [pair for pair in self.options.pairs_of(names) if taken >= set(pair)]
            with self.progress.stage("match", len(pairs), "pairs") as advance:
                match_sift(self.database, pairs)
                advance(len(pairs))

        self._stage("extract", extract_all)
        self._stage("match", match_all)

    def _import_images(self, names: Sequence[str]) -> dict[str, str]:
        """Make the database that features go into; return the images that COLMAP does not take."""
        source = self.options.from_database
        initial = None if source else self.inputs.initial_cameras
        known = read_camera_records(source.with_name("cameras.json")) if source else None
        if source and not self.database.exists():
            copy_without_features(source, self.database)
        rejected = import_images(self.database, self.task.image_path, names, self.options.cameras)
        record_cameras(self.database, self.workspace.cameras, initial, known)
        mode = self.options.cameras.mode
        reason = f"COLMAP cannot read it, or does not take it (camera mode {mode})"
        return dict.fromkeys(rejected, reason)

    def _match_recipe(self, recipe: Recipe) -> None:
        context = Context(self.workspace, self.options.resources, None, self.progress)

        def extract_all() -> None:
            self._keep(failures=extract(context, self.inputs, recipe).failures)

        self._stage("extract", extract_all)
        choose_pairs(context, self.options.pairs)
        self._stage("match", lambda: match(context))
        if self.task.method.escalates:
            verification = self.task.verification.changed(random_seed=self.options.seeds[0])
            verify_matches(replace(context, progress=SILENT), verification)
            self._stage("escalate", lambda: escalate(context))

    def _run_seed(self, seed: int) -> SeedResult:
        """Verify and map a copy of the database of the method, unless that is done."""
        folder = self.task.folder / f"seed-{seed}"
        result_path = folder / "result.json"
        if result_path.exists():
            return SEED_RESULT.validate_json(result_path.read_bytes())
        with new_results(folder) as (new,):
            new.mkdir()
            result = self._seed_result(seed, new)
            replace_bytes(new / result_path.name, SEED_RESULT.dump_json(result, by_alias=True))
        return result

    def _seed_result(self, seed: int, folder: Path) -> SeedResult:
        """Verify and map in a folder that is called after the seed when all is done."""
        database_path, watch = folder / "database.db", Stopwatch()
        copy_database(self.database, database_path)
        with open_database(database_path) as database:
            database.clear_two_view_geometries()
            names = {image.image_id: image.name for image in database.read_all_images()}
        run_seed = self._map_recipe if self.task.method.recipe else self._map_sift
        models = run_seed(seed, folder, watch, self.progress.titled(f"seed {seed}, "))
        largest = models[0] if models else ModelSummary((), 0, 0.0, 0.0)
        inliers = verified_pairs(database_path, self.task.verification.min_num_inliers)
        return SeedResult(
            seed=seed,
            model_names=tuple(item.registered_names for item in models),
            model_path=f"{self.result.folder}/{folder.name}/sparse/0" if models else "",
            num_points3D=largest.num_points3D,
            mean_track_length=largest.mean_track_length,
            mean_reprojection_error_px=largest.mean_reprojection_error_px,
            pair_inliers={_pair(*map(names.get, ids)): count for ids, count in inliers.items()},
            scores=None,
            wall_s=watch.seconds,
            doubtful=largest.doubtful,
        )

    def _map_recipe(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        context = Context(self.workspace.branch(folder), self.options.resources, None, progress)
        with watch.step("verify"):
            verify_matches(context, self.task.verification.changed(random_seed=seed))
        with watch.step("map"):
            guide(context)
            mapper = MAPPERS.make(self.task.mapping.changed(random_seed=seed))
            return map_images(context, mapper)[1]

    def _map_sift(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        path = folder / "database.db"
        options = self.task.verification.changed(random_seed=seed)
        num_pairs, num_images = len(unverified_pairs(path)), len(image_ids(path))
        with watch.step("verify"), progress.stage("verify", num_pairs, "pairs") as advance:
            verify(path, options, advance=advance)
        shutil.copy(self.workspace.cameras, folder)
        cameras, may_share = read_camera_records(self.workspace.cameras), self.options.may_share
        mapper = MAPPERS.make(self.task.mapping.changed(random_seed=seed))
        task = MappingTask(path, self.task.image_path, cameras=cameras, may_share=may_share)
        with watch.step("map"), progress.stage("map", num_images, "images") as advance:
            return map_database(mapper, task, folder / "sparse", advance)


def _pair(*names: Any) -> Pair:
    first, second = sorted(names)
    return first, second


if __name__ == "__main__":
    main()
