"""One method on all images, from features to models; what is done is on disk after every stage.

``methods/NAME/`` is a workspace with the features and raw matches of a method, and
``methods/NAME/seed-K/`` has the two-view geometries and models of one seed.
"""

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import (
    image_ids,
    keypoint_counts,
    open_database,
    unverified_pairs,
)
from colmap_affrect.colmap.database_copy import copy_database, copy_without_features
from colmap_affrect.colmap.initial_cameras import import_images, record_cameras
from colmap_affrect.colmap.verification import VerificationOptions, verified_pairs, verify
from colmap_affrect.comparison.methods import SIFT_AFFINE_DSP, SIFT_COLMAP, Method
from colmap_affrect.comparison.results import MethodResult, SeedResult
from colmap_affrect.comparison.sift import extract_sift, match_sift
from colmap_affrect.errors import ComparisonError, StaleStoreError
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.mapping import map_database
from colmap_affrect.pairs.base import Pair, PairList
from colmap_affrect.pairs.lists import exhaustive_pairs, read_pairs
from colmap_affrect.parallel.executor import peak_memory_bytes
from colmap_affrect.pipeline import InputOptions
from colmap_affrect.progress import SILENT, Progress, Stopwatch
from colmap_affrect.project.atomic_files import replace_bytes
from colmap_affrect.project.outputs import new_results, remove_own
from colmap_affrect.project.record import first_difference
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

METHODS = "methods"  # folder of all methods
RESULT, SEED_RESULT = TypeAdapter(MethodResult), TypeAdapter(SeedResult)  # from and to JSON


@dataclass(frozen=True, kw_only=True)
class CompareOptions(InputOptions):
    """Everything a comparison depends on beside its images and its output folder.

    The other attributes are those of :class:`~colmap_affrect.pipeline.InputOptions`.

    Attributes:
        methods: names of methods as the command line takes them, or methods; None for those that
            need no weights, and learned ones whose weights are there.
        seeds: of verification and mapping, which run once for each.
        ground_truth_path: folder of a COLMAP model with true poses, in any frame; None for none.
    """

    methods: Sequence[str | Method] | None = None
    seeds: Sequence[int] = (0, 1, 2)
    ground_truth_path: Path | None = None

    def pairs_of(self, names: Sequence[str]) -> PairList | list[Pair]:
        """Return the pairs of images to match: those of the list if there is one, else all."""
        listed = self.pairs.match_list_path
        return read_pairs(Path(listed), names) if listed else exhaustive_pairs(names)


