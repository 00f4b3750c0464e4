"""One method on all images, from features to models; what is done is on disk after every stage.

``methods/NAME/`` is a workspace with the features and raw matches of a method, and
``methods/NAME/seed-K/`` has the two-view geometries and models of one seed.

COLMAP's own SIFT goes another way to features and matches.
"""

import itertools
import json
import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from colmap_affrect.colmap import pycolmap
from colmap_affrect.colmap.cameras import read_camera_records
from colmap_affrect.colmap.database import image_ids, open_database, unverified_pairs
from colmap_affrect.colmap.database_copy import copy_database
from colmap_affrect.colmap.database_verification import verified_pairs, verify
from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.comparison import DEFAULT_METHODS
from colmap_affrect.comparison.methods import SIFT_COLMAP, GivenMethods, Method
from colmap_affrect.comparison.results import MethodResult, SeedResult
from colmap_affrect.errors import AffrectError, ConflictError, Option, damage
from colmap_affrect.escalation.map_and_rematch import map_and_rematch
from colmap_affrect.images.masks import encode_mask
from colmap_affrect.images.photographs import MaskOptions, Photographs
from colmap_affrect.mappers.base import MAPPERS, MappingTask
from colmap_affrect.mappers.mapping import map_database, read_summaries
from colmap_affrect.mappers.sparse import SparseOptions
from colmap_affrect.pairs.lists import Pair, read_pairs
from colmap_affrect.parallel.executor import peak_memory_bytes
from colmap_affrect.progress import SILENT, Progress, Stopwatch
from colmap_affrect.project.atomic_files import replace_bytes, replace_text
from colmap_affrect.project.image_failures import ImageFailure
from colmap_affrect.project.outputs import new_results, remove_own, temporary_folder
from colmap_affrect.project.paths import GivenPath, PathLike
from colmap_affrect.project.reasons import texts_of
from colmap_affrect.project.record import first_difference
from colmap_affrect.project.report import ModelSummary, largest_of
from colmap_affrect.project.sealed_json import read_sealed, write_sealed
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import AnyMapper, Recipe
from colmap_affrect.session.context import Context
from colmap_affrect.session.database_export import add_images
from colmap_affrect.session.run_options import InputKeywords, InputOptions
from colmap_affrect.session.view_graph import ViewGraph
from colmap_affrect.stages.extract import extract
from colmap_affrect.stages.guide import guide
from colmap_affrect.stages.map import map_images
from colmap_affrect.stages.match import match
from colmap_affrect.stages.pairs import choose_pairs
from colmap_affrect.stages.verify import verify_matches


def extract_sift(
    database_path: Path,
    image_path: Path,
    image_names: Sequence[str],
    masks: MaskOptions,
) -> dict[str, ImageFailure]:
    """Extract SIFT features of images of a database by COLMAP's default options.

    Features that are there are kept. Images and masks that claim more pixels than photographs have
    are left out: COLMAP takes memory for whatever a header claims.

    Args:
        database_path: the database, which has the images.
        image_path: folder of the images.
        image_names: of the images.
        masks: where masks are.

    Returns:
        The images without features, with the reason.
    """
    photographs = Photographs(image_path, masks)
    failures = dict[str, ImageFailure]()
    usable = list[str]()
    for name in image_names:
        why = photographs.why_impossible(name)
        if why:
            failures[name] = why
        else:
            usable.append(name)
    with masks_for_colmap(photographs, usable) as mask_path:
        reader = pycolmap.ImageReaderOptions(
            mask_path=mask_path, camera_mask_path=masks.camera_path
        )
        if usable:  # pycolmap takes no names for all
            pycolmap.extract_features(
                database_path, image_path, usable, reader_options=reader
            )
    ids = image_ids(database_path)
    with open_database(database_path) as database:
        for name in usable:
            if not database.exists_keypoints(ids[name]):
                failures[name] = ImageFailure("unread_by_colmap")
    return failures


