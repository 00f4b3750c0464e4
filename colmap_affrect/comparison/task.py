"""What one method of a comparison is to do, and where everything lies.

``methods/NAME/`` is a workspace with the features and raw matches of a method, and
``methods/NAME/seed-K/`` has the two-view geometries and models of one seed.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from colmap_affrect.colmap.verification import VerificationOptions
from colmap_affrect.comparison.methods import SIFT_AFFINE_DSP, SIFT_COLMAP, Method
from colmap_affrect.comparison.results import MethodResult
from colmap_affrect.comparison.sift import describe_options
from colmap_affrect.errors import StaleStoreError
from colmap_affrect.mappers.base import MAPPERS, MapperOptions
from colmap_affrect.pairs.base import Pair, PairList
from colmap_affrect.pairs.lists import exhaustive_pairs, read_pairs
from colmap_affrect.pipeline import InputOptions
from colmap_affrect.project.outputs import remove_own
from colmap_affrect.project.record import first_difference
from colmap_affrect.project.workspace import Workspace
from colmap_affrect.recipes import DEFAULT_MAPPERS

DEFAULT_SEEDS = (0, 1, 2)
METHODS = "methods"  # folder of all methods
RESULT = TypeAdapter(MethodResult)  # from and to JSON


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
    seeds: Sequence[int] = DEFAULT_SEEDS
    ground_truth_path: Path | None = None

    def pairs_of(self, names: Sequence[str]) -> PairList | list[Pair]:
        """Return the pairs of images to match: those of the list if there is one, else all."""
        listed = self.pairs.match_list_path
        return read_pairs(Path(listed), names) if listed else exhaustive_pairs(names)


@dataclass(frozen=True)
class MethodTask:
    """What one process is to do."""

    method: Method
    output_path: Path
    image_path: Path
    all_options: CompareOptions

    @property
    def verification(self) -> VerificationOptions:
        """How pairs are verified: as COLMAP does it where all of the method is COLMAP's."""
        if self.method.label == SIFT_COLMAP:
            return VerificationOptions.preset("colmap")
        return self.all_options.verification

    @property
    def mapping(self) -> MapperOptions:
        """Mapper and its options, chosen in the same way."""
        if self.method.label == SIFT_COLMAP:
            options: MapperOptions = MAPPERS.part(DEFAULT_MAPPERS["colmap"]).Options.preset(
                "colmap"
            )
            return options
        return self.all_options.mapping

    @property
    def folder(self) -> Path:
        """Folder of the results of the method."""
        return self.output_path / METHODS / self.method.folder_name

    @property
    def failure(self) -> Path:
        """Why its process ended before everything was done."""
        return self.folder / "failed.txt"

    @property
    def result(self) -> Path:
        """What is done of the method; without seeds before the last of them has ended."""
        return self.folder / "result.json"

    @property
    def options(self) -> dict[str, Any]:
        """Options of features and matching, and the seed where verification decides on these."""
        recipe = self.method.recipe
        if recipe is None:
            return describe_options(affine=self.method.label == SIFT_AFFINE_DSP)
        seed = {"seed": self.all_options.seeds[0]} if self.method.escalates else {}
        return {**recipe.to_mapping(), **seed}

    def begun(self) -> MethodResult:
        """Return what is done of the method."""
        if self.result.exists():
            with suppress(ValidationError):  # of a version before: its features are kept
                return RESULT.validate_json(self.result.read_bytes())
        folder = self.folder.relative_to(self.output_path).as_posix()
        method = self.method
        return MethodResult(
            method.label, summary=method.summary, folder=folder, options=self.options
        )

    def finished(self) -> MethodResult | None:
        """Return the result of the method if it has been run with the same seeds."""
        result = self.begun()
        seeds = [seed.seed for seed in result.seeds]
        return result if seeds == list(self.all_options.seeds) else None

    def begin(self, *, overwrite: bool) -> None:
        """Make the folder; StaleStoreError where the method was begun with other options."""
        if overwrite:
            remove_own([self.folder])
        known, now = (
            RESULT.dump_python(result, mode="json")["options"]
            for result in (self.begun(), MethodResult("", options=self.options))
        )
        if difference := first_difference(known, now):
            raise StaleStoreError(
                f"{self.folder}: {self.method.label} was run there with {difference}; use "
                "--overwrite to redo the methods that are named, another name (NAME=RECIPE), "
                "or another --output-path"
            )
        Workspace(self.folder).begin()
        self.failure.unlink(missing_ok=True)