@dataclass
class MethodRun:
    """A method, where its results are, and how it is run."""

    method: Method
    output_path: Path  # of the comparison
    image_path: Path
    options: CompareOptions
    progress: Progress = SILENT

    def __post_init__(self) -> None:
        is_colmap = self.method.label == SIFT_COLMAP  # and all of it as COLMAP does it
        self.verification, self.mapping = self.options.verification, self.options.mapping
        if is_colmap:
            self.verification = VerificationOptions.preset("colmap")
            self.mapping = Recipe().mapper_options("colmap")
        self.workspace = Workspace(self.output_path / METHODS / self.method.folder_name)
        self.database = self.workspace.database
        self.failure = self.workspace.path / "failed.txt"  # why its process ended
        self.result_path = self.workspace.path / "result.json"
        self.result = self._read_result()

    def _read_result(self) -> MethodResult:
        """Return what is done of the method; without seeds before the last of them has ended."""
        with suppress(FileNotFoundError, ValidationError):  # of a version before: features stay
            return RESULT.validate_json(self.result_path.read_bytes())
        folder = self.workspace.path.relative_to(self.output_path).as_posix()
        method = self.method
        return MethodResult(
            method.label, summary=method.summary, folder=folder, options=self._method_options()
        )

    def _method_options(self) -> dict[str, Any]:
        """Return options of features and matching, and the seed where verification decides."""
        recipe = self.method.recipe
        if recipe is None:
            return {"affine": self.method.label == SIFT_AFFINE_DSP}
        seed = {"seed": self.options.seeds[0]} if self.method.escalates else {}
        return {**recipe.to_mapping(), **seed}

    def finished(self) -> MethodResult | None:
        """Return the result of the method if it has been run with the same seeds."""
        self.result = self._read_result()
        seeds = [seed.seed for seed in self.result.seeds]
        return self.result if seeds == list(self.options.seeds) else None

    def begin(self, *, overwrite: bool) -> None:
        """Make the folder; StaleStoreError where the method was begun with other options."""
        if overwrite:
            remove_own([self.workspace.path])
        # Both as JSON has them, in which tuples are lists.
        known, now = (
            RESULT.dump_python(result, mode="json")["options"]
            for result in (self._read_result(), MethodResult("", options=self._method_options()))
        )
        if difference := first_difference(known, now):
            raise StaleStoreError(
                f"{self.workspace.path}: {self.method.label} was run there with {difference}; use "
                "--overwrite to redo the methods that are named, another name (NAME=RECIPE), "
                "or another --output-path"
            )
        self.workspace.begin()
        self.failure.unlink(missing_ok=True)

    def run(self) -> None:
        """Extract, match, verify and map; what is there is kept."""
        if self.method.recipe:
            self._match_recipe(self.method.recipe)
        else:
            self._match_sift()
        seeds = tuple(map(self._run_seed, self.options.seeds))
        self._keep(seeds=seeds, num_keypoints=dict(sorted(keypoint_counts(self.database).items())))

    def _keep(self, **values: Any) -> None:
        peak = max(self.result.peak_memory_bytes, peak_memory_bytes())
        self.result = replace(self.result, peak_memory_bytes=peak, **values)
        replace_bytes(self.result_path, RESULT.dump_json(self.result, by_alias=True, indent=1))

    def _stage(self, name: str, work: Callable[[], object]) -> None:
        """Do what is not done; a stage that was killed counts from where it went on."""
        if name not in self.result.wall_s:
            start = time.perf_counter()
            work()
            self._keep(wall_s={**self.result.wall_s, name: time.perf_counter() - start})

    def _match_sift(self) -> None:
        inputs = self.options.inputs(self.image_path)
        affine, names = self.method.label == SIFT_AFFINE_DSP, inputs.names()

        def extract_all() -> None:
            with self.progress.stage("extract", len(names), "images") as advance:
                failures = self._import_images(inputs)
                taken = [name for name in names if name not in failures]
                if not taken:
                    raise ComparisonError(f"COLMAP cannot use any of the {len(names)} images")
                images = self.image_path, taken, self.options.masks
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

    def _import_images(self, inputs: Inputs) -> dict[str, str]:
        """Make the database that features go into; return the images that COLMAP does not take."""
        source, cameras = self.options.from_database, self.options.cameras
        initial = None if source else inputs.initial_cameras
        known = read_camera_records(source.with_name("cameras.json")) if source else None
        if source and not self.database.exists():
            copy_without_features(source, self.database)
        rejected = import_images(self.database, self.image_path, inputs.names(), cameras)
        record_cameras(self.database, self.workspace.cameras, initial, known)
        reason = f"COLMAP cannot read it, or does not take it (camera mode {cameras.mode})"
        return dict.fromkeys(rejected, reason)

    def _match_recipe(self, recipe: Recipe) -> None:
        context = Context(self.workspace, self.options.resources, None, self.progress)
        inputs = self.options.inputs(self.image_path)
        self._stage(
            "extract", lambda: self._keep(failures=extract(context, inputs, recipe).failures)
        )
        choose_pairs(context, self.options.pairs)
        self._stage("match", lambda: match(context))
        if self.method.escalates:
            verification = self.verification.changed(random_seed=self.options.seeds[0])
            verify_matches(replace(context, progress=SILENT), verification)
            self._stage("escalate", lambda: escalate(context))

    def _run_seed(self, seed: int) -> SeedResult:
        """Verify and map a copy of the database of the method, unless that is done."""
        folder = self.workspace.path / f"seed-{seed}"
        result_path = folder / "result.json"
        if result_path.exists():
            return SEED_RESULT.validate_json(result_path.read_bytes())
        with new_results(folder) as (new,):
            new.mkdir()
            result = self._seed_result(seed, new, f"{self.result.folder}/{folder.name}/sparse/0")
            replace_bytes(new / result_path.name, SEED_RESULT.dump_json(result, by_alias=True))
        return result

    def _seed_result(self, seed: int, folder: Path, model_path: str) -> SeedResult:
        """Verify and map in a folder that is called after the seed when all is done."""
        database_path, watch = folder / "database.db", Stopwatch()
        copy_database(self.database, database_path)
        with open_database(database_path) as database:
            database.clear_two_view_geometries()
            names = {image.image_id: image.name for image in database.read_all_images()}
        map_seed = self._map_recipe if self.method.recipe else self._map_sift
        models = map_seed(seed, folder, watch, self.progress.titled(f"seed {seed}, "))
        largest = models[0] if models else ModelSummary((), 0, 0.0, 0.0)
        inliers = verified_pairs(database_path, self.verification.min_num_inliers)
        return SeedResult(
            seed=seed,
            model_names=tuple(item.registered_names for item in models),
            model_path=model_path if models else "",
            num_points3D=largest.num_points3D,
            mean_track_length=largest.mean_track_length,
            mean_reprojection_error_px=largest.mean_reprojection_error_px,
            pair_inliers={
                (min(names[i], names[j]), max(names[i], names[j])): count
                for (i, j), count in inliers.items()
            },
            scores=None,
            wall_s=watch.seconds,
            doubtful=largest.doubtful,
        )

    def _map_recipe(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        context = Context(self.workspace.branch(folder), self.options.resources, None, progress)
        with watch.step("verify"):
            verify_matches(context, self.verification.changed(random_seed=seed))
        with watch.step("map"):
            guide(context)
            return map_images(context, MAPPERS.make(self.mapping.changed(random_seed=seed)))[1]

    def _map_sift(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        path, options = folder / "database.db", self.verification.changed(random_seed=seed)
        num_pairs, num_images = len(unverified_pairs(path)), len(image_ids(path))
        with watch.step("verify"), progress.stage("verify", num_pairs, "pairs") as advance:
            verify(path, options, advance=advance)
        shutil.copy(self.workspace.cameras, folder)
        cameras, may_share = read_camera_records(self.workspace.cameras), self.options.may_share
        mapper = MAPPERS.make(self.mapping.changed(random_seed=seed))
        task = MappingTask(path, self.image_path, cameras=cameras, may_share=may_share)
        with watch.step("map"), progress.stage("map", num_images, "images") as advance:
            return map_database(mapper, task, folder / "sparse", advance)