@contextmanager
def masks_for_colmap(photographs: Photographs, names: Sequence[str]) -> Iterator[str]:
    """Yield a folder of masks that has those of alpha channels, too: COLMAP does not look there."""
    mask_paths = {name: photographs.own_mask(name) for name in names}
    alphas = photographs.alpha_masks([name for name in names if not mask_paths[name]])
    if not alphas:
        yield photographs.masks.path
        return
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            target = Path(folder) / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            mask_path = mask_paths[name]
            if name in alphas:
                replace_bytes(target, encode_mask(alphas[name]))
            elif mask_path:
                shutil.copy(mask_path, target)
        yield folder


def match_sift(database_path: Path, pairs: Sequence[Pair] | None) -> None:
    """Match pairs of images by COLMAP's defaults, without verification.

    Args:
        database_path: the database, which has the features.
        pairs: of image names; None for all.

    Raises:
        AffrectError: a listed name has a space, which COLMAP's lists of pairs cannot hold.
    """
    options = pycolmap.FeatureMatchingOptions(skip_geometric_verification=True)
    if pairs is None:
        pycolmap.match_exhaustive(database_path, matching_options=options)
        return
    for name in itertools.chain.from_iterable(pairs):
        if " " in name:
            raise AffrectError(
                "COLMAP matches no listed names with spaces",
                where=name,
                advice="rename it",
            )
    lines = [f"{first} {second}\n" for first, second in pairs]
    with temporary_folder(database_path.parent) as folder:
        list_path = folder / "pairs.txt"
        replace_text(list_path, "".join(lines))
        listed = pycolmap.ImportedPairingOptions(match_list_path=list_path)
        pycolmap.match_image_pairs(database_path, options, listed)


METHODS = "methods"  # folder of all methods
RESULT_JSON = TypeAdapter(MethodResult)
# Rough seconds of an image with its share of the pairs: a forecast begins with them, and goes on by
# the pace of the methods that are done. Measured on two cores:
SIFT_SECONDS = 0.5
RECIPE_SECONDS = 1.5
ESCALATION_SECONDS = 6.0


class CompareOptions(InputOptions):
    """Everything a comparison depends on beside its images and its output folder.

    Options of a part, as ``cameras``, may be a dictionary, and ``mapping`` a name.
    """

    mapping: AnyMapper = SparseOptions()
    """The mapper and its options, the same for all methods."""
    methods: GivenMethods = DEFAULT_METHODS
    """``sift-colmap``, ``sift``, or recipes, as ``NAME`` or ``LABEL=NAME:OPTION=VALUE``."""
    # Resource: three show how far results spread
    seeds: Annotated[tuple[int, ...], Field(strict=False)] = (0, 1, 2)
    """Of verification and mapping, which run once for each."""
    ground_truth_path: GivenPath | None = None
    """COLMAP model with true poses, in any frame."""


class CompareKeywords(InputKeywords, total=False):
    """The fields of :class:`CompareOptions` as keywords of a function."""

    methods: str | Sequence[str | Method]
    seeds: Sequence[int]
    ground_truth_path: PathLike | None


@dataclass
class MethodRun:
    """Runs a method, and keeps what it has done in a folder."""

    method: Method
    output_path: Path  # folder of the comparison
    image_path: Path
    options: CompareOptions
    inputs: Mapping[str, Any]  # what all methods begin with, for the record
    progress: Progress = SILENT

    def __post_init__(self) -> None:
        self.verification = self.options.verification
        self.mapping = self.options.mapping
        if self.method.label == SIFT_COLMAP:  # all of it as COLMAP does it
            self.verification = VerificationOptions.preset("colmap")
            self.mapping = Recipe().mapper_options("colmap")
        self.workspace = Workspace(self.output_path / METHODS / self.method.folder_name)
        self.database = self.workspace.database

    @property
    def seconds_per_image(self) -> float:
        """What an image takes with its share of the pairs, about."""
        if self.method.escalates:
            return ESCALATION_SECONDS
        return RECIPE_SECONDS if self.method.recipe else SIFT_SECONDS

    @property
    def result(self) -> MethodResult:
        """What is done of the method, as it is on disk."""
        # One that an older version has written, or somebody has edited, is not valid: then
        # features stay, and models are made again.
        with suppress(FileNotFoundError, ValueError):
            path = self.workspace.path / "result.json"
            return RESULT_JSON.validate_python(read_sealed(path))
        return MethodResult(
            self.method.label,
            summary=self.method.summary,
            folder=self.workspace.path.relative_to(self.output_path).as_posix(),
            options=self.method.options,
        )

    def finished(self) -> MethodResult | None:
        """Return the result of the method if it has been run with the same seeds."""
        result = self.result
        seeds = [seed.seed for seed in result.seeds]
        return result if seeds == list(self.options.seeds) else None

    def begin(self, *, overwrite: bool) -> None:
        """Make the folder; StoreError where the method was run there on something else."""
        folder = self.workspace.path
        record = folder / "inputs.json"
        if overwrite:
            remove_own([folder])
        asked = {**self.inputs, **self.method.options}
        if self.method.escalates:
            # Verification with this seed decides what is matched again.
            asked["seed"] = self.options.seeds[0]
        asked = json.loads(json.dumps(asked))  # as it is read: tuples are lists
        mend = ("use ", Option("overwrite"), " to redo the methods that are named")
        with damage(record, mend):
            known = read_sealed(record) if record.exists() else {}
            difference = first_difference(known, asked)
        if folder.exists() and difference:
            raise ConflictError(
                f"{self.method.label} was run there with {difference}",
                where=folder,
                advice=(
                    "use ",
                    Option("overwrite"),
                    " to redo the methods that are named, another name (NAME=RECIPE), or "
                    "another ",
                    Option("output-path"),
                ),
            )
        self.workspace.begin()
        write_sealed(record, json.dumps(asked))

    def run(self) -> None:
        """Extract, match, verify and map; what is there is kept."""
        self.keep(failed="")
        if not self.result.wall_s:  # time that a killed run took does not count
            watch = Stopwatch()
            if self.method.recipe:
                failures = self._match_recipe(watch)
            else:
                failures = self._match_sift(watch)
            self.keep(failed_images=failures, wall_s=watch.seconds)
        done = {result.seed: result for result in self.result.seeds}
        for seed in self.options.seeds:
            if seed not in done:
                done[seed] = self._run_seed(seed)
                self.keep(seeds=tuple(done.values()))
        self.keep(seeds=tuple(done[seed] for seed in self.options.seeds))

    def keep(self, **values: Any) -> None:
        """Change fields of the result on disk."""
        peak = max(self.result.peak_memory_bytes, peak_memory_bytes())
        result = replace(self.result, peak_memory_bytes=peak, **values)
        path = self.workspace.path / "result.json"
        write_sealed(path, RESULT_JSON.dump_json(result))

    def _match_sift(self, watch: Stopwatch) -> dict[str, ImageFailure]:
        """Extract and match as COLMAP does; return why images cannot be used."""
        inputs = self.options.inputs(self.image_path)
        names = inputs.names()
        stage = self.progress.stage
        graph = ViewGraph(self.database)
        with watch.step("extract"), stage("extract", len(names), "images") as advance:
            failures = add_images(self.workspace, graph, inputs, names)
            usable = [name for name in names if name not in failures]
            if not usable:
                raise AffrectError(f"COLMAP cannot use any of the {len(names)} images")
            failures |= extract_sift(
                database_path=self.database,
                image_path=self.image_path,
                image_names=usable,
                masks=self.options.masks,
            )
            advance(len(names))
        known = set(image_ids(self.database))
        pairs = None
        num_pairs = math.comb(len(known), 2)
        list_path = self.options.pairs.match_list_path
        if list_path:
            listed = read_pairs(Path(list_path), names, self.image_path)
            pairs = [pair for pair in listed if known.issuperset(pair)]
            num_pairs = len(pairs)
        with watch.step("match"), stage("match", num_pairs, "pairs") as advance:
            match_sift(self.database, pairs)
            advance(num_pairs)
        return failures

    def _match_recipe(self, watch: Stopwatch) -> dict[str, ImageFailure]:
        """Extract, match and match again by a recipe; return why images cannot be used."""
        context = Context(
            workspace=self.workspace,
            resources=self.options.resources,
            executor=None,
            progress=self.progress,
        )
        inputs = self.options.inputs(self.image_path)
        recipe = self.method.recipe or Recipe()
        commands = context.resources.commands_to_complete(recipe.extraction)
        self.keep(lacks=", or ".join(commands))
        with watch.step("extract"):
            failures = extract(context, inputs, recipe).failed
        choose_pairs(context, self.options.pairs)
        with watch.step("match"):
            match(context)
        if self.method.escalates:
            seed = self.options.seeds[0]
            verification = self.verification.changed(random_seed=seed)
            verify_matches(replace(context, progress=SILENT), verification)
            mapper = MAPPERS.make(self.mapping.changed(random_seed=seed))
            with watch.step("escalate"):
                map_and_rematch(context, mapper, recipe)
        return failures

    def _run_seed(self, seed: int) -> SeedResult:
        """Verify and map a copy of the database of the method, in a folder of the seed."""
        folder = self.workspace.path / f"seed-{seed}"
        remove_own([folder])
        watch = Stopwatch()
        progress = copy(self.progress)
        progress.title += f"seed {seed}, "
        with new_results(folder) as (new,):  # gets its name when all is done
            new.mkdir()
            database_path = new / "database.db"
            copy_database(self.database, database_path)
            models = self._models(seed, folder=new, watch=watch, progress=progress)
            verified = verified_pairs(database_path, self.verification.min_num_inliers)
        largest = largest_of(models)
        return SeedResult(
            seed=seed,
            models=tuple(item.registered_names for item in models),
            model_path=f"{self.result.folder}/{folder.name}/sparse/0" if models else "",
            verified_pairs=len(verified),
            points3D=largest.num_points3D,
            mean_track_length=largest.mean_track_length,
            mean_reprojection_error_px=largest.mean_reprojection_error_px,
            sure=largest.sure,
            doubtful=texts_of(largest.doubtful),
            wall_s=watch.seconds,
        )

    def _map_recipe(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        """Verify and map as a run does."""
        context = Context(
            workspace=self.workspace.branch(folder),
            resources=self.options.resources,
            executor=None,
            progress=progress,
        )
        with watch.step("verify"):
            verify_matches(context, self.verification.changed(random_seed=seed))
        mapper = MAPPERS.make(self.mapping.changed(random_seed=seed))
        with watch.step("map"):
            guide(context)
            _, models = map_images(context, mapper)
        return models

    def _models(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        """Verify and map a copy of the database; escalation has done so with the first seed.

        Args:
            seed: of verification and mapping.
            folder: of the seed, which has the copy.
            watch: takes the seconds of both.
            progress: where to show it.

        Returns:
            The models, which are in the folder, the largest first.
        """
        if self.method.escalates and seed == self.options.seeds[0]:
            self.workspace.branch(folder)
            shutil.copytree(self.workspace.sparse, folder / "sparse")
            return read_summaries(folder / "sparse")
        with open_database(folder / "database.db") as database:
            database.clear_two_view_geometries()
        map_seed = self._map_recipe if self.method.recipe else self._map_sift
        return map_seed(seed, folder, watch, progress)

    def _map_sift(
        self, seed: int, folder: Path, watch: Stopwatch, progress: Progress
    ) -> Sequence[ModelSummary]:
        """Verify and map as COLMAP does."""
        path = folder / "database.db"
        options = self.verification.changed(random_seed=seed)
        num_pairs = len(unverified_pairs(path))
        num_images = len(image_ids(path))
        with (
            watch.step("verify"),
            progress.stage("verify", num_pairs, "pairs") as advance,
        ):
            verify(path, options, advance=advance)
        shutil.copy(self.workspace.cameras, folder)
        mapper = MAPPERS.make(self.mapping.changed(random_seed=seed))
        task = MappingTask(
            database_path=path,
            image_path=self.image_path,
            cameras=read_camera_records(self.workspace.cameras),
            may_share=self.options.inputs(self.image_path).may_share,
        )
        with watch.step("map"), progress.stage("map", num_images, "images") as advance:
            return map_database(
                mapper=mapper,
                task=task,
                sparse_path=folder / "sparse",
                next_image=advance,
            )
